"""Densities of all sensors as images, drawn where they are looked up.

A density is nearly empty: detections are few, and a grid fine enough for gradients has millions of
points.  So small tiles of it are drawn, and all tiles of all sensors lie in one array (an atlas),
which `cv2.remap` looks up at once, values and gradients together.  Few places, as those of a pose
that a fit begins from, have tiles of their own, in which they stay while it moves a little.  For
many the plane of every sensor is divided into pages: tiles that are drawn when they are looked up
for the first time, and are found by a table.

Cells hold coefficients of quadratic B-splines, so that what is looked up bends smoothly from cell
to cell.  At a place d cells beside the nearest one, such a spline is the mean of four bilinear
look-ups, d² + 1/4 of a cell to either side along each axis.

Arrays have a leading axis L over sensors.  A sensor of one coordinate has 0 as its second, and its
tiles have equal rows.  Cells are counted from sensor coordinates 0, so that a density is the same
whatever is seen beside it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from functools import cached_property, lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mixpose.density.blur import factors, mass, reduced
from mixpose.density.grid import remap
from mixpose.density.pages import RIM, Pages, Plane
from mixpose.density.rules import DRAWING
from mixpose.records import Floats, GridPattern, Indices, Pattern, PointPattern, Singles


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
        Tiles that were looked up last, with one cell more on every side: the density as a share
        of a lone detection's peak, and its gradient per standard deviation.
    per_unit : (L, 1, 1, 2) float64
        Cells per sensor unit; 0 for the missing coordinate of ranges.
    tile : int
        Cells along the part of a tile that is looked up.
    """

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
        counts = [len(one.points) if isinstance(one, PointPattern) else 0 for one in patterns]
        q, share = np.empty((sum(counts), 2)), np.empty(sum(counts), dtype=np.float32)
        self._grids: dict[int, tuple[GridPattern, float, float]] = {}
        end = 0
        for k, (pattern, count) in enumerate(zip(patterns, counts, strict=True)):
            if isinstance(pattern, GridPattern):
                small, left = reduced(pattern, scale.widths[k])
                self._grids[k] = small, left, mass(small)
                continue
            part = slice(end, end := end + count)
            q[part] = pattern.points * scale.per_unit[k, 0, 0]
            share[part] = pattern.weights / pattern.weights.sum()
        self._q, self._share = q, share
        self._sensor = np.arange(len(counts)).repeat(counts)
        self.tile = (
            max(math.ceil(steps_per_sigma), DRAWING.grid_tile) if self._grids else DRAWING.tile
        )
        self._own: _Tiles | None = None
        if self._grids:  # the larger the plane, the larger its pages
            self.tile = self.pages.plane.page

    def look_up(self, y: Floats) -> Floats:
        """Densities and gradients (L, H, n, 3) at places (L, H, n, 2)."""
        index = y * self.per_unit
        if self._grids or index.size > 2 * DRAWING.own_tiles:
            self._to_pages(index)
        else:
            self._to_own_tiles(index)
        maps = index.reshape(-1, 2).T
        beside = maps - np.rint(maps)
        beside *= beside
        beside += 0.25
        around = self._sides * beside[:, None]
        around += maps[:, None]
        u, v = around.reshape(2, -1).astype(np.float32)
        sampled = self._quarters @ remap(self.values, u, v).reshape(4, -1)
        return np.asarray(sampled.reshape(*y.shape[:-1], 3) * self._scale.units)

    def _to_own_tiles(self, index: Floats) -> None:
        """Turn places in cells into those in tiles around them, in place."""
        own = self._own
        if own is None or not own.hold(index):
            middles = np.rint(index)
            flat, side = middles.reshape(-1, 2), self._side
            sensors = np.arange(len(index)).repeat(len(flat) // len(index))
            groups = list(self._groups(len(flat), *self._near(sensors, flat)))
            # columns of so few tiles that places in the array are rounded to 6e-5 cells
            shape = min(len(flat), DRAWING.tiles_at_once), side, len(groups), 3 * side
            room = np.empty(shape, dtype=np.float32)
            shifts = 0.5 * (side - 1) - flat
            for k, (some, of, which) in enumerate(groups):
                tiles = room[: len(some), :, k]
                self._draw(tiles, sensors[some], flat[some], of, which)
                shifts[some, 0] += side * k
                shifts[some, 1] += side * np.arange(len(some))
            values = room.reshape(len(room) * side, len(groups) * side, 3)
            own = self._own = _Tiles(middles, shifts.reshape(index.shape), values)
        index += own.shifts
        self.values = own.values

    def _to_pages(self, index: Floats) -> None:
        """Turn places in cells into those on pages, in place."""
        self.pages.find(index, self._drawn_pages)
        self.values = self.pages.values

    @cached_property
    def pages(self) -> Pages:
        """For many places, on planes that hold all that is seen."""
        corners = [self._corners(k) for k in self._grids]
        plane = Plane.of(self._q, corners, self.tile, self._scale.reach)
        return Pages(plane, len(self.per_unit))

    @property
    def _side(self) -> int:
        """Cells along a tile with those beside it that look-ups reach."""
        return self.tile + RIM

    def _corners(self, sensor: int) -> Floats:
        """Corners (2, 2) of a grid, in cells."""
        extent = np.array(self._grids[sensor][0].extent)
        return np.asarray(extent * self.per_unit[sensor, 0, 0])

    def _near(self, sensors: Indices, middles: Floats) -> tuple[Indices, Indices]:
        """Tiles (K,), in order, and detections (K,) that reach them, of tiles of sensors (P,)."""
        reach = 0.5 * self.tile + self._scale.reach
        if len(sensors) * len(self._q) <= DRAWING.few_pairs:
            away = self._q - middles[:, None]
            np.abs(away, out=away)
            inside = away < reach
            near = inside[..., 0] & inside[..., 1] & (self._sensor == sensors[:, None])
            of, which = np.nonzero(near)
            return of, which
        order, sorted_keys = self._sorted
        keys = middles[:, 1] + self._apart * sensors
        first = np.searchsorted(sorted_keys, keys - (reach + 1.0))
        counts = np.searchsorted(sorted_keys, keys + (reach + 1.0)) - first
        of = np.arange(len(keys)).repeat(counts)
        which = order[np.arange(len(of)) + (first - np.cumsum(counts) + counts).repeat(counts)]
        chosen = np.flatnonzero((np.abs(self._q[which] - middles[of]) < reach).all(axis=1))
        return of[chosen], which[chosen]

    @cached_property
    def _sorted(self) -> tuple[Indices, Floats]:
        """Detections (D,) by sensor and row, and numbers that are sorted alike."""
        farthest = self._apart / 4
        keys = np.clip(self._q[:, 1], -farthest, farthest) + self._apart * self._sensor
        order = np.argsort(keys)
        return order, keys[order]

    def _groups(
        self, count: int, of: Indices, which: Indices
    ) -> Iterator[tuple[Indices, Indices, Indices]]:
        """Tiles that about as many detections reach, with the pairs of both, as of `_near`."""
        if count <= DRAWING.tiles_at_once:
            yield np.arange(count), of, which
            return
        order = np.argsort(np.bincount(of, minlength=count), kind="stable")
        for first in range(0, count, DRAWING.tiles_at_once):
            some = order[first : first + DRAWING.tiles_at_once]
            number = np.full(count, -1)
            number[some] = np.arange(len(some))
            chosen = np.flatnonzero(number[of] >= 0)
            chosen = chosen[np.argsort(number[of[chosen]], kind="stable")]
            yield some, number[of[chosen]], which[chosen]

    def _draw(
        self, tiles: Singles, sensors: Indices, middles: Floats, of: Indices, which: Indices
    ) -> None:
        """Draw tiles (P, side, 3 side) around places (P, 2) in cells, with detections near them.

        They hold exact Gaussians: sums, over the detections that reach a tile, of products of one
        along v and one along u, in three channels side by side.
        """
        count, side, scale = len(middles), self._side, self._scale
        place = np.arange(len(of)) - np.searchsorted(of, of)
        most = int(place.max(initial=0)) + 1
        sensor = sensors[of]
        begin = (self._q[which] - middles[of]) * (1 / scale.sigma)
        cells = (np.arange(side, dtype=np.float32) - 0.5 * (side - 1)) * (1 / scale.sigma)
        away = begin.astype(np.float32)[..., None] - cells.astype(np.float32)
        bells = np.exp(np.float32(-0.5) * away * away)
        if scale.is_flat is not None:  # rows that are all alike
            flat = scale.is_flat[sensor]
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
        reach = 0.5 * self.tile + self._scale.reach
        for k in self._grids:
            lower, upper = self._corners(k)
            inside = (middles > lower - reach) & (middles < upper + reach)
            is_filled |= (sensors == k) & inside.all(axis=1)
        filled = np.flatnonzero(is_filled)
        sensors, middles = sensors[filled], middles[filled]
        side = self._side
        tiles = np.empty((len(filled), side, 3 * side), dtype=np.float32)
        for some, *pairs in self._groups(len(filled), np.searchsorted(filled, of), which):
            drawn = np.empty((len(some), side, 3 * side), dtype=np.float32)
            self._draw(drawn, sensors[some], middles[some], *pairs)
            tiles[some] = drawn
        for i, k in enumerate(sensors.tolist()):
            if k in self._grids:
                tiles[i] = self._of_grid(k, middles[i])
        return filled, tiles

    def _of_grid(self, sensor: int, middle: Floats) -> Singles:
        """A tile (side, 3 side) of grey values or a profile."""
        pattern, sigma, total = self._grids[sensor]
        side, flat = self._side, pattern.dimension == 1
        cells = middle + (np.arange(side) - 0.5 * (side - 1))[:, None]
        u, v = (cells / self.per_unit[sensor, 0, 0, 0]).T
        layers = factors(pattern, sigma, u, None if flat else v, total).layers(gradient=True)
        tile = np.zeros((side, side, 3), dtype=np.float32)
        for channel, layer in enumerate(layers[: 2 if flat else 3]):
            tile[..., channel] = layer / self._scale.units[sensor, 0, 0, channel]
        return tile.reshape(side, 3 * side)


class _Tiles(NamedTuple):
    """Tiles of their own around places (L, H, n, 2) in cells: shifts from there to the array."""

    middles: Floats
    shifts: Floats
    values: Singles

    def hold(self, index: Floats) -> bool:
        """Whether as many places are still on their tiles."""
        if self.middles.shape != index.shape:
            return False
        return float(np.abs(index - self.middles).max(initial=0.0)) <= 0.5 * DRAWING.tile


class _Scale(NamedTuple):
    """What cells are in units of L sensors, and densities in those of the array."""

    per_unit: Floats  # (L, 1, 1, 2) as `Atlas` has it
    widths: list[float]  # deviations that are drawn, in sensor units: look-ups blur by the rest
    sigma: float  # the same in cells
    reach: float  # cells around a detection to which it is drawn
    units: Floats  # (L, 1, 1, 3) of the channels
    is_flat: NDArray[np.bool_] | None  # (L,) sensors of one coordinate, where there are any

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
