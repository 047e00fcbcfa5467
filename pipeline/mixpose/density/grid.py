"""A density on a grid, and how to look values up in it.

A density is float32 values plus the affine map from sensor coordinates to array indices,
``index = (y - origin) / step``; a range profile is one row high.  Outside the array it is 0.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from mixpose.density.rules import DRAWING
from mixpose.records import Floats, Singles

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
        return np.asarray(self.origin[k] + self.step * np.arange(self.shape[1 - k]))


@dataclass(frozen=True)
class Density:
    """A probability density over sensor coordinates, sampled on a window."""

    # (H, W) in 1/unit^m, or (H, W, 3) with its gradient; for ranges the last channel is empty
    values: Singles
    window: Window
    sigma: float  # standard deviation, in sensor units, that one exact feature has in it

    @property
    def dimension(self) -> int:
        """m, the number of sensor coordinates."""
        return len(self.window.origin)

    def sample(self, y: Floats) -> Singles:
        """The channels (..., 1 + m) at sensor coordinates (..., m), bilinear; 0 outside and at NaN.

        Without the last axis for a single channel.
        """
        m = self.dimension
        index = (y.reshape(-1, m) - self.window.origin) / self.window.step
        np.nan_to_num(index, copy=False, nan=FAR)
        np.clip(index, FAR, -FAR, out=index)
        u = index[None, :, 0].astype(np.float32)
        v = index[None, :, 1].astype(np.float32) if m == 2 else np.zeros_like(u)
        looked_up = remap(self.values, u, v).reshape(*y.shape[:-1], *self.values.shape[2:])
        return np.asarray(looked_up if self.values.ndim == 2 else looked_up[..., : 1 + m])


def merge(layers: list[Singles]) -> Singles:
    """Stack layers (H, W) as channels (H, W, C), padded to a number that is looked up exactly."""
    while len(layers) > 1 and len(layers) not in DRAWING.exact_channels:
        layers = [*layers, np.zeros_like(layers[0])]
    merged = np.asarray(cv2.merge(layers), dtype=np.float32)
    return merged.reshape(*layers[0].shape, len(layers))


def remap(values: Singles, u: Singles, v: Singles) -> Any:
    """Sample an array bilinearly at indices (...) along columns and rows: (..., C); 0 outside."""
    if u.ndim == 2 and u.size and max(u.shape) <= DRAWING.side:
        return cv2.remap(values, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
    count, channels, width = u.size, values.shape[2:], min(max(u.size, 1), DRAWING.side)
    padding = -count % width if count else 1
    maps = [np.pad(one.ravel(), (0, padding)).reshape(-1, width) for one in (u, v)]
    return remap(values, *maps).reshape(-1, *channels)[:count].reshape(*u.shape, *channels)
