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
from mixpose.density.grid import FAR, remap
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
        Of every sensor; they lie below one another.
    """

    def __init__(
        self, patterns: Sequence[Pattern], sigmas: Sequence[float], steps_per_sigma: float
    ) -> None:
        L, n, reach = len(patterns), steps_per_sigma, REACH * steps_per_sigma + _BESIDE
        dimensions = [_dimension(pattern) for pattern in patterns]
        self._is_flat = np.array(dimensions) == 1
        self._sigma = math.sqrt(n**2 - _SPLINE)  # what is drawn, in cells
        widths = [sigma * self._sigma / n for sigma in sigmas]
        tops = [(math.sqrt(2 * np.pi) * w) ** -m for w, m in zip(widths, dimensions)]
        across = [(n / sigma, (m - 1) * n / sigma) for sigma, m in zip(sigmas, dimensions)]
        self.per_unit = np.array(across)[:, None, None]
        units = [(top, top / w, top / w) for top, w in zip(tops, widths)]
        self._units = np.array(units)[:, None, None]
        self._grids: dict[int, tuple[Pattern, float, float]] = {}
        corners: dict[int, Floats] = {}
        for k, pattern in enumerate(patterns):
            if isinstance(pattern, GridPattern):
                small, left = reduced(pattern, widths[k])
                self._grids[k] = small, left, mass(small)
                corners[k] = _corners(pattern) * across[k]
        detections = _Detections.of(patterns, self.per_unit)
        self.plane = plane = Plane.of(detections.q, corners, reach)
        self._cells = np.arange(plane.side, dtype=np.float32) * np.float32(1 / self._sigma)
        self._lower = np.zeros((L, 1, 1, 2))
        self._lower[:, 0, 0, 1] = plane.shape[1] * plane.page * np.arange(L)
        self._upper = self._lower + (np.array(plane.shape) * plane.page - 1e-3)
        self._origin = plane.origin - self._lower
        self._detections = detections = detections.on(plane, reach, self._origin)
        self.table = np.zeros(L * plane.squares, dtype=np.int32)
        self.table[detections.squares] = _PENDING
        for k, both in corners.items():
            (u, v), (last_u, last_v) = plane.squares_of(both + np.array([[-reach], [reach]]))
            squares = self.table.reshape(L, *plane.shape[::-1])[k]
            squares[v : last_v + 1, u : last_u + 1] = _PENDING
        self._most = detections.squares.size + len(corners) * plane.squares
        self._columns = self._most * plane.side // _LARGEST + 1
        self._drawn = self._columns  # the first row is of squares without anything
        self.values = np.zeros((plane.side, self._columns * plane.side, 3), dtype=np.float32)
        # from a place in the planes to one in the array, by page; from nothing out of the array
        self._shifts = np.array([(FAR, FAR)] * self._columns)

    def look_up(self, y: Floats) -> Floats:
        """Densities and gradients (L, H, n, 3) at places (L, H, n, 2)."""
        index = y * self.per_unit
        index -= self._origin
        np.maximum(index, self._lower, out=index)
        np.minimum(index, self._upper, out=index)
        squares = self._squares_of(index)
        number = self.table[squares]
        if number.min(initial=0) < 0:
            pending = number < 0
            self._draw(np.unique(squares[pending] if self._grids else self._around(index[pending])))
            number = self.table[squares]
        index += self._shifts[number]
        maps = index.reshape(-1, 2).T
        beside = maps - np.rint(maps)
        beside *= beside
        beside += 0.25
        around = _SIDES * beside[:, None]
        around += maps[:, None]
        u, v = around.reshape(2, -1).astype(np.float32)
        sampled = _QUARTERS @ remap(self.values, u, v).reshape(4, -1)
        return np.asarray(sampled.reshape(*y.shape[:-1], 3) * self._units)

    def _squares_of(self, index: Floats) -> Indices:
        """Squares of the table (...,) that hold places (..., 2) in cells."""
        columns_rows = (index * (1.0 / self.plane.page)).astype(np.intp)
        return np.asarray(columns_rows @ np.array([1, self.plane.shape[0]]))

    def _around(self, index: Floats) -> Indices:
        """The four squares around places (P, 2) in cells, those that are pending.

        Fits go on a little, and drawing once is cheaper than drawing twice.
        """
        columns = self.plane.shape[0]
        first = self._squares_of(index - 0.5 * self.plane.page)
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
            number = np.arange(self._drawn, self._drawn + count)
            self.table[some] = number
            corner = _across(some, self.plane.shape[0])
            corner *= self.plane.page
            corner -= 1.0
            shifts = _across(number, columns)
            shifts *= side
            self._shifts[self._drawn : self._drawn + count] = shifts - corner
            self._draw_detections(corner, pages)
            for k in self._grids:
                for i in np.flatnonzero(some // self.plane.squares == k).tolist():
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
            shifts = np.empty((most * columns, 2))
            shifts[: len(self._shifts)] = self._shifts
            self.values, self._shifts = values, shifts

    def _draw_detections(self, corner: Floats, pages: Singles) -> None:
        """Draw pages with corners (P, 2) in cells, the next ones, in place.

        They hold exact Gaussians: sums, over the detections that reach a page, of products of one
        along v and one along u, in three channels side by side.
        """
        side, found, count = self.plane.side, self._detections, len(corner)
        number = self.table[found.squares] - self._drawn
        of, which = np.nonzero(number >= 0)
        number = number[of, which]
        order = np.argsort(number, kind="stable")
        of, number = of[order], number[order]
        place = np.arange(len(number)) - np.searchsorted(number, number)  # in its page
        most = int(place.max(initial=0)) + 1
        begin = (found.q[of] - corner[number]) * (1 / self._sigma)
        away = begin.astype(np.float32)[..., None] - self._cells
        bells = np.exp(np.float32(-0.5) * away * away)
        if self._is_flat.any():  # rows that are all alike
            flat = self._is_flat[found.sensor[of]]
            bells[flat, 1], away[flat, 1] = 1.0, 0.0
        bells[:, 1] *= found.share[of, None]
        slopes = bells * away
        along_v = np.empty((len(number), 2, side), dtype=np.float32)
        along_v[:, 0], along_v[:, 1] = bells[:, 1], slopes[:, 1]
        along_u = np.zeros((len(number), 2, side, 3), dtype=np.float32)
        along_u[:, 0, :, 0] = along_u[:, 1, :, 2] = bells[:, 0]
        along_u[:, 0, :, 1] = slopes[:, 0]
        if len(number) < count * most:
            slots = most * number + place
            along_v, along_u = (_spread(one, slots, count * most) for one in (along_v, along_u))
        rows = along_v.reshape(*pages.shape[:2], 2 * most, side).swapaxes(2, 3)
        np.matmul(rows, along_u.reshape(*pages.shape[:2], 2 * most, 3 * side), out=pages)

    def _of_grid(self, sensor: int, corner: Floats) -> Singles:
        """A page (side, side, 3) of grey values or a profile, which begins at a corner (2,)."""
        pattern, sigma, total = self._grids[sensor]
        cells = corner + self._origin[sensor, 0, 0] + np.arange(self.plane.side)[:, None]
        u, v = (cells / self.per_unit[sensor, 0, 0, 0]).T
        flat = bool(self._is_flat[sensor])
        layers = factors(pattern, sigma, u, None if flat else v, total).layers(gradient=True)
        page = np.zeros((self.plane.side, self.plane.side, 3), dtype=np.float32)
        for channel, layer in enumerate(layers[: 2 if flat else 3]):
            page[..., channel] = layer / self._units[sensor, 0, 0, channel]
        return page


def _spread(rows: Singles, slots: Indices, count: int) -> Singles:
    """Rows in some of several slots, and zeros in the others."""
    spread = np.zeros((count, *rows.shape[1:]), dtype=np.float32)
    spread[slots] = rows
    return spread


def _across(numbers: Indices, columns: int) -> Floats:
    """Columns and rows (n, 2) of what is numbered row by row."""
    found = np.empty((len(numbers), 2))
    np.divmod(numbers, columns, out=(found[:, 1], found[:, 0]), casting="unsafe")
    return found


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
    def of(cls, q: Floats, corners: Mapping[int, Floats], reach: float) -> Plane:
        """A plane that holds detections (D, 2), and corners (2, 2) of grids, of all sensors.

        In cells.  Pages begin at whole ones from sensor coordinates 0, so that a density is the
        same whatever is seen beside it.  There is a rim of squares with nothing.
        """
        page = max(math.ceil(reach / REACH), MIN_GRID_PAGE) if corners else PAGE
        grids = np.concatenate(list(corners.values())) if corners else q
        places = q if len(q) else grids
        lower, upper = places.min(axis=0), places.max(axis=0)
        if len(q) and _count(lower, upper, page) > MANY_PAGES:
            several = math.ceil(page * math.sqrt(_count(lower, upper, page) / MANY_PAGES))
            page = min(several, math.ceil(2 * reach))
        is_cut = len(q) > 0 and _count(lower, upper, page) > MAX_PAGES
        if is_cut:
            middle, half = np.median(q, axis=0), page * math.sqrt(MAX_PAGES) / 2.5
            lower, upper = np.maximum(lower, middle - half), np.minimum(upper, middle + half)
        if corners:
            lower = np.minimum(lower, grids.min(axis=0))
            upper = np.maximum(upper, grids.max(axis=0))
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
        Places in cells, from sensor coordinates 0 or from the corner of the first plane.
    share : (D,) float32
        Of the sensor's density.
    sensor : (D,) int
    squares : (D, S) int
    """

    q: Floats
    share: Singles
    sensor: Indices
    squares: Indices

    @classmethod
    def of(cls, patterns: Sequence[Pattern], per_unit: Floats) -> _Detections:
        """All detections, not on a plane yet."""
        found = {k: one for k, one in enumerate(patterns) if isinstance(one, PointPattern)}
        if not found:
            none = np.zeros(0, dtype=np.intp)
            return cls(np.zeros((0, 2)), none.astype(np.float32), none, none[:, None])
        counts = np.array([len(one.points) for one in found.values()])
        sensor = np.array(list(found)).repeat(counts)
        q = np.concatenate([_in_plane(one.points) for one in found.values()])
        weights = np.concatenate([one.weights for one in found.values()])
        share = weights / np.bincount(sensor, weights)[sensor]
        q *= per_unit[sensor, 0, 0]
        return cls(q, share.astype(np.float32), sensor, sensor[:, None])

    def on(self, plane: Plane, reach: float, origin: Floats) -> _Detections:
        """The same on planes with origins (L, 1, 1, 2), but those too far away for theirs."""
        q, share, sensor, _ = self
        first = plane.squares_of(q - reach)
        beside = np.arange(int(2 * reach / plane.page) + 2)
        if plane.is_cut:
            inside = ((first >= 1) & (first < np.array(plane.shape) - len(beside))).all(axis=1)
            sensor, q, share, first = sensor[inside], q[inside], share[inside], first[inside]
        begin = plane.squares * sensor + first @ np.array([1, plane.shape[0]])
        squares = begin[:, None] + np.add.outer(plane.shape[0] * beside, beside).ravel()
        return _Detections(q - origin[sensor, 0, 0], share, sensor, squares)


def _dimension(pattern: Pattern) -> int:
    if isinstance(pattern, PointPattern):
        return int(pattern.points.shape[1])
    return len(pattern.origin)


def _corners(pattern: GridPattern) -> Floats:
    """Corners (2, 2) of a grid."""
    size = np.array(pattern.values.shape[::-1])[: len(pattern.origin)] - 1
    return _in_plane(np.array([pattern.origin, pattern.origin + size * pattern.step]))


def _in_plane(places: Floats) -> Floats:
    """Places (K, 2), with 0 for a missing coordinate."""
    if places.shape[1] == 2:
        return places
    return np.concatenate([places, np.zeros_like(places)], axis=1)
