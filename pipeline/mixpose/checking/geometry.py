"""Whether the geometry of a session explains a few frames of its recording."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import closing

import numpy as np

from mixpose.checking.advice import judge
from mixpose.checking.placement import expected_count
from mixpose.checking.recordings import Survey
from mixpose.checking.trials import explanation
from mixpose.errors import RecordingError
from mixpose.frames import Source
from mixpose.frames.video import Video
from mixpose.records import FrameSet
from mixpose.runner import begin, observe
from mixpose.session import Session

CAUSES = (
    "is one of them out of step, or its calibration, T_sensor_world or source that of another? Or "
    "are points of [object] and translations in another unit, or of another size?"
)
"""Why sensors may contradict each other."""

_TRIED = 2  # frames
_FIRST = 40  # frames among which they are: to get far into a video takes as long as to read it


def geometry_warnings(
    session: Session, sources: Mapping[str, Source], surveys: Mapping[str, Survey]
) -> list[str]:
    """What sensors that contradict each other are most likely told wrong.

    Nothing is said of several bodies, of one sensor, and of streams, which are read once.

    Parameters
    ----------
    session : Session
    sources : mapping of str to Source
        By sensor name.
    surveys : mapping of str to Survey
        What their frames hold.
    """
    streams = any(
        each.kind == "live" or (isinstance(each, Video) and each.size is None)
        for each in sources.values()
    )
    if len(sources) < 2 or len(session.labels) > 1 or streams:
        return []
    frames, doubt = [], None
    for frame_set in _shared(sources, surveys):
        views = observe(session, frame_set)
        tracker, track = begin(session)
        _, estimate = tracker.advance(track, frame_set.number, frame_set.time_s, views)
        if estimate.status == "ok":
            return []
        doubt = estimate.doubt or doubt
        frames.append((frame_set.number, views))
    if not frames or (doubt is None and not _is_seen(session, surveys)):
        return []
    numbers = " and ".join(str(number) for number, _ in frames)
    where = f"frame{'s' * (len(frames) > 1)} {numbers}"
    change = explanation(session, frames)
    if change is not None:
        return [f"{change}, {where} would be ok"]
    return [] if doubt is None else [f"{where}: {doubt}: {CAUSES}"]


def _is_seen(session: Session, surveys: Mapping[str, Survey]) -> bool:
    """Whether each sensor finds about as many features as the body shows."""
    for setup in session.sensors:
        counts = surveys[setup.name].counts
        if not counts or judge(float(np.median(counts)), expected_count(setup, session)):
            return False
    return True


def _shared(sources: Mapping[str, Source], surveys: Mapping[str, Survey]) -> Iterator[FrameSet]:
    """A few frames in which every sensor sees something."""
    seen = [{*each.numbers} - {*each.empty} for each in surveys.values()]
    numbers = sorted(set.intersection(*seen))[:_FIRST]
    for number in numbers[:: max(len(numbers) // _TRIED, 1)][:_TRIED]:
        frames = {}
        for name, source in sources.items():
            try:
                with closing(source.frames(number, number + 1)) as found:
                    frames[name] = next(found)
            except (RecordingError, StopIteration):  # said of the recording
                return
        times = [each.time_s for each in frames.values() if each.time_s is not None]
        yield FrameSet(number, min(times, default=None), frames)
