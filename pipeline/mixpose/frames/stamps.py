"""Images named after the nanosecond they were taken in, as robots' recorders do.

The names then say when, and cameras that were triggered together differ by some microseconds: their
frames are paired by the nearest stamp instead of by equal numbers.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from statistics import median

from mixpose.frames.images import ImageSequence
from mixpose.frames.source import Source

_SHARE = 0.5  # of the usual distance of frames: farther apart they belong to different moments


def paired_by_stamp(sources: Mapping[str, Source]) -> dict[str, Source]:
    """Sources of which those named by stamps count frames alike; each keeps its own times.

    A frame gets the number of the nearest one of the sensors before, if that is nearer than half
    the usual distance between frames and has no nearer one of the same sensor.
    """
    stamped = {
        name: source
        for name, source in sources.items()
        if isinstance(source, ImageSequence) and source.is_stamped
    }
    if len(stamped) < 2:
        return dict(sources)
    paired = dict(sources)
    known: list[int] = []
    reach = _SHARE * min(_usual_step(source.numbers) for source in stamped.values())
    for name, source in stamped.items():
        numbers = _nearest(source.numbers, known, reach)
        paired[name] = _renumbered(source, numbers)
        known = sorted({*known, *numbers})
    return paired


def _usual_step(numbers: Sequence[int]) -> float:
    steps = [after - before for before, after in pairwise(numbers)]
    return median(steps) if steps else float("inf")


def _nearest(numbers: Sequence[int], known: Sequence[int], reach: float) -> list[int]:
    """For each number the nearest known one within reach, or itself; none is given twice."""
    owners: dict[int, tuple[int, int]] = {}
    for place, number in enumerate(numbers):
        at = bisect_left(known, number)
        near = min(known[max(at - 1, 0) : at + 1], key=lambda one: abs(one - number), default=None)
        if near is not None and abs(near - number) < reach:
            owners[near] = min(owners.get(near, (abs(near - number), place)),
                               (abs(near - number), place))  # fmt: skip
    found = list(numbers)
    for near, (_, place) in owners.items():
        found[place] = near
    return found


def _renumbered(source: ImageSequence, numbers: Sequence[int]) -> ImageSequence:
    """The same images with other numbers, and the times that they had."""
    clock = source.clock
    assert clock is not None, "stamps tell the time"
    times = {new: clock(old) for new, old in zip(numbers, source.numbers, strict=True)}
    order = sorted(range(len(numbers)), key=numbers.__getitem__)
    return replace(
        source,
        paths=tuple(source.paths[i] for i in order),
        numbers=tuple(numbers[i] for i in order),
        clock=times.__getitem__,
    )
