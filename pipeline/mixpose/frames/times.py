"""Give frames their times, by a table or a rate; read CSV files, with errors that name the line."""

from __future__ import annotations

import csv
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn, TypeAlias

from mixpose.errors import RecordingError, SessionError, reporting

if TYPE_CHECKING:
    from mixpose.frames.source import SourceSpec

Clock: TypeAlias = Callable[[int], float]

_COLUMNS = ["frame", "time_s"]
LISTED = 5  # frame numbers that a message names
_LARGEST_NUMBER = 10**255  # as many digits as a file name may have
_LONGEST_LINE = 16_000_000  # characters: a profile of a million bins


def listed(numbers: Sequence[int]) -> str:
    """List frame numbers in words; of many the first, and how many there are."""
    text = ", ".join(map(str, numbers[:LISTED]))
    return text if len(numbers) <= LISTED else f"{text}, ... ({len(numbers)} frames)"


@dataclass(frozen=True)
class FrameTimes:
    """A table of times; a call with a frame number returns its time."""

    path: Path  # where the table comes from; only for messages
    seconds: Mapping[int, float]  # times in s by frame number

    def __call__(self, number: int) -> float:
        """Return the time of a frame in s; RecordingError if the table lacks it."""
        if number not in self.seconds:
            raise RecordingError(
                f"{self.path}: no time for frame {number}; there must be a row for each frame"
            )
        return self.seconds[number]

    def missing(self, numbers: Iterable[int]) -> list[int]:
        """Return the frame numbers without a row."""
        return [number for number in numbers if number not in self.seconds]

    def require(self, numbers: Iterable[int]) -> None:
        """Raise a RecordingError if the table lacks a row of these frames."""
        if not (missing := self.missing(numbers)):
            return
        frames = f"frame{'s' * (len(missing) > 1)} {listed(missing)}"
        raise RecordingError(
            f"{self.path}: no row for {frames}; allowed is a table with a row for each frame of "
            "the recording, or fps in place of times"
        )


def read_times(path: Path) -> FrameTimes:
    """Read a table ``frame,time_s``, rows in any order; RecordingError if a row is wrong."""
    times: dict[int, float] = {}
    rows = csv_rows(path)
    _, cells = next(rows, (0, []))
    columns = column_names(cells)
    if sorted(columns) != _COLUMNS:
        text = ",".join(cells) or "nothing"
        raise RecordingError(f"{path}, line 1: found {text}, the header must be frame,time_s")
    frame_column, time_column = columns.index("frame"), columns.index("time_s")
    for line, cells in rows:
        number = whole(cells[frame_column], path, line, "frame")
        if number in times:
            raise RecordingError(f"{path}, line {line}: frame {number} has a time already")
        times[number] = finite(cells[time_column], path, line, "time_s")
    return FrameTimes(path, times)


def clock_of(spec: SourceSpec) -> Clock | None:
    """Return the clock of a source, if stated; SessionError or RecordingError if it is wrong."""
    if spec.times is not None and spec.fps is not None:
        raise SessionError(f"sensor {spec.sensor!r}: found times and fps, only one is allowed")
    if spec.times is not None:
        return read_times(spec.times)
    if spec.fps is None:
        return None
    fps = spec.fps
    if not 0 < fps < math.inf:
        raise SessionError(f"sensor {spec.sensor!r}: fps: found {fps}, allowed is above 0")
    return lambda number: number / fps


def csv_rows(path: Path) -> Iterator[tuple[int, list[str]]]:
    """Yield line numbers, from 1, and cells of a CSV file's rows that are not blank, or raise."""
    width = None
    cannot = reporting(RecordingError, f"{path}: cannot be read")
    try:
        with cannot, path.open(encoding="utf-8-sig", newline="") as file:
            # longer lines come in pieces, whose numbers of cells then differ from the first row
            pieces = iter(partial(file.readline, _LONGEST_LINE), "")
            reader = csv.reader(pieces, skipinitialspace=True)
            for cells in reader:
                if not cells or not (cells[0] or any(map(str.strip, cells))):
                    continue
                if width is None:
                    width = len(cells)
                elif len(cells) != width:
                    raise RecordingError(
                        f"{path}, line {reader.line_num}: found {len(cells)} cells, "
                        f"the first row has {width}"
                    )
                yield reader.line_num, cells
    except UnicodeDecodeError as error:
        raise RecordingError(f"{path}: not a text file in UTF-8") from error
    except csv.Error as error:
        raise RecordingError(f"{path}: not a CSV file: {error}") from error


def column_names(cells: list[str]) -> tuple[str, ...]:
    """Normalise column names: without blanks around them, in small letters."""
    return tuple(cell.strip().casefold() for cell in cells)


def numeric(cell: str) -> str:
    """Return a numeric cell unchanged; ValueError for underscores, which only Python allows."""
    if "_" in cell:
        raise ValueError
    return cell


def finite(cell: str, path: Path, line: int, column: str) -> float:
    """Read a cell as a finite number, else raise RecordingError."""
    try:
        value = float(numeric(cell))
    except ValueError:
        _complain(cell, path, line, column, "a number")
    if not math.isfinite(value):
        _complain(cell, path, line, column, "a finite number")
    return value


def whole(cell: str, path: Path, line: int, column: str) -> int:
    """Read a cell as a whole number (``12`` or ``12.0``), else raise RecordingError."""
    try:
        value = int(numeric(cell))
    except ValueError:
        number = finite(cell, path, line, column)
        value = int(number)
        if value != number:
            _complain(cell, path, line, column, "a whole number")
    if abs(value) > _LARGEST_NUMBER:
        _complain(cell, path, line, column, "a number of at most 255 digits")
    return value


def _complain(cell: str, path: Path, line: int, column: str, allowed: str) -> NoReturn:
    text = repr(cell.strip()) if cell.strip() else "an empty cell"
    raise RecordingError(f"{path}, line {line}: {column}: found {text}, allowed is {allowed}")
