"""Densities of all sensors as one image, drawn where they are looked up.

A density is nearly empty: detections are few, and a grid fine enough for gradients has millions of
points.  So the plane of every sensor is divided into square pages.  A page is drawn when it is
looked up for the first time, all pages of all sensors lie in one array (an atlas), and a table says
where.  `cv2.remap` looks all sensors up at once, values and gradients together.

Cells hold coefficients of quadratic B-splines, so that what is looked up bends smoothly from cell
to cell.  At a place d cells beside the nearest one, such a spline is the mean of four bilinear
look-ups, d² + 1/4 of a cell to either side along each axis.

Arrays have a leading axis L over sensors.  A sensor of one coordinate has 0 as its second, and its
pages have equal rows.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from mixpose.density.blur import factors, mass, reduced
from mixpose.density.grid import remap
from mixpose.records import GridPattern, Pattern, PointPattern

Floats: TypeAlias = NDArray[np.float64]
Singles: TypeAlias = NDArray[np.float32]
Indices: TypeAlias = NDArray[np.intp]

REACH = 4.25
"""Standard deviations around a detection that are drawn: features farther apart draw each other by
less than 1e-3 σ_ε."""

PAGE = 12
"""Cells along the side of a page: three standard deviations of detections.  Four such pages around
a place reach half a page beyond it, as far as a fit moves; larger ones are drawn for little use."""

MIN_GRID_PAGE = 18
"""The same of grey values alone, at least; as a rule a standard deviation."""

MANY_PAGES = 40_000
"""Pages of a sensor's plane from which they become larger, up to what a detection fills."""

MAX_PAGES = 400_000
"""Pages of a sensor's plane; detections that are too far from their middle for it are left out,
and pages of grey values are larger."""

_SPLINE = 1 / 4  # squared cells: the variance of a quadratic B-spline, by which look-ups blur
_LARGEST = 32000  # side of the array: cv2.remap takes less than 32767
_AT_ONCE = 100_000  # cells that are drawn together: what is made for them stays in the cache
_PENDING = -1  # in the table: not drawn yet
_SIDES = np.array([[-1, 1, -1, 1], [-1, -1, 1, 1]], dtype=np.float64)[..., None]
_QUARTERS = np.full(4, 0.25, dtype=np.float32)
_BESIDE = 2.0  # cells beside a place that are looked up, at most


