"""From feature pattern to density: Gaussian blur and normalisation, g = g0 * ε.

Point patterns are rendered exactly: a separable Gaussian at every grid point is one matrix
product over the points, whatever their number.  Grid patterns are filtered; wide blurs on a
reduced grid whose averaging is taken off the blur.
"""

from __future__ import annotations

from typing import TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from mixpose.density.grid import Density, Window, merge
from mixpose.records import GridPattern, Pattern, PointPattern

Floats: TypeAlias = NDArray[np.float64]

_VANISHED = 50.0  # squared standard deviations at which a Gaussian is 1e-11 of its peak

TRUNCATE = 5.0  # standard deviations at which filter kernels end; the tail holds 6e-7


def render(pattern: Pattern, sigma: float, window: Window, *, gradient: bool = False) -> Density:
    """Blur a pattern and normalise it to a probability density.

    Parameters
    ----------
    pattern : PointPattern or GridPattern
        g0.
    sigma : float
        Standard deviation of the blur in sensor units; positive.
    window : Window
        Where the density is wanted.  The normalisation is that of the whole pattern, so that a
        window shows a part of the same density.
    gradient : bool
        Whether to add the gradient channels.

    Returns
    -------
    Density
        Zero everywhere when the pattern is empty.
    """
    if isinstance(pattern, PointPattern):
        values = _render_points(pattern, sigma, window, gradient)
    else:
        values = _render_grid(pattern, sigma, window, gradient)
    return Density(values, window, sigma)


def _nothing(window: Window, gradient: bool) -> NDArray[np.float32]:
    return np.zeros((*window.shape, 3) if gradient else window.shape, dtype=np.float32)


def _render_points(
    pattern: PointPattern, sigma: float, window: Window, gradient: bool
) -> NDArray[np.float32]:
    dimension = pattern.points.shape[1]
    total = pattern.weights.sum()
    if total <= 0:
        return _nothing(window, gradient)
    weights = (pattern.weights / total).astype(np.float32)
    bells, slopes, _ = zip(
        *(bell(window.axis(k), pattern.points[:, k], sigma) for k in range(dimension)), strict=True
    )
    if dimension == 1:
        profiles = (weights @ bells[0], weights @ slopes[0])
        layers: list[NDArray[np.float32]] = [each.reshape(window.shape) for each in profiles]
    else:
        rows = bells[1].T * weights
        layers = [rows @ bells[0]]
        if gradient:
            layers += [rows @ slopes[0], (slopes[1].T * weights) @ bells[0]]
    if not gradient:
        return layers[0]
    return merge(layers[: 1 + dimension])


