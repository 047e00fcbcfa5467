"""Densities of all sensors as one image, drawn only where there is something to see.

A density is nearly empty: detections are few, and a grid fine enough for gradients has millions of
points.  So the plane of every sensor is divided into square pages, and only pages near a feature
are drawn, all of them into one array (an atlas).  A table says where each page lies; pages that
are not drawn share an empty one.  One `cv2.remap` looks all sensors up, values and gradients
together, at any place.

Arrays have a leading axis L over sensors.  A sensor of one coordinate has 0 as its second, and its
pages have one row.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from mixpose.density.blur import factors, reduced
from mixpose.density.grid import remap
from mixpose.records import GridPattern, Pattern, PointPattern

Floats: TypeAlias = NDArray[np.float64]
Singles: TypeAlias = NDArray[np.float32]
Indices: TypeAlias = NDArray[np.intp]

PAGE = 16
"""Cells along the side of a page; one more is drawn, so that pages join without a seam."""

REACH = 3.0
"""Standard deviations around a detection that are drawn: 1 % of its peak is left there."""

MOST_PAGES = 400_000
"""Pages along which the table of a sensor may reach; detections beyond are left out."""

_ROWS = 1900  # pages in a column of the array: cv2.remap takes less than 32767 rows


@dataclass(frozen=True)
class Atlas:
    """Densities with gradients of L sensors, on pages.

    Attributes
    ----------
    values : (rows, columns, 3) float32
        Pages of (PAGE + 1)² cells: density in 1/unit^m, then its gradient in 1/unit^(m+1).
    table : (cells,) int
        Page of each square of each sensor's plane, 0 where nothing is drawn.
    corners : (pages, 2) float64
        Column and row of each page's first cell in `values`.
    origins : (L, 1, 1, 2) float64
        Sensor coordinates of the first cell of each plane.
    per_unit : (L, 1, 1, 2) float64
        Cells per sensor unit; 0 for the missing coordinate of ranges.
    limits : (L, 1, 1, 2) float64
        Largest index within each plane, whose outermost pages are empty.
    strides : (L, 1, 1) int
        Pages in a row of each plane.
    offsets : (L, 1, 1) int
        Where the plane of each sensor begins in the table.
    """

    values: Singles
    table: Indices
    corners: Floats
    origins: Floats
    per_unit: Floats
    limits: Floats
    strides: Indices
    offsets: Indices

    def look_up(self, y: Floats) -> Floats:
        """Densities and gradients (L, H, n, 3) at places (L, H, n, 2); 0 where nothing is drawn."""
        index = (y - self.origins) * self.per_unit
        np.maximum(index, 0.0, out=index)
        np.minimum(index, self.limits, out=index)
        page = (index * (1.0 / PAGE)).astype(np.intp)
        drawn = self.table[page[..., 0] + page[..., 1] * self.strides + self.offsets]
        page *= PAGE
        index -= page
        index += self.corners[drawn]
        maps = index.reshape(-1, 2).astype(np.float32)
        sampled = remap(self.values, maps[:, 0], maps[:, 1])
        return sampled.reshape(*y.shape[:-1], 3).astype(np.float64)

    def dense(self, sensor: int) -> tuple[Singles, Floats, float]:
        """The plane of one sensor as an array (H, W, 3), its first cell's place, and its step."""
        columns = int(self.strides[sensor, 0, 0])
        rows = int(self.limits[sensor, 0, 0, 1] // PAGE) + 1
        begin = int(self.offsets[sensor, 0, 0])
        pages = self.table[begin : begin + rows * columns].reshape(rows, columns)
        plane = np.zeros((rows * PAGE, columns * PAGE, 3), dtype=np.float32)
        for row, column in zip(*np.nonzero(pages), strict=True):
            left, top = self.corners[pages[row, column]].astype(int)
            part = self.values[top : top + PAGE, left : left + PAGE]
            plane[row * PAGE : (row + 1) * PAGE, column * PAGE : (column + 1) * PAGE] = part
        step = 1 / float(self.per_unit[sensor, 0, 0, 0])
        flat = self.per_unit[sensor, 0, 0, 1] == 0
        return plane[:1] if flat else plane, self.origins[sensor, 0, 0], step


@dataclass(frozen=True)
class _Planes:
    """Where the planes of L sensors lie, in cells and in the table."""

    steps: Floats  # (L,)
    origins: Floats  # (L, 2)
    shapes: Indices  # (L, 2), pages along u and v
    offsets: Indices  # (L,)
    two: NDArray[np.bool_]  # (L,), whether the sensor has two coordinates


@dataclass(frozen=True)
class _Pages:
    """Squares that are drawn, as places in the table, and three layers (S, side, side) of them."""

    cells: Indices
    layers: Sequence[Singles]


def draw(
    patterns: Sequence[Pattern],
    sigmas: Sequence[float],
    steps_per_sigma: float,
    near: Sequence[Floats | None],
) -> Atlas:
    """Draw patterns, blurred and normalised.

    Parameters
    ----------
    patterns : sequence of PointPattern or GridPattern
        One per sensor, not empty.
    sigmas : sequence of float
        Standard deviation of the blur per sensor, in sensor units.
    steps_per_sigma : float
        Cells per standard deviation.  The zero of the looked-up gradient errs by 5e-4 standard
        deviations at 3, 2e-4 at 4 and 3e-5 at 8.
    near : sequence of (n, m) array or None
        Places of predicted features, about which alone a sensor's density is wanted (within
        2 `REACH` standard deviations); None: wherever it is not zero.
    """
    steps = np.asarray(sigmas, dtype=np.float64) / steps_per_sigma
    reach = REACH * steps_per_sigma
    # looking up linearly is one more blur by a triangle, averaged over the places within a cell
    narrowed = steps * np.sqrt(steps_per_sigma**2 - 1 / 6)
    kept = [_nearby(one, places, 6 * REACH * s) for one, places, s in zip(patterns, near, sigmas)]
    planes = _planes(kept, steps, reach)
    drawn = []
    detected = [k for k, pattern in enumerate(kept) if isinstance(pattern, PointPattern)]
    if detected:
        drawn.append(_pages_of_points(kept, detected, planes, narrowed, reach))
    for k, pattern in enumerate(kept):
        if isinstance(pattern, GridPattern):
            drawn.append(_pages_of_grid(pattern, k, planes, float(narrowed[k]), reach, near[k]))
    count = 1 + sum(len(pages.cells) for pages in drawn)
    table = np.zeros(int(planes.offsets[-1] + planes.shapes[-1].prod()), dtype=np.intp)
    first = 1
    for pages in drawn:
        table[pages.cells] = np.arange(first, first + len(pages.cells))
        first += len(pages.cells)
    values, corners = _packed(drawn, count)
    per_unit = np.stack([1 / steps, planes.two / steps], axis=1)
    return Atlas(
        values=values,
        table=table,
        corners=corners,
        origins=planes.origins[:, None, None],
        per_unit=per_unit[:, None, None],
        limits=(planes.shapes * PAGE - 1e-3)[:, None, None],
        strides=planes.shapes[:, 0, None, None],
        offsets=planes.offsets[:, None, None],
    )


def _packed(drawn: Sequence[_Pages], count: int) -> tuple[Singles, Floats]:
    """All pages in one array, below one another, in several columns where they are many."""
    side = PAGE + 1
    columns = -(-count // _ROWS)
    rows = -(-count // columns)
    stacked = np.empty((3, columns, rows * side, side), dtype=np.float32)
    flat = stacked.reshape(3, -1, side, side)
    flat[:, 0], flat[:, count:] = 0.0, 0.0
    for k in range(3):
        first = 1
        for pages in drawn:
            flat[k, first : first + len(pages.cells)] = pages.layers[k]
            first += len(pages.cells)
    layers = [grid[0] if columns == 1 else np.hstack(list(grid)) for grid in stacked]
    number = np.arange(rows * columns)
    corners = side * np.stack([number // rows, number % rows], axis=1).astype(np.float64)
    return np.asarray(cv2.merge(layers), dtype=np.float32), corners


def _nearby(pattern: Pattern, near: Floats | None, margin: float) -> Pattern:
    """Detections within a margin of the box of predicted features, with the weight of all."""
    if isinstance(pattern, GridPattern):
        return pattern
    points, weights = pattern.points, pattern.weights / pattern.weights.sum()
    if near is not None and len(near):
        lower, upper = near.min(axis=0) - margin, near.max(axis=0) + margin
        kept = ((points >= lower) & (points <= upper)).all(axis=1)
        points, weights = points[kept], weights[kept]
    return PointPattern(points, weights)


def _planes(patterns: Sequence[Pattern], steps: Floats, reach: float) -> _Planes:
    """Planes around what each sensor saw, with a ring of pages that are never drawn.

    What is too far from the middle of its pattern for a table of `MOST_PAGES` is outside.
    """
    L = len(patterns)
    origins, shapes = np.zeros((L, 2)), np.ones((L, 2), dtype=np.intp)
    two = np.zeros(L, dtype=np.bool_)
    for k, (pattern, step) in enumerate(zip(patterns, steps.tolist(), strict=True)):
        if isinstance(pattern, PointPattern):
            places = pattern.points
        else:
            size = np.array(pattern.values.shape[::-1])[: len(pattern.origin)] - 1
            places = np.array([pattern.origin, pattern.origin + size * pattern.step])
        m = places.shape[1]
        two[k] = m == 2
        if not len(places):
            continue
        lower, upper = places.min(axis=0), places.max(axis=0)
        if math.prod(((upper - lower) / (PAGE * step) + 2).tolist()) > MOST_PAGES:
            middle, half = np.median(places, axis=0), PAGE * step * MOST_PAGES ** (1 / m) / 2.5
            lower, upper = np.maximum(lower, middle - half), np.minimum(upper, middle + half)
        origins[k, :m] = lower - (reach + PAGE) * step
        shapes[k, :m] = np.ceil((upper - lower) / (PAGE * step) + 2 * reach / PAGE) + 3
    offsets = np.concatenate([[0], np.cumsum(shapes.prod(axis=1))[:-1]]).astype(np.intp)
    return _Planes(steps, origins, shapes, offsets, two)


def _squares(
    q: Floats, shapes: Indices, two: NDArray[np.bool_], reach: float
) -> tuple[Indices, Indices, Indices]:
    """Columns and rows of the pages within reach of places (K, 2) in cells, and whose they are."""
    first = np.maximum((q - reach) * (1 / PAGE), 1.0).astype(np.intp)
    last = np.minimum(np.floor((q + reach) * (1 / PAGE)), shapes - 2).astype(np.intp)
    first[~two, 1] = last[~two, 1] = 0
    spans = np.arange(max(int((last - first).max(initial=0)), 0) + 1)
    each = first[:, :, None] + spans
    inside = each <= last[:, :, None]
    source, iv, iu = np.nonzero(inside[:, 1, :, None] & inside[:, 0, None])
    return each[source, 0, iu], each[source, 1, iv], source


def _pages_of_points(
    patterns: Sequence[Pattern], chosen: Sequence[int], planes: _Planes, sigmas: Floats, reach: float
) -> _Pages:
    """Pages within reach of detections, which are drawn as exact Gaussians."""
    points = [p.points for p in patterns if isinstance(p, PointPattern)]
    sensor = np.repeat(np.array(chosen), [len(each) for each in points])
    places = np.zeros((len(sensor), 2))
    row = 0
    for each in points:
        places[row : row + len(each), : each.shape[1]] = each
        row += len(each)
    weights = np.concatenate([p.weights for p in patterns if isinstance(p, PointPattern)])
    two, step, sigma = planes.two[sensor], planes.steps[sensor], sigmas[sensor]
    q = (places - planes.origins[sensor]) / step[:, None]
    u, v, source = _squares(q, planes.shapes[sensor], two, reach)
    cells = planes.offsets[sensor][source] + v * planes.shapes[sensor, 0][source] + u
    order = np.argsort(cells, kind="stable")
    cells, source = cells[order], source[order]
    page = np.stack([u[order], v[order]], axis=1)
    away = (PAGE * page - q[source])[:, :, None] + np.arange(PAGE + 1)
    away *= (step / sigma)[source][:, None, None]
    bells = np.exp(-0.5 * away * away)
    slopes = bells * away * (-1 / sigma)[source][:, None, None]
    height = weights / (np.sqrt(2 * np.pi) * sigma) ** (1 + two)
    bells[:, 0] *= height[source][:, None]
    slopes[:, 0] *= height[source][:, None]
    if not two.all():  # one row, which does not change across
        flat = ~two[source]
        bells[flat, 1], slopes[flat, 1] = 1.0, 0.0
    bells, slopes = bells.astype(np.float32), slopes.astype(np.float32)
    along = bells[:, 0, None], slopes[:, 0, None]
    across = bells[:, 1, :, None], slopes[:, 1, :, None]
    factors_of = ((across[0], along[0]), (across[0], along[1]), (across[1], along[0]))
    is_new = np.diff(cells, prepend=-1) > 0
    layers = [_summed(a, b, is_new) for a, b in factors_of]
    return _Pages(cells[is_new], layers)


def _summed(v: Singles, u: Singles, is_new: NDArray[np.bool_]) -> Singles:
    """Products of columns (K, side, 1) and rows (K, 1, side), summed over those of one page."""
    if is_new.all():
        return v * u
    pages = v[is_new] * u[is_new]
    begins = np.flatnonzero(is_new)
    page = np.cumsum(is_new) - 1
    rank = np.arange(len(is_new)) - begins[page]
    for k in range(1, int(rank.max()) + 1):
        more = rank == k
        pages[page[more]] += v[more] * u[more]
    return pages


def _pages_of_grid(
    pattern: GridPattern, k: int, planes: _Planes, sigma: float, reach: float, near: Floats | None
) -> _Pages:
    """Pages about predicted features, or all, summed over the points of a grid."""
    origin, step, shape = planes.origins[k], float(planes.steps[k]), planes.shapes[k]
    two, side = bool(planes.two[k]), PAGE + 1
    if near is None or not len(near):
        inner = np.arange(1, shape[1] - 1) if two else np.zeros(1, dtype=np.intp)
        cells = (inner[:, None] * shape[0] + np.arange(1, shape[0] - 1)).ravel()
    else:
        q = np.zeros((len(near), 2))
        q[:, : near.shape[1]] = near
        q = (q - origin) / step
        u, v, _ = _squares(q, shape[None], np.full(len(q), two), 2 * reach)
        cells = np.unique(v * shape[0] + u)
    columns, iu = np.unique(cells % shape[0], return_inverse=True)
    rows, iv = np.unique(cells // shape[0], return_inverse=True)
    places = [
        origin[axis] + step * (PAGE * pages[:, None] + np.arange(side)).ravel()
        for axis, pages in enumerate((columns, rows))
    ]
    small, left_over = reduced(pattern, sigma)
    made = factors(small, left_over, places[0], places[1] if two else None)
    along = [each.reshape(len(each), len(columns), side) for each in made[2:]]
    if not two:
        layers = [np.zeros((len(cells), side, side), dtype=np.float32) for _ in range(3)]
        layers[0][:, 0], layers[1][:, 0] = along[0][0, iu], along[1][0, iu]
        return _Pages(planes.offsets[k] + cells, layers)
    across = [each.reshape(len(each), len(rows), side) for each in made[:2]]
    U = [np.ascontiguousarray(each[:, iu].swapaxes(0, 1)) for each in along]
    V = [np.ascontiguousarray(each[:, iv].transpose(1, 2, 0)) for each in across]
    return _Pages(planes.offsets[k] + cells, [V[0] @ U[0], V[0] @ U[1], V[1] @ U[0]])
