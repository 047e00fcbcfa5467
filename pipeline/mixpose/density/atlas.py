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
    """Squares that are drawn, as places in the table, and layers (3, 1 + S, side, side).

    The first page of the layers is empty.
    """

    cells: Indices
    layers: Singles


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
    narrowed = steps * math.sqrt(steps_per_sigma**2 - 1 / 6)
    bounds = [_bounds(one, places, 6 * REACH * s) for one, places, s in zip(patterns, near, sigmas)]
    points = [places for places, _ in bounds]
    planes = _planes(points, [_dimension(pattern) for pattern in patterns], steps, reach)
    drawn = []
    detected = [k for k, pattern in enumerate(patterns) if isinstance(pattern, PointPattern)]
    if detected:
        some = [bounds[k] for k in detected]
        drawn.append(_pages_of_points(some, np.array(detected), planes, narrowed, reach))
    for k, pattern in enumerate(patterns):
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
    if len(drawn) == columns == 1:
        layers = drawn[0].layers.reshape(3, -1, side)
    else:
        stacked = np.zeros((3, columns, rows * side, side), dtype=np.float32)
        parts = [pages.layers[:, 1:] for pages in drawn]
        stacked.reshape(3, -1, side, side)[:, 1:count] = np.concatenate(parts, axis=1)
        layers = stacked.swapaxes(1, 2).reshape(3, rows * side, columns * side)
    number = np.arange(rows * columns)
    corners = np.zeros((rows * columns, 2))
    corners[:, 0], corners[:, 1] = side * (number // rows), side * (number % rows)
    return np.asarray(cv2.merge(list(layers)), dtype=np.float32), corners


def _dimension(pattern: Pattern) -> int:
    if isinstance(pattern, PointPattern):
        return int(pattern.points.shape[1])
    return len(pattern.origin)


def _bounds(pattern: Pattern, near: Floats | None, margin: float) -> tuple[Floats, Floats]:
    """Detections with normalised weights, in the box of predicted features; corners of a grid."""
    if isinstance(pattern, GridPattern):
        size = np.array(pattern.values.shape[::-1])[: len(pattern.origin)] - 1
        return np.array([pattern.origin, pattern.origin + size * pattern.step]), np.zeros(2)
    points, weights = pattern.points, pattern.weights / pattern.weights.sum()
    if near is not None and len(near):
        lower, upper = near.min(axis=0) - margin, near.max(axis=0) + margin
        kept = ((points >= lower) & (points <= upper)).all(axis=1)
        kept[:1] |= not kept.any()  # a plane lies somewhere
        points, weights = points[kept], weights[kept]
    return points, weights


def _together(points: Sequence[Floats]) -> tuple[Floats, Indices, Indices]:
    """Places (K, 2) of all sensors, how many each has, and where each begins."""
    counts = np.array([len(each) for each in points])
    begins = np.concatenate([[0], np.cumsum(counts)[:-1]])
    if all(each.shape[1] == 2 for each in points):
        return np.concatenate(points), counts, begins
    places = np.zeros((int(counts.sum()), 2))
    for each, begin in zip(points, begins.tolist(), strict=True):
        places[begin : begin + len(each), : each.shape[1]] = each
    return places, counts, begins


def _planes(
    points: Sequence[Floats], dimensions: Sequence[int], steps: Floats, reach: float
) -> _Planes:
    """Planes around places (K, m) of each sensor, with a ring of pages that are never drawn.

    What is too far from the middle of its places for a table of `MOST_PAGES` is outside.
    """
    two = np.array(dimensions) == 2
    places, _, begins = _together(points)
    lower = np.minimum.reduceat(places, begins)
    upper = np.maximum.reduceat(places, begins)
    pages = PAGE * steps[:, None]
    crowded = ((upper - lower) / pages + 2).prod(axis=1) > MOST_PAGES
    for k in np.flatnonzero(crowded).tolist():
        half = float(pages[k, 0]) * MOST_PAGES ** (1 / dimensions[k]) / 2.5
        middle = np.zeros(2)
        middle[: dimensions[k]] = np.median(points[k], axis=0)
        lower[k], upper[k] = np.maximum(lower[k], middle - half), np.minimum(upper[k], middle + half)
    shapes = (((upper - lower) / pages + (2 * reach / PAGE + 3)) + 1).astype(np.intp)
    origins = lower - (reach + PAGE) * steps[:, None]
    shapes[~two, 1], origins[~two, 1] = 1, 0.0
    offsets = np.concatenate([[0], np.cumsum(shapes.prod(axis=1))[:-1]])
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
    detections: Sequence[tuple[Floats, Floats]],
    chosen: Indices,
    planes: _Planes,
    sigmas: Floats,
    reach: float,
) -> _Pages:
    """Pages within reach of detections, which are drawn as exact Gaussians."""
    places, counts, _ = _together([points for points, _ in detections])
    weights = np.concatenate([weights for _, weights in detections])
    sensor = np.repeat(chosen, counts)
    two, step, sigma = planes.two[sensor], planes.steps[sensor], sigmas[sensor]
    q = (places - planes.origins[sensor]) / step[:, None]
    u, v, source = _squares(q, planes.shapes[sensor], two, reach)
    cells = planes.offsets[sensor][source] + v * planes.shapes[sensor, 0][source] + u
    order = np.argsort(cells, kind="stable")
    cells, source = cells[order], source[order]
    first = PAGE * np.stack([u[order], v[order]], axis=1) - q[source]
    scale = (step / sigma)[source]
    away = (first * scale[:, None]).astype(np.float32)[:, :, None]
    away = away + scale.astype(np.float32)[:, None, None] * np.arange(PAGE + 1, dtype=np.float32)
    bells = np.exp(np.float32(-0.5) * away * away)
    height = weights / (np.sqrt(2 * np.pi) * sigma) ** (1 + two)
    bells[:, 0] *= height.astype(np.float32)[source, None]
    slopes = bells * away
    slopes *= (-1 / sigma).astype(np.float32)[source, None, None]
    if not two.all():  # one row, which does not change across
        flat = ~two[source]
        bells[flat, 1], slopes[flat, 1] = 1.0, 0.0
    is_new = np.empty(len(cells), dtype=np.bool_)
    is_new[:1], is_new[1:] = True, cells[1:] > cells[:-1]
    layers = _summed(bells, slopes, is_new)
    return _Pages(cells[is_new], layers)


