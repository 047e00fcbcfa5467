"""Join frames of several sensors, by their numbers or by their stamps, and read them ahead.

Recorders of robots name images after the nanosecond of their capture, and cameras triggered
together differ by microseconds: such frames, and those of tables with times but no numbers, are
paired by the nearest stamp.
"""

from __future__ import annotations

import math
import threading
from bisect import bisect_left
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from itertools import pairwise
from queue import SimpleQueue
from statistics import median_low
from typing import TypeVar

import numpy as np

from mixpose.errors import RecordingError, SessionError
from mixpose.frames.images import ImageSequence
from mixpose.frames.live import LiveSource, join_live
from mixpose.frames.source import Source, selection
from mixpose.frames.tables import DetectionTable
from mixpose.records import FrameSet, RawFrame

T = TypeVar("T")

READY_BYTES = 2**24  # for further decoded frames of a source that wait
MOST_MORE = 13  # further frames: a pose may take as long as 16 others, and not delay a decoder
_REACH_DIVISOR = 2  # of the usual distance of frames: half of it apart, moments differ


def pair(
    sources: Mapping[str, Source], start: int | None = None, stop: int | None = None, step: int = 1
) -> Generator[FrameSet, None, None]:
    """Join the frames of all sources by number, ascending; of live sources the newest frames.

    Numbers are those of ``range(start, stop, step)``, without `start` from the first existing one.
    A set lacks the sources that lack its number; its time is that of the first sensor, in the order
    of `sources`, that has one. Only a few frames of each source are in memory, decoded ahead in a
    thread where that pays; threads end with this generator.

    Raises at once: SessionError if `step` is less than 1, or live sources and recordings are mixed;
    RecordingError if a table of times lacks rows for frames of that range. A frame that cannot be
    read raises a RecordingError in place of its set.
    """
    live = {sensor: source for sensor, source in sources.items() if isinstance(source, LiveSource)}
    if live and len(live) < len(sources):
        recorded = next(sensor for sensor in sources if sensor not in live)
        raise SessionError(
            f"source: {next(iter(live))!r} is live and {recorded!r} is a recording; allowed: all "
            "sensors live, or none"
        )
    if live:
        return join_live(live, selection(start, stop, step, 0))
    firsts = [source.first for source in sources.values()]
    first = min((number for number in firsts if number is not None), default=0)
    wanted = selection(start, stop, step, first)
    for source in sources.values():
        source.check_times(wanted)
    return _join(sources, wanted)


def _join(sources: Mapping[str, Source], wanted: range) -> Generator[FrameSet, None, None]:
    with ExitStack() as stack:
        streams = {}
        for sensor, source in sources.items():
            stream = source.frames(wanted.start, wanted.stop, wanted.step)
            if source.ahead:
                stream = prefetch(stream, source.ahead, _more_ahead)
            streams[sensor] = stream
        for stream in streams.values():
            stack.callback(stream.close)
        heads = {sensor: next(stream, None) for sensor, stream in streams.items()}
        last = dict.fromkeys(sources, -math.inf)
        while waiting := [head.number for head in heads.values() if head is not None]:
            number = min(waiting)
            frames = {
                sensor: head
                for sensor, head in heads.items()
                if head is not None and head.number == number
            }
            for sensor, head in frames.items():
                time_s = last[sensor] if head.time_s is None else head.time_s
                if time_s < last[sensor]:  # velocities would be arbitrary
                    raise RecordingError(
                        f"sensor {sensor!r}: frame {head.number} is at {time_s:g} s and the frame "
                        f"before it at {last[sensor]:g} s; allowed are times that do not go back"
                    )
                last[sensor] = time_s
            times = (frame.time_s for frame in frames.values() if frame.time_s is not None)
            yield FrameSet(number, next(times, None), frames)
            for sensor in frames:
                heads[sensor] = next(streams[sensor], None)


