"""Read range profiles as a source: a signal over range, a row per frame."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from mixpose.errors import RecordingError, SessionError
from mixpose.frames.source import Frames, Source, SourceKind, SourceSpec, numbers_text
from mixpose.frames.times import Clock, csv_rows, finite
from mixpose.limits import LARGEST_VALUE, MOST_BINS
from mixpose.records import GridPattern, RawFrame


@dataclass(frozen=True)
class RangeProfiles(Source):
    """Range profiles of a sensor, numbered from 0."""

    kind: ClassVar[SourceKind] = "profiles"

    path: Path  # ``.npy`` (frames x bins) or ``.csv`` without a header, a row per frame
    range_min: float  # range of the first bin, length units
    bin_size: float
    clock: Clock | None  # gives the time of a frame number
    bins: int  # number of bins in each profile

    @cached_property
    def length(self) -> int:
        """Number of profiles, including those missing from a file cut short."""
        if _is_npy(self.path):
            return _map_npy(self.path)[1]
        with self.path.open("rb") as file:
            return sum(1 for line in file if not line.isspace())

    @property
    def first(self) -> int | None:
        """Number of the first profile; None without profiles."""
        return 0 if self.bins else None

    def describe(self) -> str:
        """Describe the source in a line."""
        if not self.bins:
            return "0 range profiles"
        reach = self.range_min + (self.bins - 1) * self.bin_size
        plural = "" if self.length == 1 else "s"
        return (
            f"{self.length} range profile{plural} of {self.bins} bins from {self.range_min:g} to "
            f"{reach:g}, {numbers_text(0, self.length - 1, self.length)}"
        )

    def _frames(self, wanted: range) -> Frames:
        rows = _npy_rows if _is_npy(self.path) else _csv_rows
        for number, values in rows(self.path, wanted):
            time_s = None if self.clock is None else self.clock(number)
            pattern = GridPattern(values[None], np.array([self.range_min]), self.bin_size)
            yield RawFrame(number, time_s, pattern)


def open_profiles(spec: SourceSpec, path: Path, clock: Clock | None) -> RangeProfiles:
    """Open range profiles; a SessionError without a grid, a RecordingError if not frames x bins."""
    range_min = _option(spec, "range_min", spec.range_min)
    bin_size = _option(spec, "bin_size", spec.bin_size)
    if bin_size <= 0:
        raise SessionError(
            f"sensor {spec.sensor!r}: bin_size: found {bin_size:g}, allowed is above 0"
        )
    if _is_npy(path):
        bins = _map_npy(path)[2]
    else:
        bins = len(next(csv_rows(path), (0, []))[1])
    if bins > MOST_BINS:
        raise RecordingError(f"{path}: found {bins} bins in a profile, allowed are {MOST_BINS}")
    return RangeProfiles(path, range_min, bin_size, clock, bins)


def _option(spec: SourceSpec, key: str, value: float | None) -> float:
    if value is None:
        raise SessionError(f"sensor {spec.sensor!r}: {key} is missing; range profiles need it")
    if not math.isfinite(value):
        raise SessionError(
            f"sensor {spec.sensor!r}: {key}: found {value}, allowed is a finite number"
        )
    return float(value)


def _is_npy(path: Path) -> bool:
    return path.suffix.casefold() == ".npy"


def _map_npy(path: Path) -> tuple[NDArray[Any], int, int]:
    """Return the mapped rows of a file, the promised number of rows, and the number of bins."""
    try:
        with path.open("rb") as file:
            version = np.lib.format.read_magic(file)
            read_header = {
                (1, 0): np.lib.format.read_array_header_1_0,
                (2, 0): np.lib.format.read_array_header_2_0,
            }[version]
            shape, by_columns, dtype = read_header(file)
            offset = file.tell()
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read: {error.strerror}") from error
    except Exception as error:  # NumPy parses the header as Python, which fails in many ways
        raise RecordingError(f"{path}: not a .npy file or cut short") from error
    are_counts = all(type(count) is int and count > 0 for count in shape)
    if len(shape) != 2 or by_columns or dtype.kind not in "fiu" or not are_counts:
        order = " by columns" if by_columns else ""
        raise RecordingError(
            f"{path}: found {dtype} of shape {shape}{order}, allowed are numbers in the shape "
            f"(frames, bins), row by row"
        )
    promised, bins = shape
    held = (path.stat().st_size - offset) // (bins * dtype.itemsize)
    if held == 0:
        raise RecordingError(f"{path}: cut short: profile 0 is not whole")
    rows = np.memmap(path, dtype=dtype, mode="r", offset=offset, shape=(min(held, promised), bins))
    return rows, promised, bins


def _npy_rows(path: Path, wanted: range) -> Iterator[tuple[int, NDArray[np.float32]]]:
    rows, promised, _ = _map_npy(path)
    for number in wanted:
        if number >= promised:
            return
        if number < 0:
            continue
        if number >= len(rows):
            raise RecordingError(
                f"{path}: cut short: {len(rows)} of the {promised} profiles that it promises are "
                f"whole, from 0"
            )
        yield number, _single_precision(np.asarray(rows[number]), path, number)


def _csv_rows(path: Path, wanted: range) -> Iterator[tuple[int, NDArray[np.float32]]]:
    for number, (line, cells) in enumerate(csv_rows(path)):
        if line != number + 1:
            raise RecordingError(f"{path}, line {number + 1}: blank; there must be a row per frame")
        if number >= wanted.stop:
            return
        if number in wanted:
            values = [finite(cell, path, line, f"bin {at}") for at, cell in enumerate(cells)]
            yield number, _single_precision(np.array(values), path, number)


def _single_precision(values: NDArray[Any], path: Path, number: int) -> NDArray[np.float32]:
    """Return a profile in single precision, in which its squares can be summed; else raise."""
    allowed = np.abs(values) <= LARGEST_VALUE
    if not allowed.all():
        at = int(np.argmin(allowed))
        raise RecordingError(
            f"{path}: frame {number}, bin {at}: found {values[at]}, allowed are finite numbers "
            f"up to {LARGEST_VALUE:g}"
        )
    return values.astype(np.float32)
