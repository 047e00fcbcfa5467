"""Densities of all sensors as one image, drawn only where there is something to see.

A density is nearly empty: detections are few, and a grid fine enough for gradients has millions of
points.  So the plane of every sensor is divided into square pages, and only pages near a feature
are drawn, all of them into one array (an atlas).  A table says where each page lies; pages that
are not drawn share an empty one.  One `cv2.remap` looks all sensors up, values and gradients
together, at any place.

Arrays have a leading axis L over sensors.  A sensor of one coordinate has 0 as its second, and its
pages have equal rows.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from mixpose.density.blur import factors, reduced
from mixpose.density.grid import remap
from mixpose.records import GridPattern, Pattern, PointPattern

Floats: TypeAlias = NDArray[np.float64]
Singles: TypeAlias = NDArray[np.float32]
Indices: TypeAlias = NDArray[np.intp]

MIN_PAGE = 18
"""Cells along the side of a page, at least; one more is drawn, so that pages join without a seam.
A page is as wide as what a detection fills, so that each lies on two pages along an axis; pages of
grey values alone are small."""

REACH = 3.5
"""Standard deviations around a detection that are drawn: 0.2 % of its peak is left there,
so that two features 4 σ_ε apart draw each other by 2e-3 σ_ε, where it is 0.05 at 2.5."""

MAX_PAGES = 400_000
"""Pages of a sensor's plane; detections that are too far from their middle for it are left out."""

_ROWS = 32000  # of the array: cv2.remap takes less than 32767
_CORNERS = np.array([[0, 0], [1, 0], [0, 1], [1, 1]])


@dataclass(frozen=True)
class Atlas:
    """Densities with gradients of L sensors, on pages.

    Attributes
    ----------
    values : (rows, columns, 3) float32
        Pages of (page + 1)² cells: density in 1/unit^m, then its gradient in 1/unit^(m+1).
    table : (L · planes,) int
        Number of each square's page, plane after plane and row by row; 0 where nothing is drawn.
    corners : (pages, 2) float64
        Column and row of each page's first cell in `values`.
    per_unit : (L, 1, 1, 2) float64
        Cells per sensor unit; 0 for the missing coordinate of ranges.
    origin : (2,) float64
        Of all planes, in cells.
    shape : (int, int)
        Pages of a plane along u and v; the outermost are empty.
    limit : (2,) float64
        Largest index within a plane.
    planes : (L, 1, 1) int
        Where the plane of each sensor begins in the table.
    page : int
        Cells along the side of a page.
    """

    values: Singles
    table: Indices
    corners: Floats
    per_unit: Floats
    origin: Floats
    shape: tuple[int, int]
    limit: Floats
    planes: Indices
    page: int

    def look_up(self, y: Floats) -> Floats:
        """Densities and gradients (L, H, n, 3) at places (L, H, n, 2); 0 where nothing is drawn."""
        index = y * self.per_unit
        index -= self.origin
        np.maximum(index, 0.0, out=index)
        np.minimum(index, self.limit, out=index)
        square = (index * (1.0 / self.page)).astype(np.intp)
        number = self.table[square[..., 0] + self.shape[0] * square[..., 1] + self.planes]
        square *= self.page
        index -= square
        index += self.corners[number]
        maps = index.reshape(-1, 2).astype(np.float32)
        sampled = remap(self.values, maps[:, 0], maps[:, 1])
        return sampled.reshape(*y.shape[:-1], 3).astype(np.float64)


class _Grid(NamedTuple):
    """The planes of all sensors: their common origin in cells, pages along u and v, and a page.

    `is_cut` where some places are too far away for a table.
    """

    origin: Floats
    shape: tuple[int, int]
    page: int
    is_cut: bool = False

    @property
    def squares(self) -> int:
        """Of one plane."""
        return self.shape[0] * self.shape[1]

    def around(self, q: Floats, half: float) -> tuple[Indices, Floats]:
        """Squares (K, 4) that places (K, 2) in cells fill, and their first cells (K, 4, 2)."""
        first = ((q - half) * (1.0 / self.page)).astype(np.intp)
        both = first[:, None] + _CORNERS
        return both[..., 0] + self.shape[0] * both[..., 1], (self.page * both).astype(np.float64)