def _more_ahead(frame: RawFrame) -> int:
    """Return how many more frames of this size to keep ready, for the time of a slow pose."""
    size = frame.data.nbytes if isinstance(frame.data, np.ndarray) else READY_BYTES
    return min(MOST_MORE, READY_BYTES // max(size, 1))


def prefetch(
    items: Iterator[T], depth: int = 3, more: Callable[[T], int] | None = None
) -> Generator[T, None, None]:
    """Yield `items` in order while a worker thread fetches the next ones.

    The thread ends when this generator is exhausted, closed or collected; only that thread advances
    `items`, and closes it if it can be closed. An exception of `items` is raised in its place. At
    most `depth` items wait, and another may be on its way; `more` is called with the first item and
    returns how many more may wait.
    """
    # items in tuples of one, and in the end the exception raised, or None
    waiting: SimpleQueue[tuple[T] | BaseException | None] = SimpleQueue()
    room: SimpleQueue[None] = SimpleQueue()
    for _ in range(max(depth, 1)):
        room.put(None)
    stop = threading.Event()

    def fetch() -> None:
        """Move items to the queue as there is room, until they end, fail or are stopped."""
        # two unbounded queues cost less than a bounded one, as their locks are not in Python
        error: BaseException | None = None
        try:
            with ExitStack() as closing:
                closing.callback(getattr(items, "close", lambda: None))
                for k, item in enumerate(items):
                    for _ in range(more(item) if more and not k else 0):
                        room.put(None)
                    room.get()
                    if stop.is_set():
                        break
                    waiting.put((item,))
        except BaseException as caught:  # the consumer raises it
            error = caught
        if not stop.is_set():
            waiting.put(error)

    worker = threading.Thread(target=fetch, name="mixpose-prefetch", daemon=True)
    worker.start()
    try:
        while isinstance(entry := waiting.get(), tuple):
            room.put(None)
            yield entry[0]
        if entry is not None:
            raise entry
    finally:
        stop.set()
        room.put(None)  # wakes a worker that waits for room, so that it stops
        # the garbage collector may close this generator in the thread of the worker
        if worker is not threading.current_thread():
            worker.join()


def paired_by_stamp(sources: Mapping[str, Source]) -> dict[str, Source]:
    """Renumber the frames of sources that have stamps, so that they pair; they keep their times.

    A frame gets the number of the nearest frame of earlier sensors, if that is nearer than half the
    usual distance between frames, and no other frame of the same sensor is nearer to it.
    """
    stamped = {name: stamps for name, source in sources.items() if (stamps := _stamps_of(source))}
    if len(stamped) < 2:
        return dict(sources)
    numbers, known = dict[str, list[int]](), list[int]()
    steps = [[b - a for a, b in pairwise(stamps)] for stamps in stamped.values()]
    reach = min((median_low(gaps) // _REACH_DIVISOR for gaps in steps if gaps), default=math.inf)
    for name, stamps in stamped.items():
        numbers[name] = _nearest_known(stamps, known, reach)
        known = sorted({*known, *numbers[name]})
    # with images, the number is the stamp of the moment; else the index among all moments
    has_images = any(isinstance(sources[name], ImageSequence) for name in stamped)
    numbers_by_stamp = {stamp: stamp if has_images else index for index, stamp in enumerate(known)}
    renumbered = {
        name: _renumbered(sources[name], [numbers_by_stamp[stamp] for stamp in stamps])
        for name, stamps in numbers.items()
    }
    return {**sources, **renumbered}


def _stamps_of(source: Source) -> Sequence[int]:
    """Return the stamps of a source in nanoseconds; none if its frames have numbers."""
    if isinstance(source, ImageSequence):
        return source.numbers if source.is_stamped else ()
    return source.stamps if isinstance(source, DetectionTable) else ()


def _nearest_known(numbers: Sequence[int], known: Sequence[int], reach: float) -> list[int]:
    """Replace numbers by the nearest known ones within reach; none is used twice."""
    owners: dict[int, tuple[int, int]] = {}
    for index, number in enumerate(numbers):
        k = bisect_left(known, number)
        near = min(known[max(k - 1, 0) : k + 1], key=lambda n: abs(n - number), default=None)
        if near is not None and abs(near - number) < reach:
            claim = abs(near - number), index
            owners[near] = min(owners.get(near, claim), claim)
    result = list(numbers)
    for near, (_, index) in owners.items():
        result[index] = near
    return result


def _renumbered(source: Source, numbers: Sequence[int]) -> Source:
    if isinstance(source, DetectionTable):
        return replace(source, places=numbers)
    assert isinstance(source, ImageSequence), "what has stamps"
    clock = source.clock
    assert clock is not None, "stamps tell the time"
    times = {new: clock(old) for new, old in zip(numbers, source.numbers, strict=True)}
    ordered, paths = zip(*sorted(zip(numbers, source.paths, strict=True)), strict=True)
    return replace(source, paths=paths, numbers=ordered, clock=times.__getitem__)
