"""A density on a grid, and how to look values up in it.

A density is float32 values plus the affine map from sensor coordinates to array indices,
``index = (y - origin) / step``: windows, coarse levels and range profiles (one row high) are all
the same thing.  Channel 0 holds the density g, the following m channels its gradient by sensor
coordinates.  Outside the array every channel is 0.

Arrays have 1, 3 or 4 channels: for those `cv2.remap` of OpenCV 5 is exact to float rounding, for
2 it still rounds coordinates to 1/32 of a step.  Densities of ranges are padded to 3.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from mixpose.density.rules import DRAWING
from mixpose.records import Floats

FAR = DRAWING.far


@dataclass(frozen=True)
class Window:
    """A grid in sensor coordinates."""

    origin: Floats  # (m,) sensor coordinates of the first grid point
    shape: tuple[int, int]  # rows and columns; one row for ranges
    step: float  # sensor units between grid points

    @classmethod
    def around(cls, lower: Floats, upper: Floats, step: float) -> Window:
        """The smallest grid that covers the box from `lower` to `upper`, both (m,)."""
        count = np.maximum(np.ceil((upper - lower) / step - 1e-9).astype(int) + 1, 2)
        rows = int(count[1]) if len(count) == 2 else 1
        return cls(np.asarray(lower, dtype=np.float64), (rows, int(count[0])), float(step))

    def axis(self, k: int) -> Floats:
        """Sensor coordinates of the grid along axis k (0 is u or the range, 1 is v)."""
        count = self.shape[1] if k == 0 else self.shape[0]
        return np.asarray(self.origin[k] + self.step * np.arange(count))


@dataclass(frozen=True)
class Density:
    """A probability density over sensor coordinates, sampled on a window.

    Values are (H, W, 3) or (H, W): the density in 1/unit^m, then its gradient in 1/unit^(m+1) where
    it was asked for; for ranges the last channel is empty.
    """

    values: NDArray[np.float32]
    window: Window
    sigma: float  # standard deviation, in sensor units, that one exact feature has in it

    @property
    def dimension(self) -> int:
        """m, the number of sensor coordinates."""
        return len(self.window.origin)

    def integral(self) -> float:
        """Integral of the density over its window."""
        first = self.values if self.values.ndim == 2 else self.values[..., 0]
        return float(first.sum(dtype=np.float64) * self.window.step**self.dimension)

    def indices(self, y: Floats) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Array indices (n,) along columns and rows of sensor coordinates (..., m), all finite."""
        index = (y.reshape(-1, self.dimension) - self.window.origin) / self.window.step
        np.nan_to_num(index, copy=False, nan=FAR)
        np.clip(index, FAR, -FAR, out=index)
        map_u = index[:, 0].astype(np.float32)
        map_v = index[:, 1].astype(np.float32) if self.dimension == 2 else np.zeros_like(map_u)
        return map_u, map_v

    def sample(self, y: Floats) -> NDArray[np.float32]:
        """The channels (..., 1 + m) at sensor coordinates (..., m), bilinear; 0 outside.

        Without the last axis for a single channel.
        """
        map_u, map_v = self.indices(y)
        looked_up = remap(self.values, map_u, map_v)
        if self.values.ndim == 2:
            return looked_up.reshape(y.shape[:-1])
        return looked_up[:, : 1 + self.dimension].reshape(*y.shape[:-1], 1 + self.dimension)


def merge(layers: list[NDArray[np.float32]]) -> NDArray[np.float32]:
    """Stack layers (H, W) as channels (H, W, C), padded to a number that is looked up exactly."""
    while len(layers) > 1 and len(layers) not in DRAWING.exact_channels:
        layers = [*layers, np.zeros_like(layers[0])]
    merged = np.asarray(cv2.merge(layers), dtype=np.float32)
    return merged.reshape(*layers[0].shape, len(layers))


def remap(
    values: NDArray[np.float32], map_u: NDArray[np.float32], map_v: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Sample an array bilinearly at n indices: (n, C) or (n,); 0 outside."""
    count, channels = len(map_u), values.shape[2:]
    width = min(count, DRAWING.side)
    if count == 0:
        return np.zeros((0, *channels), dtype=np.float32)
    if count > width:
        padding = -count % width
        map_u, map_v = np.pad(map_u, (0, padding)), np.pad(map_v, (0, padding))
    maps = map_u.reshape(-1, width), map_v.reshape(-1, width)
    looked_up = cv2.remap(values, *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
    return np.asarray(looked_up, dtype=np.float32).reshape(-1, *channels)[:count]