def draw(
    patterns: Sequence[Pattern],
    sigmas: Sequence[float],
    steps_per_sigma: float,
    near: Sequence[Floats | None],
    around: float = REACH,
) -> Atlas:
    """Draw patterns, blurred and normalised.

    Parameters
    ----------
    patterns : sequence of PointPattern or GridPattern
        One per sensor, not empty.
    sigmas : sequence of float
        Standard deviation of the blur per sensor, in sensor units.
    steps_per_sigma : float
        Cells per standard deviation, n.  The zero of the looked-up gradient of a Gaussian errs by
        up to √3/36 n⁻³ standard deviations along an axis: 1.8e-3 at 3, 7.5e-4 at 4, 9.4e-5 at 8.
    near : sequence of (n, m) array or None
        Places of predicted features, about which alone a sensor's density is wanted; None:
        wherever it is not zero.
    around : float
        Standard deviations about predicted features within which grey values are drawn.
    """
    steps = np.asarray(sigmas, dtype=np.float64) / steps_per_sigma
    reach = REACH * steps_per_sigma
    # looking up linearly is one more blur by a triangle, averaged over the places within a cell
    narrowed = steps * math.sqrt(steps_per_sigma**2 - 1 / 6)
    parts = [
        _cells(pattern, places, step, 6 * reach)
        for pattern, places, step in zip(patterns, near, steps.tolist(), strict=True)
    ]
    grid = _grid([q for q, _ in parts], reach, any(len(weights) for _, weights in parts))
    table = np.zeros(len(patterns) * grid.squares, dtype=np.intp)
    detected = [k for k, pattern in enumerate(patterns) if isinstance(pattern, PointPattern)]
    drawn = []
    if detected:
        drawn.append(_draw_points(parts, detected, patterns, narrowed, grid, reach, table))
    for k, pattern in enumerate(patterns):
        if isinstance(pattern, GridPattern):
            q = None if near[k] is None else parts[k][0]
            first = 1 + sum(len(pages) - 1 for pages in drawn)
            step, sigma = float(steps[k]), float(narrowed[k])
            drawn.append(
                _draw_grid(pattern, k, step, sigma, grid, q, around * steps_per_sigma, table, first)
            )
    values, corners = _packed(drawn)
    two = np.array([float(_dimension(pattern) == 2) for pattern in patterns])
    return Atlas(
        values=values,
        table=table,
        corners=corners,
        per_unit=np.stack([1 / steps, two / steps], axis=1)[:, None, None],
        origin=grid.origin,
        shape=grid.shape,
        limit=np.array(grid.shape) * grid.page - 1e-3,
        planes=(grid.squares * np.arange(len(patterns)))[:, None, None],
        page=grid.page,
    )


def _dimension(pattern: Pattern) -> int:
    if isinstance(pattern, PointPattern):
        return int(pattern.points.shape[1])
    return len(pattern.origin)


def _cells(
    pattern: Pattern, near: Floats | None, step: float, margin: float
) -> tuple[Floats, Floats]:
    """What a plane has to hold, in cells (K, 2), and the weights (K,) of detections.

    Detections in the box of predicted features; predicted features; or the corners of a grid.
    """
    if isinstance(pattern, PointPattern):
        points, weights = pattern.points / step, pattern.weights / pattern.weights.sum()
        if near is not None and len(near):
            lower, upper = near.min(axis=0) / step - margin, near.max(axis=0) / step + margin
            kept = ((points >= lower) & (points <= upper)).all(axis=1)
            points, weights = points[kept], weights[kept]
    elif near is not None and len(near):
        points, weights = near / step, np.zeros(0)
    else:
        size = np.array(pattern.values.shape[::-1])[: len(pattern.origin)] - 1
        ends = np.array([pattern.origin, pattern.origin + size * pattern.step])
        points, weights = ends / step, np.zeros(0)
    if points.shape[1] == 1:
        points = np.concatenate([points, np.zeros_like(points)], axis=1)
    return points, weights


def _grid(parts: Sequence[Floats], reach: float, detected: bool) -> _Grid:
    """One grid of pages for all planes, with a ring of pages that are never drawn."""
    q = np.concatenate([np.zeros((0, 2)), *parts])
    page = max(math.ceil(2 * reach), MIN_PAGE) if detected else MIN_PAGE
    if not len(q):
        return _Grid(np.zeros(2), (3, 3), page)
    lower, upper = q.min(axis=0), q.max(axis=0)
    is_cut = math.prod(((upper - lower) / page + 5).tolist()) > MAX_PAGES
    if is_cut:
        middle, half = np.median(q, axis=0), page * math.sqrt(MAX_PAGES) / 2.5
        lower, upper = np.maximum(lower, middle - half), np.minimum(upper, middle + half)
    columns, rows = ((upper - lower + 2 * reach) / page).tolist()
    # Pages begin at whole ones from sensor coordinates 0, so that a density is the same whatever is
    # drawn beside it; half a cell is left, lest rounding puts a place on a page of the rim.
    origin = page * np.floor((lower - (reach + page + 0.5)) / page)
    return _Grid(origin, (int(columns) + 5, int(rows) + 5), page, is_cut)


