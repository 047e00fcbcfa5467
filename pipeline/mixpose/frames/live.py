"""Live sources: cameras and streams that do not wait, of which only the newest frame counts.

A frame that arrives while the one before it is still being estimated is passed over when a newer
one is there.  Numbers count all frames that arrived, so that those passed over leave gaps.  A
source that falls silent is opened again for a while; meanwhile the others go on without it.
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
from mixpose.frames.source import Frames, Source, SourceKind, SourceSpec, selection
from mixpose.frames.times import Clock
from mixpose.records import FrameSet, Moment, RawFrame

_CAMERA = re.compile(r"camera:(\d{1,4})")
_SCHEMES = {"rtsp", "rtsps", "rtp", "rtmp", "udp", "tcp", "srt", "http", "https"}
# what a server sends from a file is sent as fast as it is read
_FILES = {".avi", ".mp4", ".m4v", ".mkv", ".mov", ".webm", ".mpg", ".mpeg", ".ts"}
_FAREWELL_S = 1.0

STALLED_S = 3.0  # that the others wait for a source that has given frames before
RETURN_S = 60.0  # that a source that has given frames may be away, until the run ends
_KEPT = 8  # frames of each source to choose from where several are paired
_AGAIN_S = 0.5  # between two attempts to open it

# these carry the sender's clock; stamps of other streams FFmpeg makes up from a nominal rate
_STAMPED = ("rtsp://", "rtsps://", "rtp://", "rtmp://", "srt://", "udp://")


def live_address(source: str) -> str | int | None:
    """The camera's index or address where a source is live; None where it is a recording."""
    if camera := _CAMERA.fullmatch(source):
        return int(camera[1])
    if captures.is_device(source):
        return source
    scheme, _, rest = source.partition("://")
    if not rest or scheme.lower() not in _SCHEMES:
        return None
    suffix = PurePosixPath(urlsplit(source).path).suffix.lower()
    return None if scheme.lower().startswith("http") and suffix in _FILES else source


def open_live(spec: SourceSpec, source: str, clock: Clock | None) -> LiveSource:
    """A camera or a stream, opened when its frames are asked for."""
    address = live_address(source)
    assert address is not None, "recognised as live"
    return LiveSource(address, spec.resolution, clock)


@dataclass(frozen=True)
class LiveSource(Source):
    """A camera or a stream, opened when its frames are asked for."""

    kind: ClassVar[SourceKind] = "live"
    ahead: ClassVar[int] = 0
    first: ClassVar[int] = 0
    length: ClassVar[None] = None

    address: str | int  # of a stream or a device, or the index of a camera
    resolution: tuple[int, int] | None  # size that every frame must have, in px
    clock: Clock | None  # gives the time of a frame; None: since the start, by its moment, in s

    def describe(self) -> str:
        """One line for people."""
        return f"live {captures.name_of(self.address)}, opened when it is needed"

    def check_times(self, wanted: range) -> None:
        """Nothing to look for: nobody knows which frames will come."""

    def frames(self, start: int | None = None, stop: int | None = None, step: int = 1) -> Frames:
        """The newest frame, each time there is one that has not been given yet.

        Raises RecordingError if the source does not open or falls silent.
        """
        wanted = selection(start, stop, step, self.first)
        for frame_set in join_live({"": self}, wanted):
            yield frame_set.frames[""]


def join_live(sources: Mapping[str, LiveSource], wanted: range) -> Generator[FrameSet, None, None]:
    """The newest frames of all sources, once each has one that was not given yet.

    Those of a set were captured nearest to the latest moment which all have reached: at most half a
    period apart. Sets are numbered by the source that has given most frames. One that has ended is
    left out of further sets, and one that is silent until it gives frames again. Raises
    RecordingError if a source does not open or falls silent.
    """
    began = time.monotonic()
    with ExitStack() as stack:
        readers = {
            sensor: stack.enter_context(_Reader(source, began, _KEPT if len(sources) > 1 else 1))
            for sensor, source in sources.items()
        }
        given = dict.fromkeys(readers, -1)
        stalled: set[str] = set()
        number = -1
        while number + 1 < wanted.stop:
            for sensor, reader in readers.items():
                waits = sensor not in stalled or len(stalled) == len(readers)
                patience = None if given[sensor] < 0 else STALLED_S if waits else 0.0
                reader.wait(given[sensor], patience)
            newer = {each: readers[each].newer_than(given[each]) for each in readers}
            going = {each: frames for each, frames in newer.items() if frames}
            left = [each for each in readers if each in going or not readers[each].has_ended]
            if not left:
                return
            readers = {each: readers[each] for each in left}
            stalled = set(left) - set(going)
            if not going:
                continue
            frames = _together(going)
            given.update((sensor, frame.number) for sensor, frame in frames.items())
            number = max(number + 1, *given.values())
            if number in wanted:
                frames = {sensor: replace(frame, number=number) for sensor, frame in frames.items()}
                yield FrameSet(number, next(iter(frames.values())).time_s, frames)


