"""Read live sources: cameras and streams that do not wait, of which only the newest frame counts.

A frame that arrives during the estimate of the frame before is skipped as soon as a newer one has
arrived.  Numbers count all frames that arrived, so that skipped ones leave gaps.  A source that
falls silent is opened again for a while; meanwhile the others go on without it.
"""

from __future__ import annotations

import re
import threading
import time
from collections import deque
from collections.abc import Generator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import PurePosixPath
from typing import ClassVar
from urllib.parse import urlsplit

import cv2

from mixpose.constants import constant
from mixpose.errors import RecordingError
from mixpose.frames import capture as captures
from mixpose.frames.source import Frames, Source, SourceKind, SourceSpec
from mixpose.frames.times import Clock
from mixpose.records import FrameSet, Moment, RawFrame

_CAMERA = re.compile(r"camera:(\d{1,4})")
_SCHEMES = {"rtsp", "rtsps", "rtp", "rtmp", "udp", "tcp", "srt", "http", "https"}
# suffixes of files, which a server sends as fast as they are read
_FILE_SUFFIXES = {".avi", ".mp4", ".m4v", ".mkv", ".mov", ".webm", ".mpg", ".mpeg", ".ts"}
_JOIN_S = 1.0

STALLED_S = 3.0  # longest time that others wait for a source that has delivered frames
RETURN_S = 60.0  # longest silence of a source that has delivered frames; then the run ends
_NEWEST = 8  # newest frames of each source that are kept for pairing with others
_RETRY_S = 0.5  # between two attempts to open a source

# streams with stamps by the sender's clock; for others FFmpeg invents stamps from a nominal rate
_STAMPED_SCHEMES = ("rtsp://", "rtsps://", "rtp://", "rtmp://", "srt://", "udp://")


def live_address(source: str) -> str | int | None:
    """Return the index or address of a live source; None for a recording."""
    if camera := _CAMERA.fullmatch(source):
        return int(camera[1])
    if captures.is_device(source):
        return source
    scheme, _, location = source.partition("://")
    if not location or scheme.lower() not in _SCHEMES:
        return None
    suffix = PurePosixPath(urlsplit(source).path).suffix.lower()
    return None if scheme.lower().startswith("http") and suffix in _FILE_SUFFIXES else source


def open_live(spec: SourceSpec, source: str, clock: Clock | None) -> LiveSource:
    """Return a camera or a stream as a source."""
    address = live_address(source)
    assert address is not None, "recognised as live"
    return LiveSource(address, spec.resolution, clock)


@dataclass(frozen=True)
class LiveSource(Source):
    """A camera or a stream, opened when its frames are requested."""

    kind: ClassVar[SourceKind] = "live"

    address: str | int  # of a stream or a device, or the index of a camera
    resolution: tuple[int, int] | None  # size that every frame must have, in px
    clock: Clock | None  # gives the time of a frame; None: its moment in s since the start

    def describe(self) -> str:
        """Describe the source in a line."""
        return f"live {captures.name_of(self.address)}, opened when it is needed"

    def _frames(self, wanted: range) -> Frames:
        for frame_set in join_live({"": self}, wanted):
            yield frame_set.frames[""]


def join_live(sources: Mapping[str, LiveSource], wanted: range) -> Generator[FrameSet, None, None]:
    """Yield the newest frames of all sources as soon as all have new ones.

    Frames of a set are those captured nearest to the latest moment that all have reached: at most
    half a period apart. Sets are numbered by the source that has delivered most frames. A source is
    left out of sets after its end, and while it is silent. Raises RecordingError if a source does
    not open or falls silent.
    """
    began = time.monotonic()
    with ExitStack() as stack:
        readers = {
            sensor: stack.enter_context(_Reader(source, began, _NEWEST if len(sources) > 1 else 1))
            for sensor, source in sources.items()
        }
        delivered = dict.fromkeys(readers, -1)
        stalled: set[str] = set()
        number = -1
        while number + 1 < wanted.stop:
            for sensor, reader in readers.items():
                waits = sensor not in stalled or len(stalled) == len(readers)
                patience = None if delivered[sensor] < 0 else STALLED_S if waits else 0.0
                reader.wait(delivered[sensor], patience)
            newer = {sensor: readers[sensor].newer_than(delivered[sensor]) for sensor in readers}
            ready = {sensor: frames for sensor, frames in newer.items() if frames}
            active = [name for name in readers if name in ready or not readers[name].has_ended]
            if not active:
                return
            readers = {sensor: readers[sensor] for sensor in active}
            stalled = set(active) - set(ready)
            if not ready:
                continue
            frames = _nearest_frames(ready)
            delivered.update((sensor, frame.number) for sensor, frame in frames.items())
            number = max(number + 1, *delivered.values())
            if number in wanted:
                frames = {sensor: replace(frame, number=number) for sensor, frame in frames.items()}
                yield FrameSet(number, next(iter(frames.values())).time_s, frames)


