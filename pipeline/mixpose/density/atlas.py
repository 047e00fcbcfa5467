"""Densities of all sensors as images, drawn where they are looked up.

A density is nearly empty, so small tiles of it are drawn.  All tiles of all sensors lie in one
array (an atlas), which `cv2.remap` looks up at once, values and gradients together.  Few places, as
those of a pose that a fit begins from, have tiles of their own, in which they stay while it moves a
little.  For many the plane of every sensor is divided into pages, tiles that are found by a table.

Cells hold coefficients of quadratic B-splines, so that what is looked up bends smoothly from cell
to cell.  At a place d cells beside the nearest one, such a spline is the mean of four bilinear
look-ups, d² + 1/4 of a cell to either side along each axis.

A sensor of one coordinate has 0 as its second, and its tiles have equal rows.  Cells are counted
from sensor coordinates 0, so that a density is the same whatever is seen beside it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cached_property, lru_cache
from typing import NamedTuple

import numpy as np

from mixpose.density.grid import blurred, mass, reduced, remap
from mixpose.density.pages import RIM, Pages, Plane, middles_of
from mixpose.density.rules import DRAWING
from mixpose.records import Floats, GridPattern, Indices, Mask, Pattern, Singles

# tiles that are drawn at once: they have room for as many detections each
_TOGETHER = math.isqrt(DRAWING.few_pairs)


class Atlas:
    """Densities with gradients of L sensors.

    Patterns, one per sensor and none of them empty, are blurred by standard deviations `sigmas`, in
    sensor units, of n = `steps_per_sigma` cells each, and normalised.
    """

    values: Singles  # (rows, columns, 3) tiles that were looked up last, in units of `_Scale`
    per_unit: Floats  # (L, 1, 1, 2) cells per sensor unit; 0 for the missing coordinate of ranges
    tile: int  # cells along the part of a tile that is looked up

    _sides = np.array([[-1, 1, -1, 1], [-1, -1, 1, 1]], dtype=np.float64)[..., None]
    _apart = 4e9  # cells between rows of one sensor and the next, where they are sorted
    _quarters = np.full(4, 0.25, dtype=np.float32)

    def __init__(
        self, patterns: Sequence[Pattern], sigmas: Sequence[float], steps_per_sigma: float
    ) -> None:
        dimensions = tuple([pattern.dimension for pattern in patterns])
        self._scale = scale = _Scale.of(dimensions, tuple(sigmas), steps_per_sigma)
        self.per_unit = scale.per_unit
        self.values = np.zeros((0, 0, 3), dtype=np.float32)
        self._grids: dict[int, tuple[GridPattern, float, float]] = {}
        q, share, counts = [np.zeros((0, 2))], [np.zeros(0)], np.zeros(len(patterns), dtype=np.intp)
        for k, pattern in enumerate(patterns):
            if isinstance(pattern, GridPattern):
                small, left = reduced(pattern, scale.widths[k])
                self._grids[k] = small, left, mass(small)
                continue
            counts[k] = len(pattern.points)
            q.append(pattern.points * scale.per_unit[k, 0, 0])
            share.append(pattern.weights / pattern.weights.sum())
        self._q, self._share = np.concatenate(q), np.concatenate(share).astype(np.float32)
        self._sensor = np.arange(len(counts)).repeat(counts)
        self.tile = max(math.ceil(steps_per_sigma), DRAWING.tile)
        # places (L, H, n, 2) in cells, shifts from there to the array of their tiles, and that
        self._own: tuple[Floats, Floats, Singles] = np.zeros(0), np.zeros(0), self.values
        if self._grids:  # the larger the plane, the larger its pages
            self.tile = self.pages.plane.page
        self._side, self._reach = self.tile + RIM, 0.5 * self.tile + scale.reach

    def look_up(self, y: Floats) -> Floats:
        """Densities and gradients (L, H, n, 3) at places (L, H, n, 2)."""
        index = y * self.per_unit
        if self._grids or index.size > 2 * DRAWING.own_tiles:
            self.pages.find(index, self._drawn_pages)
            self.values = self.pages.values
        else:
            self._to_own_tiles(index)
        maps = index.reshape(-1, 2).T
        beside = maps - np.rint(maps)
        beside *= beside
        beside += 0.25
        around = self._sides * beside[:, None]
        around += maps[:, None]
        u, v = around.astype(np.float32)
        sampled = self._quarters @ remap(self.values, u, v).reshape(4, -1)
        return np.asarray(sampled.reshape(*y.shape[:-1], 3) * self._scale.units)

    def _to_own_tiles(self, index: Floats) -> None:
        """Turn places in cells into those in tiles around them, in place."""
        around, shifts, values = self._own
        is_left = around.shape != index.shape
        if is_left or np.abs(index - around).max(initial=0.0) > 0.5 * self.tile:
            middles, side = np.rint(index), self._side
            flat = middles.reshape(-1, 2)
            sensors = np.arange(len(index)).repeat(len(flat) // len(index))
            groups = self._groups(len(flat), *self._near(sensors, flat))
            # columns of so few tiles that places in the array are rounded to 6e-5 cells
            shape = min(len(flat), _TOGETHER), side, len(groups), 3 * side
            room, numbers = np.empty(shape, dtype=np.float32), np.empty(len(flat), dtype=np.intp)
            for k, (some, *pairs) in enumerate(groups):
                self._draw(room[: len(some), :, k], sensors[some], flat[some], *pairs)
                numbers[some] = np.arange(len(some)) * len(groups) + k
            shifts = (middles_of(numbers, len(groups), side) - flat).reshape(index.shape)
            values = room.reshape(-1, len(groups) * side, 3)
            self._own = middles, shifts, values
        index += shifts
        self.values = values

    @cached_property
    def pages(self) -> Pages:
        """For many places, on planes that hold all that is seen."""
        corners = [self._corners(k) for k in self._grids]
        plane = Plane.of(self._q, corners, self.tile, self._scale.reach)
        return Pages(plane, len(self.per_unit))

    def _corners(self, sensor: int) -> Floats:
        """Corners (2, 2) of a grid, in cells."""
        extent = np.array(self._grids[sensor][0].extent)
        return np.asarray(extent * self.per_unit[sensor, 0, 0])

    def _near(self, sensors: Indices, middles: Floats) -> tuple[Indices, Indices]:
        """Tiles (K,), in order, and detections (K,) that reach them, of tiles of sensors (P,)."""
        if len(sensors) * len(self._q) <= DRAWING.few_pairs:
            away = np.abs(self._q - middles[:, None])
            inside = away < self._reach
            near = inside[..., 0] & inside[..., 1] & (self._sensor == sensors[:, None])
            of, which = np.nonzero(near)
            return of, which
        (order, keys), margin = self._sorted, self._reach + 1.0
        rows = middles[:, 1] + self._apart * sensors
        first, counts = keys.searchsorted(rows - margin), keys.searchsorted(rows + margin)
        counts -= first
        of = np.arange(len(rows)).repeat(counts)
        which = order[np.arange(len(of)) + (first - np.cumsum(counts) + counts).repeat(counts)]
        near = np.flatnonzero((np.abs(self._q[which] - middles[of]) < self._reach).all(axis=1))
        return of[near], which[near]

    @cached_property
    def _sorted(self) -> tuple[Indices, Floats]:
        """Detections (D,) by sensor and row, and numbers that are sorted alike."""
        farthest = self._apart / 4
        keys = np.clip(self._q[:, 1], -farthest, farthest) + self._apart * self._sensor
        order = np.argsort(keys)
        return order, keys[order]

    def _groups(
        self, count: int, of: Indices, which: Indices
    ) -> list[tuple[Indices, Indices, Indices]]:
        """Tiles that about as many detections reach, with the pairs of both, as of `_near`."""
        if count <= _TOGETHER:
            return [(np.arange(count), of, which)]
        order = np.argsort(np.bincount(of, minlength=count), kind="stable")
        rank = np.argsort(order)[of]
        by_rank = np.argsort(rank, kind="stable")
        rank, which = rank[by_rank], which[by_rank]
        firsts = range(0, count, _TOGETHER)
        ends = rank.searchsorted([*firsts, count]).tolist()
        return [
            (order[k : k + _TOGETHER], rank[a:b] - k, which[a:b])
            for k, a, b in zip(firsts, ends, ends[1:])
        ]

    def _draw(
        self, tiles: Singles, sensors: Indices, middles: Floats, of: Indices, which: Indices
    ) -> None:
        """Draw tiles (P, side, 3 side) around places (P, 2) in cells, with detections near them.

        They hold exact Gaussians: sums, over the detections that reach a tile, of products of one
        along v and one along u, in three channels side by side.
        """
        count, side, scale = len(middles), self._side, self._scale
        place = np.arange(len(of)) - of.searchsorted(of)
        most = int(place.max(initial=0)) + 1
        begin = (self._q[which] - middles[of]) * (1 / scale.sigma)
        cells = (np.arange(side, dtype=np.float32) - 0.5 * (side - 1)) * (1 / scale.sigma)
        away = begin.astype(np.float32)[..., None] - cells.astype(np.float32)
        bells = np.exp(np.float32(-0.5) * away * away)
        if scale.is_flat is not None:  # rows that are all alike
            flat = scale.is_flat[sensors[of]]
            bells[flat, 1], away[flat, 1] = 1.0, 0.0
        bells[:, 1] *= self._share[which, None]
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
        """Those of pages around places (P, 2) in cells on which there is something, and they."""
        of, which = self._near(sensors, middles)
        is_filled = np.zeros(len(sensors), dtype=np.bool_)
        is_filled[of] = True
        for k in self._grids:
            lower, upper = self._corners(k)
            inside = (middles > lower - self._reach) & (middles < upper + self._reach)
            is_filled |= (sensors == k) & inside.all(axis=1)
        filled = np.flatnonzero(is_filled)
        sensors, middles = sensors[filled], middles[filled]
        tiles = np.empty((len(filled), self._side, 3 * self._side), dtype=np.float32)
        for some, *pairs in self._groups(len(filled), np.searchsorted(filled, of), which):
            drawn = np.empty((len(some), *tiles.shape[1:]), dtype=np.float32)
            self._draw(drawn, sensors[some], middles[some], *pairs)
            tiles[some] = drawn
        for i, k in enumerate(sensors.tolist()):
            if k in self._grids:
                tiles[i] = self._of_grid(k, middles[i])
        return filled, tiles

    def _of_grid(self, sensor: int, middle: Floats) -> Singles:
        """A tile (side, 3 side) of grey values or a profile."""
        pattern, sigma, total = self._grids[sensor]
        side = self._side
        cells = middle + (np.arange(side) - 0.5 * (side - 1))[:, None]
        u, v = (cells / self.per_unit[sensor, 0, 0, 0]).T
        tile = np.zeros((side, side, 3), dtype=np.float32)
        for channel, layer in enumerate(blurred(pattern, sigma, u, v, total, gradient=True)):
            tile[..., channel] = layer / self._scale.units[sensor, 0, 0, channel]
        return tile.reshape(side, 3 * side)


class _Scale(NamedTuple):
    """What cells are in units of L sensors, and densities in those of the array."""

    per_unit: Floats  # (L, 1, 1, 2) as `Atlas` has it
    widths: list[float]  # deviations that are drawn, in sensor units: look-ups blur by the rest
    sigma: float  # the same in cells
    reach: float  # cells around a detection to which it is drawn
    units: Floats  # (L, 1, 1, 3) of the channels: a lone detection's peak, per deviation
    is_flat: Mask | None  # (L,) sensors of one coordinate, where there are any

    @classmethod
    @lru_cache(maxsize=64)
    def of(cls, dimensions: tuple[int, ...], sigmas: tuple[float, ...], n: float) -> _Scale:
        """For blurs of standard deviations sigmas, of n cells each."""
        # look-ups blur by the variance of a quadratic B-spline
        drawn = math.sqrt(n**2 - 1 / 4)
        widths = [sigma * drawn / n for sigma in sigmas]
        across = [(n / sigma, (m - 1) * n / sigma) for sigma, m in zip(sigmas, dimensions)]
        tops = [(math.sqrt(2 * np.pi) * w) ** -m for w, m in zip(widths, dimensions)]
        units = np.array([(top, top / w, top / w) for top, w in zip(tops, widths)])
        is_flat = np.array(dimensions) == 1 if 1 in dimensions else None
        per_unit = np.array(across)[:, None, None]
        reach = DRAWING.reach * n + RIM - 1
        return cls(per_unit, widths, drawn, reach, units[:, None, None], is_flat)