def _summed(bells: Singles, slopes: Singles, is_new: NDArray[np.bool_]) -> Singles:
    """Layers (3, 1 + S, side, side): products of rows and columns, summed over those of a page.

    Parameters
    ----------
    bells, slopes : (K, 2, side) array
        Gaussians along u and v, and their derivatives, by ascending page.
    is_new : (K,) bool
        Where a page begins.
    """
    side = bells.shape[2]
    page = np.cumsum(is_new)
    layers = np.empty((3, int(page[-1]) + 1 if len(page) else 1, side, side), dtype=np.float32)
    layers[:, 0] = 0.0
    begins = np.flatnonzero(is_new)
    alone = len(begins) == len(is_new)
    rank = np.zeros(1) if alone else np.arange(len(is_new)) - begins[page - 1]
    for k in range(int(rank.max()) + 1):
        chosen = slice(None) if alone else np.flatnonzero(rank == k)
        bell, slope = bells[chosen], slopes[chosen]
        u, v = bell[:, 0, None], bell[:, 1, :, None]
        products = ((v, u), (v, slope[:, 0, None]), (slope[:, 1, :, None], u))
        for layer, (rows, columns) in zip(layers, products, strict=True):
            if k == 0:
                np.multiply(rows, columns, out=layer[1:])
            else:
                layer[page[chosen]] += rows * columns
    return layers


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
    layers = np.zeros((3, 1 + len(cells), side, side), dtype=np.float32)
    if not two:
        layers[0, 1:, 0], layers[1, 1:, 0] = along[0][0, iu], along[1][0, iu]
        return _Pages(planes.offsets[k] + cells, layers)
    across = [each.reshape(len(each), len(rows), side) for each in made[:2]]
    U = [np.ascontiguousarray(each[:, iu].swapaxes(0, 1)) for each in along]
    V = [np.ascontiguousarray(each[:, iv].transpose(1, 2, 0)) for each in across]
    for layer, rows_, columns_ in zip(layers, (V[0], V[0], V[1]), (U[0], U[1], U[0]), strict=True):
        layer[1:] = rows_ @ columns_
    return _Pages(planes.offsets[k] + cells, layers)
