"""Densities of all sensors as images, drawn only where they are looked up.

A density is nearly empty, so small tiles of it are drawn, of all sensors into one array (an atlas)
that `cv2.remap` looks up at once, values and gradients together.  Few places, as at the start of a
fit, have a tile each, in which they stay while the pose moves a little.  For many places the plane
of every sensor is divided into pages, tiles with numbers in a table.

Cells hold coefficients of quadratic B-splines, so that values are smooth across cells.  At a place
d cells beside the nearest one, such a spline is the mean of four bilinear look-ups, d² + 1/4 of a
cell to either side along each axis.

A sensor of one coordinate has 0 as its second, and its tiles have equal rows.  Cells are counted
from sensor coordinates 0, so that a density does not depend on what else is seen.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import cached_property, lru_cache
from typing import Any, NamedTuple

import cv2
import numpy as np
from scipy.spatial import cKDTree

from mixpose.density.blur import DRAWING, blurred, mass, reduced
from mixpose.records import Floats, GridPattern, Indices, Mask, Pattern, Singles

# tiles that are drawn at once, each with room for as many detections
_TOGETHER = math.isqrt(DRAWING.few_pairs)
_EXTRA_PAGES = 5  # along a side of a box, more than its size has


def remap(values: Singles, u: Singles, v: Singles) -> Any:
    """Sample an array bilinearly at indices (...) along columns and rows: (..., C); 0 outside."""
    if u.ndim == 2 and u.size and max(u.shape) <= DRAWING.side:
        return cv2.remap(values, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
    count, channels, width = u.size, values.shape[2:], min(max(u.size, 1), DRAWING.side)
    padding = -count % width if count else 1
    maps = [np.pad(index.ravel(), (0, padding)).reshape(-1, width) for index in (u, v)]
    return remap(values, *maps).reshape(-1, *channels)[:count].reshape(*u.shape, *channels)


class Atlas:
    """Densities with gradients of L sensors.

    Patterns, one per sensor and none of them empty, are blurred by standard deviations `sigmas`, in
    sensor units, of n = `steps_per_sigma` cells each, and normalised.
    """

    _sides = np.array([[-1, 1, -1, 1], [-1, -1, 1, 1]], dtype=np.float64)[..., None]
    _quarters = np.full(4, 0.25, dtype=np.float32)

    def __init__(
        self, patterns: Sequence[Pattern], sigmas: Sequence[float], steps_per_sigma: float
    ) -> None:
        dimensions = tuple([pattern.dimension for pattern in patterns])
        self._scale = scale = _Scale.of(dimensions, tuple(sigmas), steps_per_sigma)
        # (L, 1, 1, 2) cells per sensor unit; 0 for the missing coordinate of ranges
        self.per_unit = scale.per_unit
        # (rows, columns, 3) tiles that were looked up last, in units of `_Scale`
        self.values: Singles = np.zeros((0, 0, 3), dtype=np.float32)
        # grids with the remaining blur, the mass, and the corners (2, 2) in cells
        self._grids: dict[int, tuple[GridPattern, float, float, Floats]] = {}
        q, share, counts = [np.zeros((0, 2))], [np.zeros(0)], [0] * len(patterns)
        for k, pattern in enumerate(patterns):
            if isinstance(pattern, GridPattern):
                small, blur = reduced(pattern, scale.widths[k])
                corners = np.array(small.extent) * scale.per_unit[k, 0, 0]
                self._grids[k] = small, blur, mass(small), corners
                continue
            counts[k] = len(pattern.points)
            q.append(pattern.points * scale.per_unit[k, 0, 0])
            weights = pattern.effective_weights(DRAWING.exact * sigmas[k])
            share.append(weights / weights.sum())
        self._q, self._share = np.concatenate(q), np.concatenate(share).astype(np.float32)
        self._sensor = np.arange(len(counts)).repeat(counts)
        # cells along the part of a tile in which places may lie
        self.tile = max(math.ceil(steps_per_sigma), DRAWING.tile)
        # places (L, H, n, 2) in cells, shifts from there to the array of their tiles, and the array
        self._own: tuple[Floats, Floats, Singles] = np.zeros(0), np.zeros(0), self.values
        if self._grids:  # the larger the plane, the larger its pages
            self.tile = self.pages.page
        self._side, self._reach = self.tile + DRAWING.rim, 0.5 * self.tile + scale.reach

    def look_up(self, y: Floats) -> Floats:
        """Return densities and gradients (L, H, n, 3) at places (L, H, n, 2)."""
        index = y * self.per_unit
        if self._grids or index.size > 2 * DRAWING.own_tiles or self._are_more_than_pages(index):
            self.pages.find(index, self._drawn_pages)
            self.values = self.pages.values
        else:
            self._to_own_tiles(index)
        maps = index.reshape(-1, 2).T
        offsets = maps - np.rint(maps)
        offsets *= offsets
        offsets += 0.25
        around = self._sides * offsets[:, None]
        around += maps[:, None]
        u, v = around.astype(np.float32).reshape(2, 1, -1)  # rows would be shared among threads
        sampled = self._quarters @ remap(self.values, u, v).reshape(4, -1)
        return np.asarray(sampled.reshape(*y.shape[:-1], 3) * self._scale.units)

    def _to_own_tiles(self, index: Floats) -> None:
        """Turn places in cells into those in tiles around them, and draw these; in place."""
        around, shifts, values = self._own
        if around.shape != index.shape or np.abs(index - around).max(initial=0.0) > 0.5 * self.tile:
            around = np.rint(index)
            middles = around.reshape(-1, 2)
            sensors = np.arange(len(index)).repeat(len(middles) // len(index))
            room = self._drawn(sensors, middles, *self._near(sensors, middles))
            places, width = _middles_of_drawn(len(middles), self._side), room.shape[2] * self._side
            shifts, values = (places - middles).reshape(index.shape), room.reshape(-1, width, 3)
            self._own = around, shifts, values
        index += shifts
        self.values = values

    def _are_more_than_pages(self, index: Floats) -> bool:
        """Test whether there are more places than pages of the planes, as at wide blurs."""
        places, planes = index.size / 2, len(index)
        return places > planes * _EXTRA_PAGES**2 and places > planes * self._most_pages

    @cached_property
    def _most_pages(self) -> float:
        """Approximate number of pages of a plane with all detections."""
        return _count(self._q.min(axis=0), self._q.max(axis=0), self.tile)

    @cached_property
    def pages(self) -> Pages:
        """Pages for many places, on planes that hold all detections and grids."""
        corners = [grid[-1] for grid in self._grids.values()]
        return Pages(self._q, corners, self.tile, self._scale.reach, len(self.per_unit))

    def _near(self, sensors: Indices, middles: Floats) -> tuple[Indices, Indices]:
        """Return numbers of tiles (K,), ascending, and of the detections (K,) that reach them."""
        if len(sensors) * len(self._q) <= DRAWING.few_pairs:
            inside = np.abs(self._q - middles[:, None]) < self._reach
            of_sensor = self._sensor == sensors[:, None]
            of, which = np.nonzero(inside[..., 0] & inside[..., 1] & of_sensor)
            return of, which
        apart = 2 * self._reach  # along a third coordinate: no sensor reaches another
        tiles = np.column_stack([middles, apart * sensors])
        tree = cKDTree(np.column_stack([self._q, apart * self._sensor]))
        away, nearest = tree.query(tiles, k=3, p=np.inf, distance_upper_bound=self._reach)
        near = np.isfinite(away)
        if not near[:, -1].any():  # at most two detections per tile, as for narrow blurs
            of, place = near.nonzero()
            return of, nearest[of, place]
        all_of_them = cKDTree(tiles)
        pairs = all_of_them.sparse_distance_matrix(tree, self._reach, np.inf, output_type="ndarray")
        order = np.lexsort((pairs["j"], pairs["i"]))
        return pairs["i"][order], pairs["j"][order]

    def _drawn(self, sensors: Indices, middles: Floats, of: Indices, which: Indices) -> Singles:
        """Draw tiles (rows, side, columns, 3 side) around places (P, 2), by pairs of `_near`.

        Those of a column are drawn at once; it is short: places are rounded to 6e-5 cells.
        """
        count, side, most = len(middles), self._side, _TOGETHER
        columns = max(-(-count // most), 1)
        room = np.empty((min(count, most), side, columns, 3 * side), dtype=np.float32)
        for k in range(columns):
            batch = slice(k * most, min((k + 1) * most, count))
            a, b = of.searchsorted([batch.start, batch.stop]).tolist()
            tiles = room[: batch.stop - batch.start, :, k]
            self._draw(tiles, sensors[batch], middles[batch], of[a:b] - batch.start, which[a:b])
            for sensor in self._grids:
                for i in np.flatnonzero(sensors[batch] == sensor).tolist():
                    tiles[i] = self._of_grid(sensor, middles[batch][i])
        return room

    def _draw(
        self, tiles: Singles, sensors: Indices, middles: Floats, of: Indices, which: Indices
    ) -> None:
        """Draw tiles (P, side, 3 side) around places (P, 2) in cells, with detections near them.

        They hold exact Gaussians, each a product of one along v and one along u, summed over the
        detections that reach a tile, in three channels side by side.
        """
        count, side, scale = len(middles), self._side, self._scale
        place = np.arange(len(of)) - of.searchsorted(of)
        most = int(place.max(initial=0)) + 1
        begin = (self._q.take(which, axis=0) - middles.take(of, axis=0)) * (1 / scale.sigma)
        cells = (np.arange(side) - 0.5 * (side - 1)) * (1 / scale.sigma)
        away = begin.astype(np.float32)[..., None] - cells.astype(np.float32)
        bells = np.exp(np.float32(-0.5) * away * away)
        if scale.is_flat is not None:  # rows that are all alike
            flat = scale.is_flat[sensors[of]]
            bells[flat, 1], away[flat, 1] = 1.0, 0.0
        bells[:, 1] *= self._share.take(which)[:, None]
        slopes = bells * away
        slots = most * of + place
        along_v = np.zeros((count * most, 2, side), dtype=np.float32)
        along_v[slots, 0], along_v[slots, 1] = bells[:, 1], slopes[:, 1]
        along_u = np.zeros((count * most, 2, side, 3), dtype=np.float32)
        along_u[slots, 0, :, 0] = along_u[slots, 1, :, 2] = bells[:, 0]
        along_u[slots, 0, :, 1] = slopes[:, 0]
        rows = along_v.reshape(count, 2 * most, side).swapaxes(1, 2)
        np.matmul(rows, along_u.reshape(count, 2 * most, 3 * side), out=tiles)

    def _drawn_pages(self, sensors: Indices, middles: Floats) -> tuple[Indices, Singles]:
        """Draw pages around places (P, 2) in cells; return numbers and pages that are not empty."""
        of, which = self._near(sensors, middles)
        is_filled = np.isin(np.arange(len(sensors)), of)
        for k, (*_, (lower, upper)) in self._grids.items():
            inside = (middles > lower - self._reach) & (middles < upper + self._reach)
            is_filled |= (sensors == k) & inside.all(axis=1)
        filled = np.flatnonzero(is_filled)
        of = np.searchsorted(filled, of)
        column, row = np.divmod(np.arange(len(filled)), _TOGETHER)
        return filled, self._drawn(sensors[filled], middles[filled], of, which)[row, :, column]

    def _of_grid(self, sensor: int, middle: Floats) -> Singles:
        """Draw a tile (side, 3 side) of grey values or a profile."""
        pattern, sigma, total, _ = self._grids[sensor]
        side = self._side
        cells = middle + (np.arange(side) - 0.5 * (side - 1))[:, None]
        u, v = (cells / self.per_unit[sensor, 0, 0, 0]).T
        tile = np.zeros((side, side, 3), dtype=np.float32)
        for channel, layer in enumerate(blurred(pattern, sigma, u, v, total, gradient=True)):
            tile[..., channel] = layer / self._scale.units[sensor, 0, 0, channel]
        return tile.reshape(side, 3 * side)


class _Scale(NamedTuple):
    """Units of cells in L sensors, and of densities in the array."""

    per_unit: Floats  # (L, 1, 1, 2) as `Atlas.per_unit`
    widths: list[float]  # drawn deviations, in sensor units; look-ups add the remaining blur
    sigma: float  # the same in cells
    reach: float  # cells around a detection within which it is drawn
    units: Floats  # (L, 1, 1, 3) of the channels: a lone detection's peak, per deviation
    is_flat: Mask | None  # (L,) sensors of one coordinate, where there are any

    @classmethod
    @lru_cache(maxsize=64)
    def of(cls, dimensions: tuple[int, ...], sigmas: tuple[float, ...], n: float) -> _Scale:
        """Compute the units for blurs of standard deviations sigmas, of n cells each."""
        # look-ups blur by the variance of a quadratic B-spline
        drawn = math.sqrt(n**2 - 1 / 4)
        widths = [sigma * drawn / n for sigma in sigmas]
        across = [(n / sigma, (m - 1) * n / sigma) for sigma, m in zip(sigmas, dimensions)]
        tops = [(math.sqrt(2 * np.pi) * w) ** -m for w, m in zip(widths, dimensions)]
        units = [(top, top / w, top / w) for top, w in zip(tops, widths)]
        return cls(
            per_unit=np.array(across)[:, None, None],
            widths=widths,
            sigma=drawn,
            reach=DRAWING.reach * n + DRAWING.rim - 1,
            units=np.array(units)[:, None, None],
            is_flat=np.array(dimensions) == 1 if 1 in dimensions else None,
        )


class Pages:
    """The planes of L sensors, divided into pages that are drawn when they are looked up."""

    def __init__(
        self, q: Floats, corners: Sequence[Floats], page: int, reach: float, sensors: int
    ) -> None:
        """Divide planes with detections (D, 2) and grids of corners (2, 2), in cells, and a rim."""
        grids = np.concatenate([np.zeros((0, 2)), *corners])
        places = q if len(q) else grids
        lower, upper = places.min(axis=0), places.max(axis=0)
        if len(q) and _count(lower, upper, page) > DRAWING.held:
            middle, half = np.median(q, axis=0), page * math.sqrt(DRAWING.held) / 2.5
            lower, upper = np.maximum(lower, middle - half), np.minimum(upper, middle + half)
        if corners:
            lower, upper = np.minimum(lower, grids.min(0)), np.maximum(upper, grids.max(0))
            page = math.ceil(page * max(math.sqrt(_count(lower, upper, page) / DRAWING.held), 1.0))
        self.page = page  # cells along a page
        # half a cell of margin, lest rounding puts a place on a page of the rim
        self._origin = page * np.floor((lower - (reach + page + 0.5)) / page)
        self._shape = ((upper - lower + 2 * reach) / page).astype(np.intp) + 5  # along u and v
        self._count = int(self._shape.prod())
        # (L * count,) number of each page, plane after plane and row by row; 0 of empty ones,
        # negative if not drawn yet
        self.table = np.full(sensors * self._count, -1, dtype=np.int32)
        self._first = self._count * np.arange(sensors)[:, None, None]
        side = page + DRAWING.rim
        columns = min(len(self.table) * side // DRAWING.side + 1, DRAWING.side // side)
        self._room = np.zeros((1, side, columns, 3 * side), dtype=np.float32)
        self._drawn = 1
        # from a place in the plane to one in the array, by page; empty ones lead out of the array
        self._shifts = np.full((columns, 2), DRAWING.far)

    @property
    def values(self) -> Singles:
        """The array (rows, columns, 3) that pages lie in."""
        rows, side, columns, _ = self._room.shape
        return self._room.reshape(rows * side, columns * side, 3)

    def find(
        self, index: Floats, draw: Callable[[Indices, Floats], tuple[Indices, Singles]]
    ) -> None:
        """Turn places (L, H, n, 2) in cells into those in `values`, in place.

        `draw` returns numbers of non-empty pages, and these, by sensors (P,) and middles (P, 2).
        """
        page, width = self.page, self._shape[0]
        index -= self._origin
        np.maximum(index, 0.0, out=index)
        np.minimum(index, self._shape * page - 1e-3, out=index)
        squares = (index * (1.0 / page)).astype(np.intp) @ np.array([1, width]) + self._first
        number = self.table[squares]
        if number.min(initial=0) < 0:
            pending, at_once = np.unique(squares[number < 0]), DRAWING.held // page**2
            for first in range(0, len(pending), at_once):
                batch = pending[first : first + at_once]
                sensors, place = np.divmod(batch, self._count)
                middles = page * (np.stack([place % width, place // width], axis=1) + 0.5)
                filled, pages = draw(sensors, self._origin + middles)
                self.table[batch] = 0
                self.table[batch[filled]] = self._kept(pages, middles[filled])
            number = self.table[squares]
        index += self._shifts[number]

    def _kept(self, pages: Singles, middles: Floats) -> Indices:
        """Put pages (F, side, 3 side) around places (F, 2) into the array; return their numbers."""
        rows, side, columns, _ = self._room.shape
        numbers = np.arange(self._drawn, self._drawn + len(pages))
        self._drawn += len(pages)
        if self._drawn > rows * columns:
            # large, as memory that is not written to costs nothing
            most = min(4 * -(-self._drawn // columns), DRAWING.side // side)
            room = np.empty((most, *self._room.shape[1:]), dtype=np.float32)
            room[:rows] = self._room
            self._room, self._shifts = room, np.resize(self._shifts, (most * columns, 2))
        self._room[numbers // columns, :, numbers % columns] = pages
        self._shifts[numbers] = _middles_of(numbers, columns, side) - middles
        return numbers


def _middles_of(numbers: Indices, columns: int, side: int) -> Floats:
    """Return the middles (K, 2) in an array of tiles that lie there by numbers, row by row."""
    return np.array([numbers % columns, numbers // columns]).T * side + 0.5 * (side - 1)


@lru_cache(maxsize=64)
def _middles_of_drawn(count: int, side: int) -> Floats:
    """Return the middles of tiles that are drawn column by column."""
    columns, place = max(-(-count // _TOGETHER), 1), np.arange(count)
    return _middles_of(place % _TOGETHER * columns + place // _TOGETHER, columns, side)


def _count(lower: Floats, upper: Floats, page: int) -> float:
    """Return about how many pages a box in cells has, with those that reach beyond it."""
    return float(((upper - lower) / page + _EXTRA_PAGES).prod())
