"""Define sources of raw frames: their specification by the user, their base, their frames."""

from __future__ import annotations

from collections.abc import Generator, Sequence
from dataclasses import dataclass
from numbers import Integral
from pathlib import Path
from typing import Any, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from mixpose.errors import SessionError
from mixpose.frames.times import Clock, FrameTimes
from mixpose.records import PointPattern, RawFrame

SensorKind: TypeAlias = Literal["camera", "lateration", "cloud"]
SourceKind: TypeAlias = Literal["images", "video", "live", "detections", "profiles"]
Frames: TypeAlias = Generator[RawFrame, None, None]

ALL_NUMBERS = range(-(10**256), 10**256)
"""All possible numbers of frames: those of file names have at most 255 digits."""

_STRIDE = 37  # every 37th row and column of an image are compared first


@dataclass(frozen=True)
class SourceSpec:
    """Specification of the recording of a sensor in the session."""

    sensor: str  # name of the sensor; only for messages
    source: str | tuple[str, ...]  # glob, folder, file, pipe, address or ``camera:0``; or images
    base: Path  # folder to which `source` is relative
    kind: SensorKind  # what the sensor measures
    resolution: tuple[int, int] | None = None  # px of all images; None: that of the first one
    times: Path | None = None  # table ``frame,time_s``, not relative to `base`
    fps: float | None = None  # frames per second: the time of frame n is n / fps
    # range of the first bin of a profile and distance from bin to bin, in length units
    range_min: float | None = None
    bin_size: float | None = None


class Source:
    """A recording of a sensor, read as a stream; `frames` may be called any number of times."""

    clock: Clock | None  # gives the time of a frame number

    @property
    def kind(self) -> SourceKind:
        """Kind of data in the recording."""
        raise NotImplementedError

    @property
    def ahead(self) -> int:
        """Number of frames to decode ahead in a thread; 0 if reading is cheap."""
        return 0

    @property
    def length(self) -> int | None:
        """Number of frames; None if only reading to the end would tell."""
        return None

    @property
    def first(self) -> int | None:
        """Number of the first frame; None without frames."""
        return 0

    def known_numbers(self) -> Sequence[int] | None:
        """Return the frame numbers, ascending; None if only decoding would tell."""
        return None if self.length is None else range(self.length)

    def describe(self) -> str:
        """Describe the source in a line: kind, number of frames, frame numbers."""
        raise NotImplementedError

    def caution(self) -> str | None:
        """Describe what is odd about a readable recording; None if nothing is."""
        return None

    def check_times(self, wanted: range) -> None:
        """Require times of the frames known beforehand, without decoding; else RecordingError."""
        if isinstance(self.clock, FrameTimes):
            self.clock.require(n for n in self.known_numbers() or () if n in wanted)

    def frames(self, start: int | None = None, stop: int | None = None, step: int = 1) -> Frames:
        """Yield the frames of ``range(start, stop, step)``, as by `selection`, in ascending order.

        Skipped frames are not decoded. A RecordingError is raised in place of the first frame that
        cannot be read.
        """
        return self._frames(selection(start, stop, step, self.first))

    def _frames(self, wanted: range) -> Frames:
        raise NotImplementedError


def selection(start: int | None, stop: int | None, step: int, first: int | None) -> range:
    """Return frame numbers as `range`, by default all from `first`; or raise SessionError."""
    given: dict[str, Any] = {"start": start, "stop": stop, "step": step}
    for name, value in given.items():
        if value is not None and not isinstance(value, Integral):
            raise SessionError(f"{name}: found {value!r}, allowed is a whole number")
    if step < 1:
        raise SessionError(f"step: found {step}, allowed is a whole number from 1")
    if start is None:
        start = first or 0
    return range(start, ALL_NUMBERS.stop if stop is None else stop, step)


def numbers_text(first: int, last: int, count: int) -> str:
    """Describe frame numbers: ``frames 1-12``, ``frames 0-5 with gaps``."""
    if count == 1:
        return f"frame {first}"
    gaps = "" if last - first + 1 == count else " with gaps"
    return f"frames {first}-{last}{gaps}"


def shown_by(frame: RawFrame) -> NDArray[Any] | None:
    """Return the image of a frame, or its detections; None for another pattern."""
    if isinstance(frame.data, PointPattern):
        return frame.data.points
    return frame.data if isinstance(frame.data, np.ndarray) else None


def is_same(before: NDArray[Any] | None, now: NDArray[Any]) -> bool:
    """Test whether two frames are equal to the last digit; with noise they never are."""
    if before is None or before.shape != now.shape:
        return False
    few = np.array_equal(before[::_STRIDE, ::_STRIDE], now[::_STRIDE, ::_STRIDE])
    return few and bool(np.array_equal(before, now))
