"""Read every frame of a sensor, and count features in images all over the recording."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import closing
from dataclasses import dataclass, field, replace
from itertools import islice, pairwise
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from mixpose.errors import RecordingError
from mixpose.frames import Source, numbers_of, prefetch, spread_over
from mixpose.frames.images import ImageSequence
from mixpose.frames.source import Frames, is_same, shown_by
from mixpose.frames.tables import DetectionTable
from mixpose.frames.times import listed
from mixpose.frames.video import Video
from mixpose.records import Floats, Image, Pattern, PointPattern, RawFrame
from mixpose.runner import observation_of
from mixpose.session import SensorSetup, Session

_TELLING = 6  # numbers in a frame: fewer may equal those of the frame before by chance
_QUICK = 5  # frames of a quick survey
# images of a sensor in which features are counted: finding them takes five times as long as reading
# an image, and the median of so many is as good as that of all
_COUNTED = 20

Damage: TypeAlias = list[tuple[int | None, str]]
"""Numbers of frames that cannot be read, if known, and why."""


@dataclass(frozen=True)
class Survey:
    """Counts and oddities of the frames of one sensor."""

    numbers: tuple[int, ...]  # frames that could be read, ascending
    counted: tuple[int, ...]  # frames in which features were extracted
    # number of features in each of these; None for grey values and profiles, which have none
    counts: tuple[int, ...] | None
    empty: tuple[int, ...]  # counted frames without any feature, or with one value all over
    size: tuple[int, int] | None = None  # width and height of the images in px
    damage: tuple[str, ...] = ()  # why a frame could not be read, a line each
    damaged: tuple[int, ...] = ()  # numbers of these frames, if known
    is_whole: bool = True  # whether all frames were read
    times: Mapping[int, float] = field(default_factory=dict)  # of frames that have one, in s
    repeated: tuple[int, ...] = ()  # frames that are not empty and equal the one before
    doubled: tuple[int, ...] = ()  # frames of a table with a detection twice or more
    # counted frames, with detections in place of the image; without any if there were too many
    features: Mapping[int, RawFrame] = field(default_factory=dict)

    @property
    def typical_frame(self) -> int | None:
        """Return a frame with about the median number of features."""
        if self.counts is None:
            return None
        middle = np.argsort(self.counts, kind="stable")[len(self.counts) // 2]
        return self.counted[int(middle)]


def survey(
    session: Session,
    setup: SensorSetup,
    source: Source,
    *,
    quick: bool = False,
    to_count: Collection[int] | None = None,
    done: Callable[[], None] = lambda: None,
) -> Survey:
    """Read the frames of a sensor as a run would, past damaged images.

    `quick` reads a few frames only, as is always done for a stream, which has no end. Features are
    extracted from the images of frames `to_count`, None for all. `done` is called after each
    frame. Raises `SessionError` if a user's function that extracts features fails.
    """
    quick = quick or (isinstance(source, Video) and source.size is None)
    damage: Damage = []
    seen = _Seen()
    with closing(_frames(source, damage, quick=quick)) as frames:
        for frame in frames:
            number, data = frame.number, frame.data
            seen.add(frame)
            if not isinstance(data, np.ndarray) or to_count is None or number in to_count:
                observation = observation_of(session, setup, frame)
                seen.count(frame, observation.pattern, observation.found)
            done()
    counts = seen.counts
    return Survey(
        numbers=tuple(seen.numbers),
        counted=tuple(seen.counted),
        counts=tuple(counts) if counts and len(counts) == len(seen.counted) else None,
        empty=tuple(seen.empty),
        size=seen.size,
        damage=tuple(text for _, text in damage),
        damaged=tuple(number for number, _ in damage if number is not None),
        is_whole=not quick,
        times=seen.times,
        repeated=tuple(seen.repeated),
        doubled=tuple(seen.doubled),
        features=seen.features,
    )


@dataclass
class _Seen:
    """What the frames of a sensor showed so far, for a `Survey`."""

    numbers: list[int] = field(default_factory=list)
    times: dict[int, float] = field(default_factory=dict)
    size: tuple[int, int] | None = None
    counted: list[int] = field(default_factory=list)
    counts: list[int] = field(default_factory=list)
    features: dict[int, RawFrame] = field(default_factory=dict)
    empty: list[int] = field(default_factory=list)
    doubled: list[int] = field(default_factory=list)
    repeated: list[int] = field(default_factory=list)
    shown: NDArray[Any] | None = None  # by the last frame, if that tells

    def add(self, frame: RawFrame) -> None:
        """Add a frame."""
        number, data = frame.number, frame.data
        self.numbers.append(number)
        if frame.time_s is not None:
            self.times[number] = frame.time_s
        shown = shown_by(frame)
        if shown is not None and shown.size < _TELLING:
            shown = None
        if shown is not None and shown.any() and is_same(self.shown, shown):
            self.repeated.append(number)
        self.shown = shown
        if isinstance(data, np.ndarray):
            self.size = (data.shape[1], data.shape[0])
        elif isinstance(data, PointPattern) and has_duplicates(data.points):
            self.doubled.append(number)

    def count(self, frame: RawFrame, pattern: Pattern, found: int) -> None:
        """Add the features that were extracted from a frame."""
        number = frame.number
        self.counted.append(number)
        if isinstance(pattern, PointPattern):
            self.counts.append(found)
            self.features[number] = replace(frame, data=pattern)
            is_empty = not found
        else:
            is_empty = not np.ptp(pattern.values)
        if is_empty:
            self.empty.append(number)


def frames_to_count(sources: Mapping[str, Source]) -> set[int] | None:
    """Choose the frames, the same for all sensors, in which to count features; None for all."""
    known = [chosen for source in sources.values() if (chosen := numbers_of(source))]
    if not known:
        return None
    numbers = sorted(set.intersection(*known) or set.union(*known))
    return set(spread_over(numbers, _COUNTED))


def has_duplicates(points: Floats) -> bool:
    """Test whether any two of points (n, m) are the same, to the last digit."""
    return len(np.unique(points, axis=0)) < len(points)


def order_warnings(surveys: Mapping[str, Survey]) -> list[str]:
    """Warn of tables with repeated detections, and of recordings whose times go back."""
    warnings = []
    for name, survey in surveys.items():
        if 2 * len(survey.doubled) > len(survey.numbers):  # ranges in whole cm may coincide
            warnings.append(
                f"sensor {name!r}: the same detection stands twice or more in "
                f"{len(survey.doubled)} of {len(survey.numbers)} frames, as {survey.doubled[0]}: "
                "are rows of its table repeated? Each counts as a feature of its own"
            )
        ordered = sorted(survey.times.items())
        back = [(k, b, a) for (_, a), (k, b) in pairwise(ordered) if b < a]
        if back:
            number, later, earlier = back[0]
            warnings.append(
                f"sensor {name!r}: frame {number} is at {later:g} s and the frame before it at "
                f"{earlier:g} s; a run ends there, as times that go back tell no velocity"
            )
    return warnings


def numbering_warnings(sources: Mapping[str, Source]) -> list[str]:
    """Warn of tables with times only, if other recordings are paired by frame number."""
    stamped = [
        name for name, src in sources.items() if isinstance(src, DetectionTable) and src.stamps
    ]
    others = [
        name
        for name, src in sources.items()
        if name not in stamped and not (isinstance(src, ImageSequence) and src.is_stamped)
    ]
    if not others:
        return []
    return [
        f"sensor {name!r}: its table has times and no frame numbers, so that its frames count from "
        f"0 and are taken with those of {others[0]!r} of the same number; add a column frame"
        for name in stamped
    ]


def time_warnings(surveys: Mapping[str, Survey]) -> list[str]:
    """Warn of sensors whose frames are paired with frames of other moments, by their times."""
    timed = [(name, survey.times) for name, survey in surveys.items() if len(survey.times) > 1]
    if len(timed) < 2:
        return []
    (first, known), *others = timed  # the time of a frame is that of the first sensor
    numbers = np.array(list(known))
    usual = float(np.median(np.diff(list(known.values())) / np.diff(numbers)))
    warnings = []
    for name, times in others:
        gaps = np.array([abs(times[k] - known[k]) for k in times.keys() & known.keys()])
        if len(gaps) and (off := float(np.median(gaps))) > usual:
            warnings.append(
                f"sensor {name!r}: its frames are {off:.3g} s from those of {first!r} with the "
                f"same number, and {first!r} has one every {usual:.3g} s: is fps or times of one "
                "of them wrong, or are its frames numbered from another moment?"
            )
    return warnings


def frozen_warnings(surveys: Mapping[str, Survey]) -> list[str]:
    """Warn of sensors that repeat the frame before while others do not."""
    warnings = []
    for name, survey in surveys.items():
        others = [other for key, other in surveys.items() if key != name]
        changed = {n for other in others for n in {*other.numbers} - {*other.repeated}}
        if frozen := [n for n in survey.repeated if survey.is_whole and n in changed]:
            warnings.append(
                f"sensor {name!r} shows the same as the frame before in frames {listed(frozen)}, "
                "while others do not: frozen, or frames doubled?"
            )
    return warnings


def image_of(source: Source, number: int) -> Image | None:
    """Read one image of a recording; return None if it holds something else."""
    with closing(source.frames(number, number + 1)) as frames:
        frame = next(frames, None)
    return frame.data if frame is not None and isinstance(frame.data, np.ndarray) else None


def _frames(source: Source, damage: Damage, *, quick: bool) -> Frames:
    """Yield the frames that can be read; append the errors of others to `damage`."""
    if isinstance(source, ImageSequence):
        frames = _images(source, damage, quick=quick)
    else:
        frames = _whole(source, damage)
        frames = islice(frames, _QUICK) if quick else frames
    yield from prefetch(frames, source.ahead) if source.ahead and not quick else frames


def _whole(source: Source, damage: Damage) -> Iterator[RawFrame]:
    try:
        yield from source.frames()
    except RecordingError as error:
        damage.append((None, str(error)))


def _images(source: ImageSequence, damage: Damage, *, quick: bool) -> Iterator[RawFrame]:
    """Yield each image by itself: after a damaged one the next can still be read."""
    numbers = source.numbers
    for number in spread_over(numbers, _QUICK) if quick else numbers:
        try:
            for frame in source.frames(number, number + 1):
                if source.resolution is None and isinstance(frame.data, np.ndarray):
                    height, width = frame.data.shape
                    source = replace(source, resolution=(width, height))
                yield frame
        except RecordingError as error:
            damage.append((number, str(error)))