def bell(
    axis: Floats, centres: Floats, sigma: float
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """Gaussians (..., M, n) around centres (M,) along axes (..., n), and two derivatives."""
    away = ((axis - centres[:, None]) / sigma).astype(np.float32)
    squared = away * away
    values = np.exp(-0.5 * squared) * np.float32(1.0 / (np.sqrt(2 * np.pi) * sigma))
    # products of far tails would be subnormal numbers, on which matrix products crawl
    values[squared > _VANISHED] = 0.0
    slopes = values * away * np.float32(-1.0 / sigma)
    return values, slopes, values * (squared - 1) * np.float32(1.0 / sigma**2)


def mass(pattern: GridPattern) -> float:
    """What a grid pattern is normalised by: its integral, of absolute values.

    Noise about zero stays as it is, and may outweigh the features; the plain integral might then
    be anything.
    """
    absolute = float(np.abs(pattern.values).sum(dtype=np.float64))
    return absolute * pattern.step ** len(pattern.origin)


def _render_grid(
    pattern: GridPattern, sigma: float, window: Window, gradient: bool
) -> NDArray[np.float32]:
    dimension = len(pattern.origin)
    # magnitudes: the plain sum of a profile with noise about zero may be nothing or negative
    total = mass(pattern)
    if total <= 0:
        return _nothing(window, gradient)
    source = _blocks(pattern, window, margin=TRUNCATE * sigma)
    # averaging twice over n pixels adds 2 (n² − 1)/12 px² of variance
    variance = sigma**2 - (source.step**2 - pattern.step**2) / 6
    spread = float(np.sqrt(max(variance, 0.0))) / source.step
    layers = _filtered(source.values / np.float32(total), spread, source.step, gradient)
    stacked = merge(layers) if gradient else layers[0]
    on_source = Density(stacked, Window(source.origin, source.values.shape, source.step), sigma)
    first = (window.origin - source.origin) / source.step
    if abs(window.step / source.step - 1) < 1e-9 and np.allclose(first, first.round(), atol=1e-6):
        column, row = int(first[0].round()), int(first[1].round()) if dimension == 2 else 0
        cut = stacked[row : row + window.shape[0], column : column + window.shape[1]]
        return np.ascontiguousarray(cut)
    sampled = on_source.sample(_grid_points(window))
    return merge([sampled[..., k] for k in range(1 + dimension)]) if gradient else sampled


def _blocks(pattern: GridPattern, window: Window, margin: float) -> GridPattern:
    """The part of a pattern within a margin of the window, averaged over blocks.

    Blocks are as large as the window's step allows, and centred on the window's grid points
    where whole pixels permit; beyond the pattern is zero.  The average is a triangle (a box run
    over the pixels, then blocks): blocks alone would move a feature to the centre of its block.
    """
    dimension, step = len(pattern.origin), pattern.step
    factor = odd_factor(window.step / step)
    count = np.array(window.shape[::-1])[:dimension]
    far = window.origin + (count - 1) * window.step
    blocks_before = int(np.ceil(margin / (factor * step))) + 1
    start = window.origin - blocks_before * factor * step
    begin = np.floor((start - pattern.origin) / step - (factor - 1) / 2 + 0.5 + 1e-6).astype(int)
    blocks = np.ceil((far + margin - start) / (factor * step)).astype(int) + 2
    values = _cut_out(pattern.values, begin, begin + blocks * factor)
    origin = pattern.origin + (begin + (factor - 1) / 2) * step
    if factor > 1:
        size = (int(blocks[0]), int(blocks[1]) if dimension == 2 else 1)
        box = (factor, factor if dimension == 2 else 1)
        smooth = cv2.blur(values, box, borderType=cv2.BORDER_CONSTANT)
        averaged = cv2.resize(smooth, size, interpolation=cv2.INTER_AREA)
        values = np.asarray(averaged, dtype=np.float32)
    return GridPattern(values, np.asarray(origin), step * factor)


def odd_factor(ratio: float) -> int:
    """Largest odd whole number up to a ratio, at least 1: odd boxes have a central pixel."""
    whole = max(int(ratio + 1e-9), 1)
    return whole if whole % 2 else whole - 1


def _cut_out(
    values: NDArray[np.float32], begin: NDArray[np.int_], end: NDArray[np.int_]
) -> NDArray[np.float32]:
    """Rows and columns from `begin` to `end` (u first), zero where there are none."""
    size = np.array(values.shape[::-1])[: len(begin)]
    low, high = np.clip(begin, 0, size), np.clip(end, 0, size)
    flat = len(begin) == 1
    inside = values[:, low[0] : high[0]] if flat else values[low[1] : high[1], low[0] : high[0]]
    along_u = (int(low[0] - begin[0]), int(end[0] - max(high[0], begin[0])))
    if inside.size == 0:
        rows = 1 if flat else int(end[1] - begin[1])
        return np.zeros((rows, int(end[0] - begin[0])), dtype=np.float32)
    along_v = (0, 0) if flat else (int(low[1] - begin[1]), int(end[1] - high[1]))
    return np.pad(inside, (along_v, along_u))


def _filtered(
    values: NDArray[np.float32], spread: float, step: float, gradient: bool
) -> list[NDArray[np.float32]]:
    """Gaussian-filtered values and, on demand, derivatives by u and v in sensor units."""
    reach = max(int(np.ceil(TRUNCATE * spread)), 1)
    offsets = np.arange(-reach, reach + 1, dtype=np.float64)
    if spread < 1e-3:
        bell = (offsets == 0).astype(np.float64)
        slope = np.where(np.abs(offsets) == 1, 0.5 * np.sign(offsets), 0.0)
    else:
        bell = np.exp(-0.5 * (offsets / spread) ** 2)
        bell /= bell.sum()
        slope = offsets * bell / (offsets**2 * bell).sum()
    kernel = bell.astype(np.float32)
    # correlation with +x weights is the derivative: Σ f(x + k) k bell(k) / Σ k² bell(k)
    derivative = (slope / step).astype(np.float32)
    one_row = values.shape[0] == 1
    across = np.ones(1, dtype=np.float32) if one_row else kernel
    layers = [_separable(values, kernel, across)]
    if gradient:
        layers.append(_separable(values, derivative, across))
        if not one_row:
            layers.append(_separable(values, kernel, derivative))
    return layers


def _separable(
    values: NDArray[np.float32], along_u: NDArray[np.float32], along_v: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Filter with zeros beyond the border (OpenCV extrapolates unless the border is padded)."""
    pad_u, pad_v = len(along_u) // 2, len(along_v) // 2
    padded = cv2.copyMakeBorder(values, pad_v, pad_v, pad_u, pad_u, cv2.BORDER_CONSTANT, value=0)
    out = cv2.sepFilter2D(padded, cv2.CV_32F, along_u, along_v, borderType=cv2.BORDER_CONSTANT)
    return np.asarray(
        out[pad_v : pad_v + values.shape[0], pad_u : pad_u + values.shape[1]], dtype=np.float32
    )


def _grid_points(window: Window) -> Floats:
    u = window.axis(0)
    if len(window.origin) == 1:
        return u[None, :, None]
    return np.stack(np.meshgrid(u, window.axis(1)), axis=-1)
