"""The planes of sensors, divided into pages that are drawn when they are looked up."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from mixpose.density.grid import FAR
from mixpose.density.rules import DRAWING
from mixpose.records import Floats, Indices, Singles

RIM = 3  # cells along a tile beside those looked up, which a spline reaches: one before, two after


def middles_of(numbers: Indices, columns: int, side: int) -> Floats:
    """Where in an array the middles (K, 2) of tiles are that lie there by numbers, row by row."""
    return np.array([numbers % columns, numbers // columns]).T * side + 0.5 * (side - 1)


class Plane(NamedTuple):
    """The plane of every sensor."""

    origin: Floats  # (2,) in cells
    shape: tuple[int, int]  # pages along u and v
    page: int  # cells along a page

    @property
    def squares(self) -> int:
        """Number of pages."""
        return self.shape[0] * self.shape[1]

    @classmethod
    def of(cls, q: Floats, corners: Sequence[Floats], page: int, reach: float) -> Plane:
        """For detections (D, 2), corners (2, 2) of grids, in cells; with a rim of empty pages."""
        grids = np.concatenate([np.zeros((0, 2)), *corners])
        places = q if len(q) else grids
        lower, upper = places.min(axis=0), places.max(axis=0)
        if len(q) and _count(lower, upper, page) > DRAWING.held:
            middle, half = np.median(q, axis=0), page * math.sqrt(DRAWING.held) / 2.5
            lower, upper = np.maximum(lower, middle - half), np.minimum(upper, middle + half)
        if corners:
            lower, upper = np.minimum(lower, grids.min(0)), np.maximum(upper, grids.max(0))
            page = math.ceil(page * max(math.sqrt(_count(lower, upper, page) / DRAWING.held), 1.0))
        # half a cell is left, lest rounding puts a place on a page of the rim
        origin = page * np.floor((lower - (reach + page + 0.5)) / page)
        columns, rows = ((upper - lower + 2 * reach) / page).tolist()
        return cls(origin, (int(columns) + 5, int(rows) + 5), page)


def _count(lower: Floats, upper: Floats, page: int) -> float:
    """Pages of a box in cells, about."""
    return float(((upper - lower) / page + 5).prod())


class Pages:
    """Pages of L sensors that were drawn so far, in one array."""

    def __init__(self, plane: Plane, sensors: int) -> None:
        self.plane = plane
        # (L * squares,) number of each page, plane after plane and row by row; 0 where there is
        # nothing, negative where nothing was looked up yet
        self.table = np.full(sensors * plane.squares, -1, dtype=np.int32)
        self._first = plane.squares * np.arange(sensors)[:, None, None]
        side = plane.page + RIM
        columns = min(len(self.table) * side // DRAWING.side + 1, DRAWING.side // side)
        self._room = np.zeros((1, side, columns, 3 * side), dtype=np.float32)
        self._drawn = 1
        # from a place in the plane to one in the array, by page; from nothing out of the array
        self._shifts = np.full((columns, 2), FAR)

    @property
    def values(self) -> Singles:
        """The array (rows, columns, 3) that pages lie in."""
        rows, side, columns, _ = self._room.shape
        return self._room.reshape(rows * side, columns * side, 3)

    def find(
        self, index: Floats, draw: Callable[[Indices, Floats], tuple[Indices, Singles]]
    ) -> None:
        """Turn places (L, H, n, 2) in cells into those in `values`, in place.

        Of pages, by sensors (P,) and middles (P, 2), `draw` gives those with something, and that.
        """
        plane = self.plane
        index -= plane.origin
        np.maximum(index, 0.0, out=index)
        np.minimum(index, np.array(plane.shape) * plane.page - 1e-3, out=index)
        columns_rows = (index * (1.0 / plane.page)).astype(np.intp)
        squares = columns_rows @ np.array([1, plane.shape[0]]) + self._first
        number = self.table[squares]
        if number.min(initial=0) < 0:
            pending, at_once = np.unique(squares[number < 0]), DRAWING.held // plane.page**2
            for first in range(0, len(pending), at_once):
                some = pending[first : first + at_once]
                sensors, place = np.divmod(some, plane.squares)
                rows, columns = np.divmod(place, plane.shape[0])
                middles = plane.page * (np.stack([columns, rows], axis=1) + 0.5)
                filled, pages = draw(sensors, plane.origin + middles)
                self.table[some] = 0
                self.table[some[filled]] = self._kept(pages, middles[filled])
            number = self.table[squares]
        index += self._shifts[number]

    def _kept(self, pages: Singles, middles: Floats) -> Indices:
        """Numbers of pages (F, side, 3 side) around places (F, 2) that are put into the array."""
        rows, side, columns, _ = self._room.shape
        numbers = np.arange(self._drawn, self._drawn + len(pages))
        self._drawn += len(pages)
        if self._drawn > rows * columns:
            # so large that allocators keep it; memory that is not written to is free
            most = min(4 * -(-self._drawn // columns), DRAWING.side // side)
            room = np.empty((most, *self._room.shape[1:]), dtype=np.float32)
            room[:rows] = self._room
            shifts = np.empty((most * columns, 2))
            shifts[: len(self._shifts)] = self._shifts
            self._room, self._shifts = room, shifts
        self._room[numbers // columns, :, numbers % columns] = pages
        self._shifts[numbers] = middles_of(numbers, columns, side) - middles
        return numbers
