"""Blur and normalise feature patterns, g = g0 * ε; the resolution at which densities are drawn.

A Gaussian blur is separable.  At the crossings of columns u and rows v it is a product of three
matrices: Gaussians along v, the pattern (diagonal for detections), Gaussians along u.  Nothing is
interpolated, and filters end only where a Gaussian has vanished.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property, lru_cache

import cv2
import numpy as np

from mixpose.constants import constant
from mixpose.records import Floats, GridPattern, Pattern, PointPattern, Singles

_FEW = 256  # places along an axis whose bells are cached, in 0.2 MB at most


@dataclass(frozen=True)
class DrawingRules:
    """Sizes of drawn densities, in standard deviations of a feature and cells of an array."""

    steps_per_sigma: float = constant(
        4.0, "cells per standard deviation: places are 4e-4 off, less than centres of blobs err by"
    )
    fine_steps: float = constant(
        48.0, "the same at σ_ε for grey values, which have no detection noise: places are 2e-7 off"
    )
    rim: int = constant(3, "cells along a tile that splines reach beside it: one before, two after")
    reach: float = constant(
        4.25,
        "from a detection to the end of its drawing: farther ones pull by less than 1e-3 σ_ε",
    )
    paper_reach: float = constant(4.0, "from predicted samples to the end of their window")
    exact: float = constant(
        0.14, "of a blur: the error of a detection of half height; exact ones have full height"
    )
    cut: float = constant(5.0, "at which sums end: the tail holds 6e-7")
    negligible: float = constant(16.0, "exponent at which two features do not overlap: 1e-7")
    tile: int = constant(
        24,
        "cells along the part of a tile that is looked up, at least: half of its six standard "
        "deviations is as far as a fit moves; larger ones are drawn for little use",
    )
    own_tiles: int = constant(
        1200, "places that have tiles of their own: fits take two thirds of the time on pages"
    )
    window_cells: int = constant(1_500_000, "of a dense window; a larger one gets coarser")
    side: int = constant(32000, "of an array and of maps: cv2.remap takes less than 32767")
    few_pairs: int = constant(
        64**2, "of points, or of tiles and detections: all at once are faster than neighbours"
    )
    held: int = constant(
        2**18,
        "samples, pairs of features, cells of tiles that are drawn together, or pages of a plane "
        "that are held at once; farther detections are left out, pages of grey values are larger",
    )

    @cached_property
    def widest(self) -> float:
        """Extent of features over the narrowest blur that the pages of a plane hold."""
        return math.sqrt(2 * self.held) * self.tile / self.steps_per_sigma

    @property
    def far(self) -> float:
        """Index outside any array, small enough for `cv2.remap` to count 32nd parts as integers."""
        return -32.0 * self.side


DRAWING = DrawingRules()


def blurred(
    pattern: Pattern, sigma: float, u: Floats, v: Floats, total: float, *, gradient: bool
) -> list[Singles]:
    """Return the density (V, U) of a pattern, and with `gradient` its derivatives by u and v.

    At columns u (U,) and rows v (V,), which ranges do not use; blurred by `sigma` in sensor units,
    positive for detections, and normalised by the mass `total` of the pattern.
    """
    m = pattern.dimension
    if isinstance(pattern, PointPattern):
        by_u = _bell(u, pattern.points[:, 0], sigma)
        by_v = [(pattern.weights / total).astype(np.float32)[:, None]]
        if m == 2:
            by_v = [by_v[0] * bell for bell in _bell(v, pattern.points[:, 1], sigma)]
    else:
        columns, by_u = _along(pattern, 0, sigma, u)
        rows, by_v = slice(None), [np.ones((1, 1), dtype=np.float32)]
        if m == 2:
            rows, by_v = _along(pattern, 1, sigma, v)
        scale = np.float32(pattern.step**m / total)
        values: Singles = (pattern.values[rows, columns] * scale).astype(np.float32)
        by_u = [values @ bell for bell in by_u]
    factors = [(by_v[0], by_u[0]), (by_v[0], by_u[1]), (by_v[-1], by_u[0])]
    return [along_v.T @ along_u for along_v, along_u in factors[: 1 + m if gradient else 1]]


def _along(
    pattern: GridPattern, axis: int, sigma: float, places: Floats
) -> tuple[slice, list[Singles]]:
    """Return the part of a grid that matters along an axis, with Gaussians and slopes at places."""
    count, origin = pattern.values.shape[1 - axis], float(pattern.origin[axis])
    # tiles of a row or a column, also of later frames, share them
    bells = _bells_of_grid if len(places) < _FEW else _bells_of_grid.__wrapped__
    return bells(pattern.step, count, origin, sigma, np.asarray(places, np.float64).tobytes())


@lru_cache(maxsize=256)
def _bells_of_grid(
    step: float, count: int, origin: float, sigma: float, at: bytes
) -> tuple[slice, list[Singles]]:
    """Compute the same, cached by its arguments; `at` are the bytes of places."""
    places, margin = np.frombuffer(at, np.float64), max(DRAWING.cut * sigma, step)
    first = int(np.clip((places.min() - margin - origin) / step, 0, count - 1))
    last = (places.max() + margin - origin) / step + 2
    part = slice(first, int(np.clip(last, first + 1, count)))
    grid = origin + step * np.arange(part.start, part.stop, dtype=np.float64)
    if sigma > 0.3 * step:
        return part, _bell(places, grid, sigma)
    # sums over a coarser grid are no integrals: a narrower blur is linear interpolation
    away = (places - grid[:, None]) / step
    hat = np.maximum(1 - np.abs(away), 0.0) / step
    slope = np.where(np.abs(away) <= 1, -np.sign(away), 0.0) / step**2
    return part, [hat.astype(np.float32), slope.astype(np.float32)]


def _bell(axis: Floats, centres: Floats, sigma: float) -> list[Singles]:
    """Return Gaussians (M, n) around centres (M,) along an axis (n,), and their derivatives."""
    away = ((axis - centres[:, None]) / sigma).astype(np.float32)
    squared = away * away
    values = np.exp(-0.5 * squared) * np.float32(1.0 / (np.sqrt(2 * np.pi) * sigma))
    # products of farther tails (1e-11 of the peak) are subnormal: matrix products crawl on them
    values[squared > 2 * DRAWING.cut**2] = 0.0
    return [values, values * away * np.float32(-1.0 / sigma)]


def mass(pattern: Pattern) -> float:
    """Return the sum of weights, or of absolute values as noise may be negative, too."""
    if isinstance(pattern, PointPattern):
        return float(pattern.weights.sum())
    absolute = float(np.abs(pattern.values).sum(dtype=np.float64))
    return absolute * pattern.step**pattern.dimension


def reduced(pattern: GridPattern, sigma: float) -> tuple[GridPattern, float]:
    """Return a coarser grid, if a wide blur leaves no detail between its points, and the blur left.

    Points are averaged by a triangle (a box, then blocks), as blocks alone would move a feature to
    the centre of its block.  Its variance, twice (n² − 1)/12 px², is subtracted from the blur.
    """
    factor = odd_factor(sigma / (DRAWING.steps_per_sigma * pattern.step))
    if factor == 1:
        return pattern, sigma
    rows, columns = pattern.values.shape
    down = factor if pattern.dimension == 2 else 1
    # a block before; after, what fills up the last block, and another one
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
    remaining = np.sqrt(max(sigma**2 - (step**2 - pattern.step**2) / 6, 0.0))
    return GridPattern(values.reshape(size[1], size[0]), origin, step), float(remaining)


def odd_factor(ratio: float) -> int:
    """Return the largest odd whole number up to a ratio, at least 1: odd boxes have a centre."""
    return max(int(ratio + 1e-9) - 1, 0) // 2 * 2 + 1
