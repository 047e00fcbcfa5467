"""A sensor whose frames belong to those before."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from mixpose.checking.evidence import Frames, Views, anywhere
from mixpose.runner import begin
from mixpose.session import Session

_FRAMES = 3  # in a row


def late_sensor(session: Session, frames: Frames) -> str | None:
    """The sensor that is a frame late, in words; None of frames that are not in a row."""
    frames = frames[:_FRAMES]
    numbers = [number for number, _ in frames]
    if len(numbers) < _FRAMES or len({*np.diff(numbers).tolist()}) != 1:
        return None
    for setup in session.sensors:
        given = [_with_next(now, after, setup.name) for (_, now), (_, after) in pairwise(frames)]
        if all(_explains(anywhere(session), n, views) for n, views in zip(numbers, given)):
            return (
                f"{setup.name!r} is a frame late: with each of its frames given to the one before"
            )
    return None


def _with_next(views: Views, after: Views, name: str) -> Views:
    """The views of a frame, that of one sensor from the frame after."""
    return [view for view in views if view.name != name] + [v for v in after if v.name == name]


def _explains(session: Session, number: int, views: Views) -> bool:
    tracker, track = begin(session)
    with np.errstate(all="ignore"):
        _, estimate = tracker.advance(track, number, None, views)
    shares = [one.explained or 0.0 for one in estimate.sensors.values() if one.used]
    return estimate.status == "ok" and min(shares, default=0.0) > 0.1
