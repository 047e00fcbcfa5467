"""Frames of several sensors, joined by their numbers, or by the stamps that they go by.

Robots' recorders name images after the nanosecond they were taken in, and cameras that were
triggered together differ by microseconds: such frames, and those of tables that have times and no
numbers, are paired by the nearest stamp.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Generator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from itertools import pairwise
from statistics import median_low

import numpy as np

from mixpose.errors import RecordingError, SessionError
from mixpose.frames.images import ImageSequence
from mixpose.frames.live import LiveSource, join_live
from mixpose.frames.prefetch import prefetch
from mixpose.frames.source import Source, selection
from mixpose.frames.tables import DetectionTable
from mixpose.records import FrameSet, RawFrame

READY_BYTES = 2**24  # for further frames of a source that wait, decoded
MOST_MORE = 13  # of these: a pose may then take as long as sixteen others and delay no decoder
_PART = 2  # of the usual distance of frames a half: farther apart they are different moments


def pair(
    sources: Mapping[str, Source], start: int | None = None, stop: int | None = None, step: int = 1
) -> Generator[FrameSet, None, None]:
    """Join the frames of all sources by number, ascending; of live ones the newest frames.

    Numbers are those of ``range(start, stop, step)``, without `start` from the first that there is.
    A set lacks the sources that lack its number; its time is that of the first sensor, in the order
    of `sources`, that has one. Only a few frames of each source are in memory, decoded ahead in a
    thread where that pays; threads end with this generator.

    Raises at once: SessionError if `step` is less than 1, or live sources and recordings are mixed;
    RecordingError if a table of times lacks rows for frames of that range. What cannot be read is a
    RecordingError in place of the first set that lacks it.
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
            frames_of = source.frames(wanted.start, wanted.stop, wanted.step)
            if source.ahead:
                frames_of = prefetch(frames_of, source.ahead, _more_ahead)
            streams[sensor] = frames_of
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
                if time_s < last[sensor]:  # velocities would be anything
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
    """How many more frames like this one are worth keeping ready: small ones, for slow poses."""
    size = frame.data.nbytes if isinstance(frame.data, np.ndarray) else READY_BYTES
    return min(MOST_MORE, READY_BYTES // max(size, 1))


def paired_by_stamp(sources: Mapping[str, Source]) -> dict[str, Source]:
    """Sources of which those that go by stamps count frames alike; each keeps its own times.

    A frame gets the number of the nearest one of the sensors before, if that is nearer than half
    the usual distance between frames and has no nearer one of the same sensor.
    """
    stamped = {name: found for name, source in sources.items() if (found := _stamps_of(source))}
    if len(stamped) < 2:
        return dict(sources)
    numbers, known = dict[str, list[int]](), list[int]()
    steps = [[b - a for a, b in pairwise(stamps)] for stamps in stamped.values()]
    reach = min((median_low(each) // _PART for each in steps if each), default=math.inf)
    for name, stamps in stamped.items():
        numbers[name] = _nearest(stamps, known, reach)
        known = sorted({*known, *numbers[name]})
    # beside images a moment has their number, else its place among all
    named = any(isinstance(sources[name], ImageSequence) for name in stamped)
    places = {stamp: stamp if named else place for place, stamp in enumerate(known)}
    renumbered = {
        name: _renumbered(sources[name], [places[stamp] for stamp in found])
        for name, found in numbers.items()
    }
    return {**sources, **renumbered}


def _stamps_of(source: Source) -> Sequence[int]:
    """Nanoseconds that frames of a source go by; none where they have numbers."""
    if isinstance(source, ImageSequence):
        return source.numbers if source.is_stamped else ()
    return source.stamps if isinstance(source, DetectionTable) else ()


def _nearest(numbers: Sequence[int], known: Sequence[int], reach: float) -> list[int]:
    """For each number the nearest known one within reach, or itself; none is given twice."""
    owners: dict[int, tuple[int, int]] = {}
    for place, number in enumerate(numbers):
        at = bisect_left(known, number)
        near = min(known[max(at - 1, 0) : at + 1], key=lambda one: abs(one - number), default=None)
        if near is not None and abs(near - number) < reach:
            this = abs(near - number), place
            owners[near] = min(owners.get(near, this), this)
    found = list(numbers)
    for near, (_, place) in owners.items():
        found[place] = near
    return found


def _renumbered(source: Source, numbers: Sequence[int]) -> Source:
    """The same frames with other numbers, and the times that they had."""
    if isinstance(source, DetectionTable):
        return replace(source, places=numbers)
    assert isinstance(source, ImageSequence), "what has stamps"
    clock = source.clock
    assert clock is not None, "stamps tell the time"
    times = {new: clock(old) for new, old in zip(numbers, source.numbers, strict=True)}
    ordered, paths = zip(*sorted(zip(numbers, source.paths, strict=True)), strict=True)
    return replace(source, paths=paths, numbers=ordered, clock=times.__getitem__)