def _nearest_frames(frames_by_sensor: Mapping[str, list[RawFrame]]) -> dict[str, RawFrame]:
    """Return the frame of each source that is nearest to the latest moment that all reached."""
    latest = min(_seconds(frames[-1]) for frames in frames_by_sensor.values())
    return {
        sensor: min(frames, key=lambda frame: abs(_seconds(frame) - latest))
        for sensor, frames in frames_by_sensor.items()
    }


def _seconds(frame: RawFrame) -> float:
    assert frame.moment is not None, "live frames have moments"
    return frame.moment.seconds


class _Reader:
    """Reads a live source in a thread and keeps its newest frames."""

    def __init__(self, source: LiveSource, began: float, kept: int) -> None:
        self._source, self._began = source, began
        self._changed = threading.Condition()
        self._frames = deque[RawFrame](maxlen=kept)
        self._count = 0
        self._error: BaseException | None = None
        self.has_ended = False  # no further frame will come
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._read, name="mixpose-live", daemon=True)

    def __enter__(self) -> _Reader:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        # a thread that waits for a silent camera longer than this ends by itself
        self._thread.join(_JOIN_S)

    def wait(self, after: int, patience_s: float | None) -> None:
        """Wait up to `patience_s` for a frame numbered above `after`, or the end of the source."""
        with self._changed:
            self._changed.wait_for(lambda: self.newer_than(after) or self.has_ended, patience_s)
        if self._error is not None and not self.newer_than(after):
            raise self._error

    def newer_than(self, number: int) -> list[RawFrame]:
        """Return frames with numbers above this one, the newest last."""
        with self._changed:
            return [frame for frame in self._frames if frame.number > number]

    def _read(self) -> None:
        try:
            self._keep_newest()
        except BaseException as caught:  # the consumer raises it
            self._error = caught
        with self._changed:
            self.has_ended = True
            self._changed.notify_all()

    def _keep_newest(self) -> None:
        last_heard = self._began
        while True:
            count = self._count
            try:
                self._read_capture()
                return
            except (captures.SilentError, captures.NotOpenedError):
                last_heard = time.monotonic() if self._count > count else last_heard
                address = self._source.address
                # the pending data of a pipe are gone
                is_pipe = isinstance(address, str) and captures.is_pipe(address)
                if is_pipe or not self._count or time.monotonic() - last_heard > RETURN_S:
                    raise
            if self._stop.wait(_RETRY_S):
                return

    def _read_capture(self) -> None:
        address, clock = self._source.address, self._source.clock
        times = CaptureTimes(address)
        with captures.opened(address) as capture:
            while not self._stop.is_set() and captures.grab(capture, address):
                number = self._count
                moment = times.moment(capture.get(cv2.CAP_PROP_POS_MSEC) / 1000)
                image = captures.retrieve(capture, address, number, self._source.resolution)
                time_s = moment.seconds - self._began if clock is None else clock(number)
                with self._changed:
                    self._frames.append(RawFrame(number, time_s, image, moment))
                    self._changed.notify_all()
                self._count += 1
        if isinstance(address, int) and not self._stop.is_set():
            raise RecordingError(f"{captures.name_of(address)}: gives no frames any more")


@dataclass(frozen=True)
class ClockRules:
    """Rules for the clocks of cameras."""

    drift: float = constant(1e-4, "largest relative drift of two clocks: each quartz errs by 5e-5")
    longest_s: float = constant(
        1.0, "longest time from capture to arrival: with later stamps the clock has changed"
    )


class CaptureTimes:
    """Estimates from the stamps of a live source when its frames were captured.

    A camera of this machine (V4L2) stamps frames by the machine's clock, a stream by a clock with
    an unknown offset. As frames arrive after their capture, the least difference of arrival and
    stamp so far is taken for the offset (E. Olson, *A Passive Solution to the Sensor
    Synchronization Problem*, IROS 2010): moments are late by the shortest transmission only.
    """

    def __init__(self, address: str | int) -> None:
        self._is_device = isinstance(address, int) or captures.is_device(address)
        self._has_stamps = self._is_device or str(address).lower().startswith(_STAMPED_SCHEMES)
        self._rules = ClockRules()
        self._last: tuple[float, float] | None = None  # stamp, and least difference

    def moment(self, stamp_s: float, arrived: float | None = None) -> Moment:
        """Return when a frame with a stamp in s was captured; `arrived` is now by default."""
        arrived = time.monotonic() if arrived is None else arrived
        last, self._last = self._last, None
        if not self._has_stamps or not stamp_s > (0.0 if last is None else last[0]):
            return Moment(arrived, "arrival")
        difference = arrived - stamp_s
        if self._is_device and 0 <= difference < self._rules.longest_s:
            return Moment(stamp_s, "capture")
        if last is not None and difference - last[1] < self._rules.longest_s:
            difference = min(difference, last[1] + self._rules.drift * (stamp_s - last[0]))
        self._last = stamp_s, difference
        return Moment(stamp_s + difference, "capture")
