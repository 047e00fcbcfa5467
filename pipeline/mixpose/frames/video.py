"""Read video files and streams as a source."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import cv2

from mixpose.errors import RecordingError, reporting
from mixpose.frames import capture as captures
from mixpose.frames.containers import container_of, missing_bytes
from mixpose.frames.source import Frames, Source, SourceKind, SourceSpec, numbers_text
from mixpose.frames.times import Clock, FrameTimes
from mixpose.limits import MOST_PIXELS
from mixpose.records import Moment, RawFrame


@dataclass(frozen=True)
class Video(Source):
    """A video, numbered from 0."""

    kind: ClassVar[SourceKind] = "video"
    ahead: ClassVar[int] = 3

    address: str  # path of the file or pipe, or address of a stream (with ``://``)
    resolution: tuple[int, int] | None  # size that every frame must have, in px
    clock: Clock | None  # gives the time of a frame number; None: times in the video
    size: tuple[int, int] | None  # stated by the container; None for a stream
    promised: int | None  # number of frames by the container, perhaps estimated
    missing: int  # bytes that the file lacks; see `missing_bytes`

    @property
    def length(self) -> int | None:
        """Number of frames that the container promises."""
        return self.promised

    def describe(self) -> str:
        """Describe the source in a line."""
        if self.size is None:
            return f"video stream {self.address}"
        size = f"video {self.size[0]}x{self.size[1]}"
        if self.promised is None:
            return f"{size}, frames from 0"
        return f"{size}, {numbers_text(0, self.promised - 1, self.promised)}"

    def check_times(self, wanted: range) -> None:
        """Require a time for each frame in the range; count the frames if rows are missing."""
        promised = [number for number in range(self.promised or 0) if number in wanted]
        if isinstance(self.clock, FrameTimes) and self.clock.missing(promised):
            enough, count = min(promised[-1] + 1, wanted.stop), 0
            with _opened(self.address) as capture:
                while count < enough and captures.grab(capture, self.address):
                    count += 1
            self.clock.require(number for number in promised if number < count)

    def _frames(self, wanted: range) -> Frames:
        """Decode the frames; the last of a file cut short may be incomplete and is left out."""
        expected, room = self.resolution or self.size, captures.ColourRoom()
        number, time_s = 0, None
        pending: RawFrame | None = None
        with _opened(self.address) as capture:
            while number < wanted.stop or pending is not None:
                if not captures.grab(capture, self.address):
                    self._check_end(capture, number, time_s)
                    return
                if pending is not None:
                    yield pending
                    pending = None
                time_s = _time_of(capture, number, time_s)
                if number in wanted:
                    moment = Moment(time.monotonic(), "arrival") if self.size is None else None
                    image = captures.retrieve(capture, self.address, number, expected, room)
                    seconds = time_s if self.clock is None else self.clock(number)
                    frame = RawFrame(number, seconds, image, moment)
                    if self.missing:
                        pending = frame
                    else:
                        yield frame
                number += 1

    def _check_end(self, capture: cv2.VideoCapture, count: int, last_time_s: float | None) -> None:
        """Raise a RecordingError if the video should not end after `count` frames."""
        if self.missing:
            raise RecordingError(
                f"{self.address}: cut short, {self.missing} bytes are missing; "
                f"{self._reached(count - 1)}"
            )
        if count == 0 and captures.is_pipe(self.address):
            raise RecordingError(
                f"{self.address}: no frame could be read from this pipe; an .mp4 or .mov has its "
                "index at its end as a rule and cannot be read from a pipe then: name the file "
                "itself, or write .mkv or .avi to the pipe"
            )
        lost = self.size is not None and count == 0
        if lost or self._ends_early(capture, count, last_time_s):
            raise RecordingError(f"{self.address}: damaged or cut short; {self._reached(count)}")

    def _reached(self, count: int) -> str:
        promised = f" of the {self.promised} that it promises" if self.promised else ""
        which = f"only {numbers_text(0, count - 1, count)}" if count > 0 else "no frame"
        return f"{which}{promised} could be read"

    def _ends_early(self, capture: cv2.VideoCapture, count: int, last_time_s: float | None) -> bool:
        """Test whether the end is lost, and not the promised number a mere estimate."""
        # whole MP4 and Matroska files may hold fewer frames than FFmpeg counts (edit lists, varying
        # rates). In other containers the *time* of the last frame decides: a varying rate keeps it,
        # lost frames do not
        fps = capture.get(cv2.CAP_PROP_FPS)
        promised = self.promised or 0
        if count >= promised or last_time_s is None or not 0 < fps < math.inf:
            return False
        container = container_of(Path(self.address))
        if container in ("mp4", "matroska"):
            return False
        duration = promised / fps
        slack = 0.5 / fps if container == "avi" else max(0.5, 0.02 * duration)
        return last_time_s + 1 / fps < duration - slack


def open_video(spec: SourceSpec, address: str, clock: Clock | None) -> Video:
    """Open a video for its size and length, a stream or a pipe later; or raise RecordingError."""
    if captures.is_stream(address):
        return Video(address, spec.resolution, clock, size=None, promised=None, missing=0)
    with _opened(address) as capture:
        width = int(capture.get(cv2.CAP_PROP_FRAME_WIDTH))
        height = int(capture.get(cv2.CAP_PROP_FRAME_HEIGHT))
        count = capture.get(cv2.CAP_PROP_FRAME_COUNT)
    if spec.resolution is not None and spec.resolution != (width, height):
        raise RecordingError(
            f"{address}: found {width}x{height} pixels, allowed is "
            f"{spec.resolution[0]}x{spec.resolution[1]} like the sensor's resolution"
        )
    if width * height > MOST_PIXELS:
        raise RecordingError(
            f"{address}: found {width}x{height} pixels, allowed are {MOST_PIXELS} together"
        )
    promised = int(count) if math.isfinite(count) and count >= 1 else None
    with reporting(RecordingError, f"{address}: cannot be read"):
        missing = missing_bytes(Path(address))
    return Video(address, spec.resolution, clock, (width, height), promised, missing)


@contextmanager
def _opened(address: str) -> Iterator[cv2.VideoCapture]:
    """Open a file, a pipe or a stream; the error of a file says why, by its bytes."""
    try:
        with captures.opened(address) as capture:
            yield capture
    except captures.NotOpenedError as error:
        if captures.is_stream(address):
            raise
        raise RecordingError(_opening_fault(address)) from error


def _opening_fault(address: str) -> str:
    """Describe why a video does not open, as far as its bytes show it."""
    try:
        container, cut = container_of(Path(address)), missing_bytes(Path(address))
    except OSError as error:
        return f"{address}: cannot be read: {error.strerror}"
    if cut:
        return f"{address}: cut short, {cut} bytes are missing: frame 0 cannot be read"
    if container:
        return f"{address}: damaged or cut short: frame 0 cannot be read"
    return (
        f"{address}: opens neither as an image nor as a video; allowed are images, videos, "
        f".csv tables and .npy profiles"
    )


def _time_of(capture: cv2.VideoCapture, number: int, previous_s: float | None) -> float | None:
    """Return the time of the grabbed frame in s: its stamp if it ascends, or else by the rate."""
    time_s = capture.get(cv2.CAP_PROP_POS_MSEC) / 1000
    if math.isfinite(time_s) and (number == 0 or previous_s is None or time_s > previous_s):
        return time_s
    fps = capture.get(cv2.CAP_PROP_FPS)
    return number / fps if 0 < fps < math.inf else None