def _draw_points(
    parts: Sequence[tuple[Floats, Floats]],
    chosen: Sequence[int],
    patterns: Sequence[Pattern],
    sigmas: Floats,
    grid: _Grid,
    reach: float,
    table: Indices,
) -> Singles:
    """Pages (1 + S, side, side, 3) around detections, which are drawn as exact Gaussians.

    They are numbered in the table; the first is empty.
    """
    q = np.concatenate([parts[k][0] for k in chosen]) - grid.origin
    weights = np.concatenate([parts[k][1] for k in chosen])
    sensor = np.repeat(chosen, [len(parts[k][0]) for k in chosen])
    if grid.is_cut:
        first = np.floor((q - reach) * (1.0 / grid.page))
        inside = ((first >= 1) & (first <= np.array(grid.shape) - 3)).all(axis=1)
        q, weights, sensor = q[inside], weights[inside], sensor[inside]
    squares, corner = grid.around(q, reach)
    cells = (squares + grid.squares * sensor[:, None]).ravel()
    sigma = sigmas[sensor]
    # cells per standard deviation are alike in all sensors
    per_sigma = np.float32(1 / math.sqrt((reach / REACH) ** 2 - 1 / 6))
    side = np.arange(grid.page + 1, dtype=np.float32)
    away = (corner - q[:, None]).astype(np.float32)[..., None] + side
    away *= per_sigma
    bells = np.exp(np.float32(-0.5) * away * away)
    two = np.array([_dimension(pattern) == 2 for pattern in patterns])[sensor]
    height = (weights / (np.sqrt(2 * np.pi) * sigma) ** (1 + two)).astype(np.float32)
    bells[:, :, 0] *= height[:, None, None]
    slopes = bells * away
    slopes *= (-1 / sigma).astype(np.float32)[:, None, None, None]
    if not two.all():  # rows that are all alike
        bells[~two, :, 1], slopes[~two, :, 1] = 1.0, 0.0
    K = len(cells)
    bells, slopes = bells.reshape(K, 2, len(side)), slopes.reshape(K, 2, len(side))
    pages = np.empty((1 + K, len(side), len(side), 3), dtype=np.float32)
    pages[0] = 0.0
    u, v = bells[:, 0, None], bells[:, 1, :, None]
    np.multiply(v, u, out=pages[1:, ..., 0])
    np.multiply(v, slopes[:, 0, None], out=pages[1:, ..., 1])
    np.multiply(slopes[:, 1, :, None], u, out=pages[1:, ..., 2])
    numbers = np.arange(1, 1 + K)
    table[cells] = numbers
    kept = table[cells]  # of several on one page, one page is kept, and the others are added to it
    for extra in np.flatnonzero(kept != numbers).tolist():
        pages[kept[extra]] += pages[1 + extra]
    return pages


def _draw_grid(
    pattern: GridPattern,
    k: int,
    step: float,
    sigma: float,
    grid: _Grid,
    q: Floats | None,
    half: float,
    table: Indices,
    first: int,
) -> Singles:
    """As `_draw_points`, of pages about places in cells, or all, summed over the points of a grid.

    The pages are numbered from `first` on.
    """
    small, left_over = reduced(pattern, sigma)
    page, side = grid.page, grid.page + 1
    pages = [np.zeros((side, side, 3), dtype=np.float32)]
    for low, high in _rectangles(grid, q, half):
        u, v = (
            step * (grid.origin[axis] + page * low[axis] + np.arange(page * (b - a + 1) + 1))
            for axis, (a, b) in enumerate(zip(low, high, strict=True))
        )
        made = factors(small, left_over, u, v if len(pattern.origin) == 2 else None)
        drawn = np.zeros((len(v), len(u), 3), dtype=np.float32)
        for channel, layer in enumerate(made.layers(gradient=True)[: 1 + len(pattern.origin)]):
            drawn[..., channel] = layer
        for row in range(low[1], high[1] + 1):
            for column in range(low[0], high[0] + 1):
                cell = k * grid.squares + row * grid.shape[0] + column
                if table[cell] == 0:
                    top, left = page * (row - low[1]), page * (column - low[0])
                    table[cell] = first + len(pages) - 1
                    pages.append(drawn[top : top + side, left : left + side])
    return np.stack(pages)


def _rectangles(
    grid: _Grid, q: Floats | None, half: float
) -> list[tuple[tuple[int, int], tuple[int, int]]]:
    """First and last pages, columns and rows, about each of some places, or all but the rim."""
    last = grid.shape[0] - 2, grid.shape[1] - 2
    if q is None:
        return [((1, 1), last)]
    ends = []
    for u, v in (q - grid.origin).tolist():
        low = (max(int((u - half) / grid.page), 1), max(int((v - half) / grid.page), 1))
        high = int((u + half) / grid.page), int((v + half) / grid.page)
        high = min(high[0], last[0]), min(high[1], last[1])
        if low[0] <= high[0] and low[1] <= high[1]:
            ends.append((low, high))
    return ends


def _packed(drawn: Sequence[Singles]) -> tuple[Singles, Floats]:
    """All pages in one array, below one another, in several columns where they are many."""
    pages = drawn[0]
    if len(drawn) > 1:
        pages = np.concatenate([pages, *(each[1:] for each in drawn[1:])])
    count, side = pages.shape[:2]
    columns = -(-count * side // _ROWS)
    rows = -(-count // columns)
    if columns > 1:
        padded = np.zeros((columns * rows, side, side, 3), dtype=np.float32)
        padded[:count] = pages
        pages = padded.reshape(columns, rows * side, side, 3).swapaxes(0, 1)
    number = np.arange(columns * rows)
    corners = np.empty((columns * rows, 2))
    corners[:, 0], corners[:, 1] = side * (number // rows), side * (number % rows)
    return np.ascontiguousarray(pages).reshape(rows * side, columns * side, 3), corners
