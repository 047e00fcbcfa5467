"""Densities on grids: blur and normalisation, g = g0 * ε, and how to look values up.

A density is float32 values plus the affine map from sensor coordinates to array indices,
``index = (y - origin) / step``; a range profile is one row high.  Outside the array it is 0.

A Gaussian blur is separable.  At the crossings of columns u and rows v it is a product of three
matrices: Gaussians along v, the pattern (diagonal for detections), Gaussians along u.  Nothing is
interpolated, and no filter is cut off but where a Gaussian has vanished.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from mixpose.density.rules import DRAWING
from mixpose.records import Floats, GridPattern, Pattern, PointPattern, Singles

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


def blurred(
    pattern: Pattern, sigma: float, u: Floats, v: Floats, total: float, *, gradient: bool
) -> list[Singles]:
    """The density (V, U) of a pattern, and where wanted its derivatives by u and v.

    At columns u (U,) and rows v (V,), which ranges do not use.  Of a pattern that is not empty,
    blurred by `sigma` in sensor units, positive for detections, and normalised by its mass `total`.
    """
    m = pattern.dimension
    if isinstance(pattern, PointPattern):
        right = _bell(u, pattern.points[:, 0], sigma)
        left = [(pattern.weights / total).astype(np.float32)[:, None]]
        if m == 2:
            left = [left[0] * one for one in _bell(v, pattern.points[:, 1], sigma)]
    else:
        columns, right = _along(pattern, 0, sigma, u)
        rows, left = slice(None), [np.ones((1, 1), dtype=np.float32)]
        if m == 2:
            rows, left = _along(pattern, 1, sigma, v)
        scale = np.float32(pattern.step**m / total)
        values: Singles = (pattern.values[rows, columns] * scale).astype(np.float32)
        right = [values @ one for one in right]
    factors = [(left[0], right[0]), (left[0], right[1]), (left[-1], right[0])]
    return [one.T @ other for one, other in factors[: 1 + m if gradient else 1]]


def _along(
    pattern: GridPattern, axis: int, sigma: float, places: Floats
) -> tuple[slice, list[Singles]]:
    """The part of a grid that matters along an axis, and its Gaussians and slopes at places."""
    step, count = pattern.step, pattern.values.shape[1 - axis]
    margin = max(DRAWING.cut * sigma, step)
    first = int(np.clip((places.min() - margin - pattern.origin[axis]) / step, 0, count - 1))
    last = (places.max() + margin - pattern.origin[axis]) / step + 2
    part = slice(first, int(np.clip(last, first + 1, count)))
    grid = pattern.origin[axis] + step * np.arange(part.start, part.stop)
    if sigma > 0.3 * step:
        return part, _bell(places, grid, sigma)
    # sums over a grid coarser than that are no integrals: a narrower blur is linear interpolation
    away = (places - grid[:, None]) / step
    hat = np.maximum(1 - np.abs(away), 0.0) / step
    slope = np.where(np.abs(away) <= 1, -np.sign(away), 0.0) / step**2
    return part, [hat.astype(np.float32), slope.astype(np.float32)]


def _bell(axis: Floats, centres: Floats, sigma: float) -> list[Singles]:
    """Gaussians (M, n) around centres (M,) along an axis (n,), and their derivative."""
    away = ((axis - centres[:, None]) / sigma).astype(np.float32)
    squared = away * away
    values = np.exp(-0.5 * squared) * np.float32(1.0 / (np.sqrt(2 * np.pi) * sigma))
    # products of tails beyond (1e-11 of the peak) are subnormal: matrix products crawl on them
    values[squared > 2 * DRAWING.cut**2] = 0.0
    return [values, values * away * np.float32(-1.0 / sigma)]


def mass(pattern: Pattern) -> float:
    """The sum of weights, or of absolute values: noise about zero may outweigh the features."""
    if isinstance(pattern, PointPattern):
        return float(pattern.weights.sum())
    absolute = float(np.abs(pattern.values).sum(dtype=np.float64))
    return absolute * pattern.step**pattern.dimension


def reduced(pattern: GridPattern, sigma: float) -> tuple[GridPattern, float]:
    """A grid on fewer points where a wide blur leaves nothing between them, and the blur left.

    Points are averaged by a triangle (a box, then blocks), as blocks alone would move a feature to
    the centre of its block.  Its variance, twice (n² − 1)/12 px², is taken off the blur.
    """
    factor = odd_factor(sigma / (DRAWING.steps_per_sigma * pattern.step))
    if factor == 1:
        return pattern, sigma
    rows, columns = pattern.values.shape
    down = factor if pattern.dimension == 2 else 1
    # a block before, and what fills up the last one and another after
    size = (-(-columns // factor) + 2, -(-rows // down) + 2 * (down > 1))
    before = (down if down > 1 else 0, factor)
    after = (size[1] * down - rows - before[0], size[0] * factor - columns - factor)
    padded = cv2.copyMakeBorder(
        pattern.values, before[0], after[0], before[1], after[1], cv2.BORDER_CONSTANT, value=0
    )
    smooth = cv2.blur(padded, (factor, down), borderType=cv2.BORDER_CONSTANT)
    values = np.asarray(cv2.resize(smooth, size, interpolation=cv2.INTER_AREA), dtype=np.float32)
    step = factor * pattern.step
    origin = pattern.origin - factor * pattern.step + (factor - 1) / 2 * pattern.step
    left = np.sqrt(max(sigma**2 - (step**2 - pattern.step**2) / 6, 0.0))
    return GridPattern(values.reshape(size[1], size[0]), origin, step), float(left)


def odd_factor(ratio: float) -> int:
    """Largest odd whole number up to a ratio, at least 1: odd boxes have a central pixel."""
    whole = max(int(ratio + 1e-9), 1)
    return whole if whole % 2 else whole - 1


def render(pattern: Pattern, sigma: float, window: Window, *, gradient: bool = False) -> Density:
    """Blur a pattern g0 by `sigma`, in sensor units, and normalise it as a whole, on a window."""
    if is_empty(pattern):
        shape = (*window.shape, 3) if gradient else window.shape
        return Density(np.zeros(shape, dtype=np.float32), window, sigma)
    left = sigma
    if isinstance(pattern, GridPattern):
        pattern, left = reduced(pattern, sigma)
    u, v = window.axis(0), window.axis(pattern.dimension - 1)
    layers = blurred(pattern, left, u, v, mass(pattern), gradient=gradient)
    return Density(merge(layers) if gradient else layers[0], window, sigma)


def is_empty(pattern: Pattern) -> bool:
    """Whether a pattern has no feature at all."""
    if isinstance(pattern, PointPattern):
        return len(pattern.points) == 0 or not pattern.weights.sum() > 0
    # a profile below zero has no density, nor has one that single precision cannot normalise
    return not pattern.values.max() > 1e-30
