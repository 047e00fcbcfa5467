"""Read tables of detections as a source: points without labels, several per frame."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from itertools import groupby, islice
from operator import itemgetter
from pathlib import Path
from typing import ClassVar, NoReturn, TypeAlias

import numpy as np

from mixpose.errors import RecordingError
from mixpose.frames.source import Frames, SensorKind, Source, SourceKind, SourceSpec, numbers_text
from mixpose.frames.times import Clock, column_names, csv_rows, finite, numeric, whole
from mixpose.limits import MOST_DETECTIONS, MOST_UNSORTED_ROWS
from mixpose.records import Floats, PointPattern, RawFrame

_COORDINATES: dict[SensorKind, tuple[str, ...]] = {
    "camera": ("u", "v"),
    "lateration": ("range",),
    "cloud": ("x", "y", "z"),
}

_LARGEST = 1e12  # squares of larger numbers overflow
_SMALLEST_WEIGHT = 1e-12  # shares of smaller weights vanish in sums with others

_Row: TypeAlias = tuple[float, int, list[str]]  # frame number or time, line in the file, cells


@dataclass(frozen=True)
class _Contents:
    """Summary of the rows of a table."""

    in_order: bool
    rows: int
    frames: int
    first: int | None
    last: int | None


@dataclass(frozen=True)
class DetectionTable(Source):
    """Detections of a sensor in rows; streamed if frames ascend, else read as a whole."""

    kind: ClassVar[SourceKind] = "detections"

    path: Path  # the CSV file
    columns: tuple[str, ...]  # its header
    coordinates: tuple[str, ...]  # names of the columns of a point, in order
    clock: Clock | None  # gives the time of a frame number; None: times in the table
    places: Sequence[int] = range(2**62)  # numbers of its times, if it has no frame numbers
    has_fps: bool = False  # whether the session states a rate, which is ignored

    @property
    def length(self) -> int:
        """Number of frames with a row."""
        return self._contents.frames

    @property
    def first(self) -> int | None:
        """Number of the first frame; None for a table without rows."""
        return self._contents.first

    @property
    def _is_numbered(self) -> bool:
        return "frame" in self.columns

    def describe(self) -> str:
        """Describe the source in a line."""
        contents = self._contents
        if contents.first is None or contents.last is None:
            return "0 detections"
        numbers = numbers_text(contents.first, contents.last, contents.frames)
        return f"{contents.rows} detections, {numbers}"

    def caution(self) -> str | None:
        """Warn of a rate if rows have times and no frame numbers."""
        if not self.has_fps:
            return None
        return (
            "its rows have times and no frame numbers, which they go by, and not by fps; add a "
            "column frame where the clocks of sensors differ"
        )

    @property
    def stamps(self) -> list[int]:
        """Times in nanoseconds, ascending, if frames have neither numbers nor a clock."""
        if self._is_numbered or self.clock is not None:
            return []
        return [int(key // 1) * 10**9 + round(key % 1 * 1e9) for key in self._keys()]

    def known_numbers(self) -> list[int]:
        """Return frame numbers, ascending, up to the first row that cannot be read."""
        keys = self._keys()
        return list(map(int, keys if self._is_numbered else self.places[: len(keys)]))

    def _keys(self) -> list[float]:
        keys: set[float] = set()
        with suppress(RecordingError):  # `frames` raises it, too
            keys.update(key for key, _, _ in self._rows())
        return sorted(keys)

    def _frames(self, wanted: range) -> Frames:
        """Group rows to frames, at the time of the earliest; rows of weight 0 have no detection."""
        rows: Iterator[_Row] = self._rows()
        if not self._contents.in_order:
            unsorted = list(islice(rows, MOST_UNSORTED_ROWS + 1))
            if len(unsorted) > MOST_UNSORTED_ROWS:
                raise RecordingError(
                    f"{self.path}: found more than {MOST_UNSORTED_ROWS} rows, which are not in the "
                    "order of their frames; sort them, then they may be any number"
                )
            rows = iter(sorted(unsorted, key=itemgetter(0)))
        for place, (key, group) in enumerate(groupby(rows, key=itemgetter(0))):
            number = int(key) if self._is_numbered else self.places[place]
            if number >= wanted.stop:
                return
            if number in wanted:
                yield self._frame(number, group)

    def _frame(self, number: int, rows: Iterator[_Row]) -> RawFrame:
        group = list(islice(rows, MOST_DETECTIONS + 1))
        if len(group) > MOST_DETECTIONS:
            raise RecordingError(
                f"{self.path}, line {group[-1][1]}: found more than {MOST_DETECTIONS} detections "
                f"in frame {number}, as many are allowed; leave out what cannot be a feature"
            )
        try:
            values = np.array([[float(numeric(cell)) for cell in cells] for _, _, cells in group])
        except ValueError:
            self._complain(group)
        if not np.isfinite(values).all():
            self._complain(group)
        points = values[:, [self.columns.index(name) for name in self.coordinates]]
        weights = self._column("weight", values)
        if weights is None:
            weights = np.ones(len(points))
        too_small = (weights != 0) & (weights < _SMALLEST_WEIGHT)
        if too_small.any() or max(np.abs(points).max(), weights.max()) > _LARGEST:
            self._complain(group)
        pattern = PointPattern(points[weights > 0], weights[weights > 0])
        if self.clock is not None:
            return RawFrame(number, self.clock(number), pattern)
        seconds = self._column("time_s", values)
        return RawFrame(number, None if seconds is None else float(seconds.min()), pattern)

    def _column(self, name: str, values: Floats) -> Floats | None:
        return values[:, self.columns.index(name)] if name in self.columns else None

    def _complain(self, rows: list[_Row]) -> NoReturn:
        """Raise a RecordingError for the first faulty cell in rows of a frame."""
        for _, line, cells in rows:
            for name, cell in zip(self.columns, cells, strict=True):
                value = finite(cell, self.path, line, name)
                fault = None
                if abs(value) > _LARGEST and name in (*self.coordinates, "weight"):
                    fault = f"at most {_LARGEST:g}"
                elif name == "weight" and value != 0 and value < _SMALLEST_WEIGHT:
                    fault = "0 or more" if value < 0 else f"0, or at least {_SMALLEST_WEIGHT:g}"
                if fault:
                    raise RecordingError(
                        f"{self.path}, line {line}: {name}: found {value:g}, allowed is {fault}"
                    )
        raise AssertionError("complained about rows that are as they should be")

    def _rows(self) -> Iterator[_Row]:
        """Yield rows with the key of their frame: its number, or else its time."""
        rows = csv_rows(self.path)
        next(rows, None)
        read, name = (whole, "frame") if self._is_numbered else (finite, "time_s")
        column = self.columns.index(name)
        for line, cells in rows:
            yield read(cells[column], self.path, line, name), line, cells

    @cached_property
    def _contents(self) -> _Contents:
        """Summary of the rows up to the first that cannot be read."""
        rows = frames = 0
        first = last = None
        in_order = True
        with suppress(RecordingError):  # `frames` raises it, too, after earlier frames
            for key, _, _ in self._rows():
                in_order = last is None or key >= last
                if not in_order:
                    break
                if key != last:
                    frames += 1
                first = key if first is None else first
                last = key
                rows += 1
        if not in_order:
            by_key = Counter(key for key, _, _ in self._rows())
            rows, frames, first, last = by_key.total(), len(by_key), min(by_key), max(by_key)
        if first is None or last is None:
            return _Contents(in_order, 0, 0, None, None)
        if not self._is_numbered:
            first, last = self.places[0], self.places[frames - 1]
        return _Contents(in_order, rows, frames, int(first), int(last))


def open_table(spec: SourceSpec, path: Path, clock: Clock | None) -> DetectionTable:
    """Open a table of detections; RecordingError if columns of its header are not allowed."""
    coordinates = _COORDINATES[spec.kind]
    _, cells = next(csv_rows(path), (0, []))
    columns = column_names(cells)
    fault = _header_fault(columns, coordinates)
    if fault is not None:
        raise RecordingError(
            f"{path}, line 1: {fault}; the header of a {spec.kind} table is frame or time_s or "
            f"both, then {','.join(coordinates)}, optionally weight"
        )
    has_fps = spec.fps is not None and "frame" not in columns
    clock = None if has_fps else clock
    return DetectionTable(path, columns, coordinates, clock, has_fps=has_fps)


def _header_fault(columns: Sequence[str], coordinates: Sequence[str]) -> str | None:
    if not columns:
        return "the file is empty"
    allowed = {"frame", "time_s", *coordinates, "weight"}
    unknown = [column for column in columns if column not in allowed]
    missing = [column for column in coordinates if column not in columns]
    if unknown:
        parts = re.split(r"[;\t|]", unknown[0])
        meant = f"; columns are parted by commas, {','.join(parts)!r}" if parts[1:] else ""
        return f"found column {unknown[0]!r}{meant}"
    if missing:
        return f"column {missing[0]!r} is missing"
    if len(set(columns)) != len(columns):
        return "a column comes twice"
    if "frame" not in columns and "time_s" not in columns:
        return "found neither frame nor time_s"
    return None
