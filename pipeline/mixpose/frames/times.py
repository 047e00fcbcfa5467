"""When frames were taken: from a table of times or from a rate."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

from mixpose.errors import RecordingError, SessionError
from mixpose.frames.csv_rows import csv_rows, finite, header, whole
from mixpose.frames.source import SourceSpec

Clock: TypeAlias = Callable[[int], float]

_COLUMNS = ["frame", "time_s"]
_LISTED = 5  # frame numbers that a message names


@dataclass(frozen=True)
class FrameTimes:
    """A table of times; called with a frame number it gives that frame's time."""

    path: Path  # where the table comes from; only for messages
    seconds: Mapping[int, float]  # times in s by frame number

    def __call__(self, number: int) -> float:
        """Time of frame `number` in s; RecordingError where the table has none."""
        if number not in self.seconds:
            raise RecordingError(
                f"{self.path}: no time for frame {number}; there must be a row for each frame"
            )
        return self.seconds[number]


def read_times(path: Path) -> FrameTimes:
    """Read a table with the header ``frame,time_s``, rows in any order.

    Raises RecordingError if it cannot be read, a cell is no finite number or a frame comes twice.
    """
    times: dict[int, float] = {}
    rows = csv_rows(path)
    _, cells = next(rows, (0, []))
    columns = header(cells)
    if sorted(columns) != _COLUMNS:
        found = ",".join(cells) or "nothing"
        raise RecordingError(f"{path}, line 1: found {found}, the header must be frame,time_s")
    frame_column, time_column = columns.index("frame"), columns.index("time_s")
    for line, cells in rows:
        number = whole(cells[frame_column], path, line, "frame")
        if number in times:
            raise RecordingError(f"{path}, line {line}: frame {number} has a time already")
        times[number] = finite(cells[time_column], path, line, "time_s")
    return FrameTimes(path, times)


def untimed(clock: Clock | None, numbers: Iterable[int]) -> list[int]:
    """Those of some frame numbers that a table of times has no row for; a rate has them all."""
    if not isinstance(clock, FrameTimes):
        return []
    return [number for number in numbers if number not in clock.seconds]


def require_times(clock: Clock | None, numbers: Iterable[int]) -> None:
    """Refuse a table of times that lacks a row for one of some frames.

    Raises RecordingError in one line: the table, which frames it lacks and what is allowed.
    """
    missing = untimed(clock, numbers)
    if not missing:
        return
    assert isinstance(clock, FrameTimes), "rates lack nothing"
    named = ", ".join(map(str, missing[:_LISTED]))
    more = f", ... ({len(missing)} frames)" if len(missing) > _LISTED else ""
    raise RecordingError(
        f"{clock.path}: no row for frame{'s' * (len(missing) > 1)} {named}{more}; allowed is a "
        "table with a row for each frame of the recording, or fps in place of times"
    )


def clock_of(spec: SourceSpec) -> Clock | None:
    """What gives the frames of a source their times; None where the session does not say.

    Raises SessionError if both `times` and `fps` are given, or `fps` is no positive number. Raises
    RecordingError if the table of times cannot be read.
    """
    if spec.times is not None and spec.fps is not None:
        raise SessionError(f"sensor {spec.sensor!r}: found times and fps, only one is allowed")
    if spec.times is not None:
        return read_times(spec.times)
    if spec.fps is None:
        return None
    fps = spec.fps
    if not (math.isfinite(fps) and fps > 0):
        raise SessionError(f"sensor {spec.sensor!r}: fps: found {fps}, allowed is above 0")
    return lambda number: number / fps