class Atlas:
    """Densities with gradients of L sensors.

    Parameters
    ----------
    patterns : sequence of PointPattern or GridPattern
        One per sensor, not empty; each is blurred and normalised.
    sigmas : sequence of float
        Standard deviation of the blur per sensor, in sensor units.
    steps_per_sigma : float
        Cells per standard deviation, n.

    Attributes
    ----------
    values : (rows, columns, 3) float32
        Pages with one cell more on every side, which look-ups reach: the density as a share of a
        lone detection's peak, and its gradient per standard deviation.
    table : (L · squares,) int
        Number of the page of each square of a plane, plane after plane and row by row; 0 where
        there is nothing, negative where nothing was looked up yet.
    per_unit : (L, 1, 1, 2) float64
        Cells per sensor unit; 0 for the missing coordinate of ranges.
    plane : Plane
    """

    def __init__(
        self, patterns: Sequence[Pattern], sigmas: Sequence[float], steps_per_sigma: float
    ) -> None:
        L, sigma, reach = len(patterns), np.array(sigmas), REACH * steps_per_sigma + _BESIDE
        dimensions = np.array([_dimension(pattern) for pattern in patterns])
        self._flat = dimensions == 1
        self.per_unit = np.empty((L, 1, 1, 2))
        self.per_unit[:, 0, 0, 0] = steps_per_sigma / sigma
        self.per_unit[:, 0, 0, 1] = ~self._flat * steps_per_sigma / sigma
        self._sigma = math.sqrt(steps_per_sigma**2 - _SPLINE)  # what is drawn, in cells
        width = sigma * (self._sigma / steps_per_sigma)
        self._units = np.empty((L, 1, 1, 3))
        self._units[:, 0, 0, 0] = (math.sqrt(2 * np.pi) * width) ** -dimensions
        self._units[:, 0, 0, 1:] = self._units[:, 0, 0, :1] / width[:, None]
        places = [_places(pattern) * per[0, 0] for pattern, per in zip(patterns, self.per_unit)]
        self._grids: dict[int, tuple[Pattern, float, float]] = {}
        for k, pattern in enumerate(patterns):
            if isinstance(pattern, GridPattern):
                small, left = reduced(pattern, float(width[k]))
                self._grids[k] = small, left, mass(small)
        self.plane = Plane.of(places, self._grids, reach)
        self._first = (self.plane.squares * np.arange(L))[:, None, None]
        self._limit = np.array(self.plane.shape) * self.plane.page - 1e-3
        self._detections = _detections(patterns, places, self.plane, reach)
        self.table = np.zeros(L * self.plane.squares, dtype=np.int32)
        self.table[self._detections.squares] = _PENDING
        for k in self._grids:
            (u, v), (last_u, last_v) = self.plane.squares_of(places[k] + [[-reach], [reach]])
            plane = self.table.reshape(L, *self.plane.shape[::-1])[k]
            plane[v : last_v + 1, u : last_u + 1] = _PENDING
        self._most = self._detections.squares.size + len(self._grids) * self.plane.squares
        self._columns = self._most * self.plane.side // _LARGEST + 1
        self._drawn = self._columns  # the first row is of squares without anything
        side = self.plane.side
        self.values = np.zeros((side, self._columns * side, 3), dtype=np.float32)

    def look_up(self, y: Floats) -> Floats:
        """Densities and gradients (L, H, n, 3) at places (L, H, n, 2)."""
        index = y * self.per_unit
        index -= self.plane.origin
        np.maximum(index, 0.0, out=index)
        np.minimum(index, self._limit, out=index)
        square = (index * (1.0 / self.plane.page)).astype(np.intp)
        squares = square[..., 0] + self.plane.shape[0] * square[..., 1] + self._first
        number = self.table[squares]
        if number.min(initial=0) < 0:
            if self._grids:
                squares_to_draw = squares[number < 0]
            else:
                squares_to_draw = self._around(index, number < 0)
            self._draw(np.unique(squares_to_draw))
            number = self.table[squares]
        corner = np.empty(index.shape)
        np.divmod(number, self._columns, out=(corner[..., 1], corner[..., 0]), casting="unsafe")
        corner *= self.plane.side
        corner += 1.0
        index -= square * self.plane.page
        index += corner
        maps = index.reshape(-1, 2).T
        beside = maps - np.rint(maps)
        beside *= beside
        beside += 0.25
        around = _SIDES * beside[:, None]
        around += maps[:, None]
        u, v = around.reshape(2, -1).astype(np.float32)
        sampled = _QUARTERS @ remap(self.values, u, v).reshape(4, -1)
        return np.asarray(sampled.reshape(*y.shape[:-1], 3) * self._units)

    def _around(self, index: Floats, pending: NDArray[np.bool_]) -> Indices:
        """The four squares around places (L, H, n, 2) in cells that lie on pending ones.

        Fits go on a little, and drawing once is cheaper than drawing twice.
        """
        where = np.nonzero(pending)
        corner = (index[where] * (1.0 / self.plane.page) - 0.5).astype(np.intp)
        columns = self.plane.shape[0]
        first = self.plane.squares * where[0] + corner[:, 0] + columns * corner[:, 1]
        squares = first[:, None] + np.array([0, 1, columns, columns + 1])
        return np.asarray(squares[self.table[squares] < 0])

    def _draw(self, squares: Indices) -> None:
        """Draw the pages of pending squares of the table, none of which is twice."""
        side, columns = self.plane.side, self._columns
        at_once = max(_AT_ONCE // side**2, columns)
        if len(squares) > at_once:  # pages of as many detections are drawn together
            reached = np.bincount(self._detections.squares.ravel(), minlength=len(self.table))
            squares = squares[np.argsort(reached[squares], kind="stable")]
        self._reserve(len(squares))
        while len(squares):
            row, column = divmod(self._drawn, columns)
            whole = 0 if column else min(len(squares), at_once) // columns
            count = whole * columns or min(len(squares), columns - column)
            some, squares = squares[:count], squares[count:]
            room = self.values[row * side : (row + max(whole, 1)) * side]
            room = room.reshape(-1, side, columns, 3 * side).swapaxes(1, 2)
            pages = room if whole else room[:, column : column + count]
            self.table[some] = np.arange(self._drawn, self._drawn + count)
            sensor, square = np.divmod(some, self.plane.squares)
            corner = np.empty((count, 2))
            rows_columns = corner[:, 1], corner[:, 0]
            np.divmod(square, self.plane.shape[0], out=rows_columns, casting="unsafe")
            corner *= self.plane.page
            corner -= 1
            self._draw_detections(corner, pages)
            for k in self._grids:
                for i in np.flatnonzero(sensor == k).tolist():
                    page = pages[i // pages.shape[1], i % pages.shape[1]]
                    page[...] = self._of_grid(k, corner[i]).reshape(page.shape)
            self._drawn += count

    def _reserve(self, pages: int) -> None:
        """Make room for further pages."""
        side, columns = self.plane.side, self._columns
        rows = -(-(self._drawn + pages) // columns)
        if rows * side > len(self.values):
            # so large that allocators keep it from frame to frame; memory that is not written to
            # is free
            most = max(min(4 * rows, self._most // columns + 2), rows)
            values = np.empty((most * side, *self.values.shape[1:]), dtype=np.float32)
            values[: len(self.values)] = self.values
            self.values = values

    def _draw_detections(self, corner: Floats, pages: Singles) -> None:
        """Draw pages with corners (P, 2) in cells, the next ones, in place.

        They hold exact Gaussians: sums, over the detections that reach a page, of products of one
        along v and one along u, in three channels side by side.
        """
        side, found, count = self.plane.side, self._detections, len(corner)
        number = self.table[found.squares] - self._drawn
        of, which = np.nonzero(number >= 0)
        number = number[of, which]
        place = np.zeros_like(number)  # among the detections of its page
        if len(number) > len(corner):
            order = np.argsort(number, kind="stable")
            of, number = of[order], number[order]
            place = np.arange(len(number)) - np.searchsorted(number, number)
        most = int(place.max(initial=0)) + 1
        away = ((found.q[of] - corner[number]) * (1 / self._sigma)).astype(np.float32)[..., None]
        away = away - np.arange(side, dtype=np.float32) * np.float32(1 / self._sigma)
        bells = np.exp(np.float32(-0.5) * away * away)
        if self._flat.any():  # rows that are all alike
            flat = self._flat[found.sensor[of]]
            bells[flat, 1], away[flat, 1] = 1.0, 0.0
        bells[:, 1] *= found.share[of, None]
        slopes = bells * away
        along_v = np.zeros((count, most, 2, side), dtype=np.float32)
        along_u = np.zeros((count, most, 2, side, 3), dtype=np.float32)
        along_v[number, place, 0], along_v[number, place, 1] = bells[:, 1], slopes[:, 1]
        along_u[number, place, 0, :, 0] = along_u[number, place, 1, :, 2] = bells[:, 0]
        along_u[number, place, 0, :, 1] = slopes[:, 0]
        rows = along_v.reshape(*pages.shape[:2], 2 * most, side).swapaxes(2, 3)
        np.matmul(rows, along_u.reshape(*pages.shape[:2], 2 * most, 3 * side), out=pages)

    def _of_grid(self, sensor: int, corner: Floats) -> Singles:
        """A page (side, side, 3) of grey values or a profile, which begins at a corner (2,)."""
        pattern, sigma, total = self._grids[sensor]
        cells = corner + self.plane.origin + np.arange(self.plane.side)[:, None]
        u, v = (cells / self.per_unit[sensor, 0, 0, 0]).T
        flat = bool(self._flat[sensor])
        layers = factors(pattern, sigma, u, None if flat else v, total).layers(gradient=True)
        page = np.zeros((self.plane.side, self.plane.side, 3), dtype=np.float32)
        for channel, layer in enumerate(layers[: 2 if flat else 3]):
            page[..., channel] = layer / self._units[sensor, 0, 0, channel]
        return page


class Plane(NamedTuple):
    """The plane of every sensor: origin in cells, pages along u and v, and cells along a page.

    `is_cut` where some detections are too far away for it.
    """

    origin: Floats
    shape: tuple[int, int]
    page: int
    is_cut: bool = False

    @property
    def squares(self) -> int:
        """Number of pages."""
        return self.shape[0] * self.shape[1]

    @property
    def side(self) -> int:
        """Cells along a page that is drawn, with those around it."""
        return self.page + 3

    def squares_of(self, q: Floats) -> Indices:
        """Columns and rows (..., 2) of squares that hold places (..., 2) in cells."""
        return np.floor((q - self.origin) * (1.0 / self.page)).astype(np.intp)

    @classmethod
    def of(cls, places: Sequence[Floats], grids: Mapping[int, object], reach: float) -> Plane:
        """A plane that holds detections, and corners of grids, of all sensors (K, 2) in cells.

        Pages begin at whole ones from sensor coordinates 0, so that a density is the same whatever
        is seen beside it.  There is a rim of squares with nothing.
        """
        q = np.concatenate([one for k, one in enumerate(places) if k not in grids] or places)
        page = max(math.ceil(reach / REACH), MIN_GRID_PAGE) if grids else PAGE
        lower, upper = q.min(axis=0), q.max(axis=0)
        if len(grids) < len(places) and _count(lower, upper, page) > MANY_PAGES:
            several = math.ceil(page * math.sqrt(_count(lower, upper, page) / MANY_PAGES))
            page = min(several, math.ceil(2 * reach))
        is_cut = len(grids) < len(places) and _count(lower, upper, page) > MAX_PAGES
        if is_cut:
            middle, half = np.median(q, axis=0), page * math.sqrt(MAX_PAGES) / 2.5
            lower, upper = np.maximum(lower, middle - half), np.minimum(upper, middle + half)
        if grids:
            corners = np.concatenate([places[k] for k in grids])
            lower = np.minimum(lower, corners.min(axis=0))
            upper = np.maximum(upper, corners.max(axis=0))
            page = math.ceil(page * max(math.sqrt(_count(lower, upper, page) / MAX_PAGES), 1.0))
        # half a cell is left, lest rounding puts a place on a square of the rim
        origin = page * np.floor((lower - (reach + page + 0.5)) / page)
        columns, rows = ((upper - lower + 2 * reach) / page).tolist()
        return cls(origin, (int(columns) + 5, int(rows) + 5), page, is_cut)


def _count(lower: Floats, upper: Floats, page: int) -> float:
    """Pages of a box in cells, about."""
    columns, rows = ((upper - lower) / page + 5).tolist()
    return float(columns * rows)


class _Detections(NamedTuple):
    """Detections of all sensors, and the squares of the table that they reach.

    Attributes
    ----------
    q : (D, 2) float64
        Places, in cells from the origin of the plane.
    share : (D,) float32
        Of the sensor's density.
    sensor : (D,) int
    squares : (D, S) int
    """

    q: Floats
    share: Singles
    sensor: Indices
    squares: Indices


def _detections(
    patterns: Sequence[Pattern], places: Sequence[Floats], plane: Plane, reach: float
) -> _Detections:
    """All detections but those that are too far away for the plane."""
    parts = [
        (np.full(len(q), k), q, pattern.weights / pattern.weights.sum())
        for k, (pattern, q) in enumerate(zip(patterns, places, strict=True))
        if isinstance(pattern, PointPattern)
    ]
    if not parts:
        parts = [(np.zeros(0, dtype=np.intp), np.zeros((0, 2)), np.zeros(0))]
    sensor, q, share = (np.concatenate(column) for column in zip(*parts, strict=True))
    first = plane.squares_of(q - reach)
    beside = np.arange(int(2 * reach / plane.page) + 2)
    if plane.is_cut:
        inside = ((first >= 1) & (first < np.array(plane.shape) - len(beside))).all(axis=1)
        sensor, q, share, first = sensor[inside], q[inside], share[inside], first[inside]
    begin = plane.squares * sensor + first[:, 0] + plane.shape[0] * first[:, 1]
    squares = begin[:, None] + np.add.outer(plane.shape[0] * beside, beside).ravel()
    return _Detections(q - plane.origin, share.astype(np.float32), sensor, squares)


def _dimension(pattern: Pattern) -> int:
    if isinstance(pattern, PointPattern):
        return int(pattern.points.shape[1])
    return len(pattern.origin)


def _places(pattern: Pattern) -> Floats:
    """Detections (K, 2), or the corners (2, 2) of a grid; 0 for a missing coordinate."""
    if isinstance(pattern, PointPattern):
        places = pattern.points
    else:
        size = np.array(pattern.values.shape[::-1])[: len(pattern.origin)] - 1
        places = np.array([pattern.origin, pattern.origin + size * pattern.step])
    if places.shape[1] == 1:
        places = np.concatenate([places, np.zeros_like(places)], axis=1)
    return places