def _together(waiting: Mapping[str, list[RawFrame]]) -> dict[str, RawFrame]:
    """Of each source the frame nearest to the latest moment that all of them have reached."""
    latest = min(_seconds(frames[-1]) for frames in waiting.values())
    return {
        sensor: min(frames, key=lambda frame: abs(_seconds(frame) - latest))
        for sensor, frames in waiting.items()
    }


def _seconds(frame: RawFrame) -> float:
    assert frame.moment is not None, "live frames have moments"
    return frame.moment.seconds


class _Reader:
    """Reads a live source in a thread of its own and keeps its newest frames."""

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
        # a thread that still waits for a silent camera is left to end by itself
        self._thread.join(_FAREWELL_S)

    def wait(self, after: int, patience_s: float | None) -> None:
        """Wait for a frame with a number above `after`, until none will come, or so long."""
        with self._changed:
            self._changed.wait_for(lambda: self.newer_than(after) or self.has_ended, patience_s)
        if self._error is not None and not self.newer_than(after):
            raise self._error

    def newer_than(self, number: int) -> list[RawFrame]:
        """Frames with numbers above this one, the newest last."""
        with self._changed:
            return [frame for frame in self._frames if frame.number > number]

    def _read(self) -> None:
        try:
            self._keep_newest()
        except BaseException as caught:  # whatever it is, it belongs to the consumer
            self._error = caught
        with self._changed:
            self.has_ended = True
            self._changed.notify_all()

    def _keep_newest(self) -> None:
        heard = self._began
        while True:
            before = self._count
            try:
                self._read_on()
                return
            except (captures.SilentError, captures.NotOpenedError):
                heard = time.monotonic() if self._count > before else heard
                address = self._source.address
                lost = isinstance(address, str) and captures.is_pipe(
                    address
                )  # what it held is gone
                if lost or not self._count or time.monotonic() - heard > RETURN_S:
                    raise
            if self._stop.wait(_AGAIN_S):
                return

    def _read_on(self) -> None:
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
    """What is believed of the clocks of cameras."""

    drift: float = constant(1e-4, "by which clocks of cameras differ at most: quartz errs by 5e-5")
    longest_s: float = constant(
        1.0, "from capture to arrival: stamps that are later are of another clock than they were"
    )


class CaptureTimes:
    """Tells from the stamps of a live source when its frames were captured.

    A camera at this machine (V4L2) stamps frames by the machine's own clock, a stream by a clock
    that is off by an unknown time. As no frame arrives before it was captured, the least difference
    seen so far is taken for it (E. Olson, *A Passive Solution to the Sensor Synchronization
    Problem*, IROS 2010): moments are late by the shortest transmission, and free of what others
    took longer.
    """

    def __init__(self, address: str | int) -> None:
        self._is_device = isinstance(address, int) or captures.is_device(address)
        self._has_stamps = self._is_device or str(address).lower().startswith(_STAMPED)
        self._rules = ClockRules()
        self._last: tuple[float, float] | None = None  # stamp, and least difference

    def moment(self, stamp_s: float, arrived: float | None = None) -> Moment:
        """When a frame was captured that arrived, now if not said, with a stamp in seconds."""
        arrived = time.monotonic() if arrived is None else arrived
        last, self._last = self._last, None
        if not self._has_stamps or not stamp_s > (0.0 if last is None else last[0]):
            return Moment(arrived, "arrival")
        off = arrived - stamp_s
        if self._is_device and 0 <= off < self._rules.longest_s:
            return Moment(stamp_s, "capture")
        if last is not None and off - last[1] < self._rules.longest_s:
            off = min(off, last[1] + self._rules.drift * (stamp_s - last[0]))
        self._last = stamp_s, off
        return Moment(stamp_s + off, "capture")
