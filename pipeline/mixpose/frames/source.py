"""What a source of raw frames is: the user's words for it and what it can do."""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass
from numbers import Integral
from pathlib import Path
from typing import Any, Literal, Protocol, TypeAlias

from mixpose.errors import SessionError
from mixpose.records import RawFrame

SensorKind: TypeAlias = Literal["camera", "lateration", "cloud"]
SourceKind: TypeAlias = Literal["images", "video", "live", "detections", "profiles"]
Frames: TypeAlias = Generator[RawFrame, None, None]

ALL_NUMBERS = range(-(10**256), 10**256)
"""The numbers of all frames that there may be: those of file names have at most 255 digits."""


@dataclass(frozen=True)
class SourceSpec:
    """What the session says about the recording of one sensor."""

    sensor: str  # name of the sensor; only for messages
    source: str | tuple[str, ...]  # glob, folder, file, pipe, address or ``camera:0``; or images
    base: Path  # folder that a relative `source` starts from
    kind: SensorKind  # what the sensor measures
    resolution: tuple[int, int] | None = None  # px of every image; None means like the first one
    times: Path | None = None  # table ``frame,time_s``, not relative to `base`
    fps: float | None = None  # frames per second: the time of frame n is n / fps
    # range of the first bin of a profile and distance from bin to bin, in length units
    range_min: float | None = None
    bin_size: float | None = None


class Source(Protocol):
    """A recording of one sensor, read as a stream; `frames` may be called any number of times."""

    @property
    def kind(self) -> SourceKind:
        """What the recording consists of."""

    @property
    def length(self) -> int | None:
        """Number of frames; None where only reading to the end would tell."""

    @property
    def first(self) -> int | None:
        """Number of the first frame; None if there is none."""

    @property
    def ahead(self) -> int:
        """How many frames are worth decoding ahead in a thread; 0 where reading is cheap."""

    def describe(self) -> str:
        """One line for people: what, how many, which numbers."""

    def caution(self) -> str | None:
        """What is odd about the recording though it can be read; None if nothing is."""
        return None

    def check_times(self, wanted: range) -> None:
        """Look for a time for each frame in a range of numbers, without decoding frames.

        Raises RecordingError if the table of times lacks rows, as far as numbers are known before.
        """

    def frames(self, start: int | None = None, stop: int | None = None, step: int = 1) -> Frames:
        """Frames by ascending number, those of ``range(start, stop, step)`` only, as `selection`.

        Skipped frames are not decoded. A RecordingError comes in place of the first frame that
        cannot be read.
        """


def selection(start: int | None, stop: int | None, step: int, first: int | None) -> range:
    """Frame numbers to read, as by `range`; without `start` from the first, without `stop` all.

    Raises SessionError if one is no whole number, or `step` less than 1.
    """
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
    """Frame numbers for people: ``frames 1-12``, ``frames 0-5 with gaps``."""
    if count == 1:
        return f"frame {first}"
    gaps = "" if last - first + 1 == count else " with gaps"
    return f"frames {first}-{last}{gaps}"
