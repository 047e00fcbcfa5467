"""What a session would have to say for its frames to be explained: swapped, mirrored, other units.

Each change is tried by itself on a few frames that are not explained as they are.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any, TypeAlias

import numpy as np

from mixpose.body import Body, PointFeature
from mixpose.objective import View
from mixpose.records import PointPattern
from mixpose.rigid import Floats
from mixpose.runner import begin
from mixpose.session import Session

Views: TypeAlias = Sequence[View]

PATIENCE_S = 20.0  # of processor time, for all trials together


@dataclass(frozen=True)
class Trial:
    """A change and what it would mean."""

    meaning: str
    views: Callable[[Views], Views] = lambda views: views
    points: Callable[[Floats], Floats] | None = None


def explanation(session: Session, frames: Sequence[tuple[int, Views]]) -> str | None:
    """The change that explains frames, in words; None where none of those tried does.

    Parameters
    ----------
    session : Session
        Of one body.
    frames : sequence of (int, sequence of View)
        Frames, by number, that are not explained as they are.
    """
    began = time.process_time()
    for trial in _trials(session):
        if time.process_time() - began > PATIENCE_S:
            return None
        body = session.body if trial.points is None else _of(session.body, trial.points)
        changed = replace(session, body=body, start=None)
        if frames and all(_explains(changed, n, trial.views(views)) for n, views in frames):
            return trial.meaning
    return None


def _explains(session: Session, number: int, views: Views) -> bool:
    tracker, track = begin(session)
    with np.errstate(all="ignore"):  # a body of another size may be anywhere
        _, estimate = tracker.advance(track, number, None, views)
    shares = [one.explained or 0.0 for one in estimate.sensors.values() if one.used]
    return estimate.status == "ok" and min(shares, default=0.0) > 0.1


def _trials(session: Session) -> Iterator[Trial]:
    cameras = [s for s in session.sensors if s.sensor.unit == "px" and s.sensor.dimension == 2]
    names = [setup.name for setup in cameras]
    for a, b in combinations(names, 2):
        text = f"{a!r} and {b!r} are swapped: with the source of each given to the other"
        yield Trial(text, lambda views, a=a, b=b: _swapped(views, a, b))  # type: ignore[misc]
    if not all(isinstance(feature, PointFeature) for feature in session.body.features):
        return
    middle = session.body.means.mean(axis=0)
    yield Trial(
        "the body of [object] is mirrored: with one coordinate of all points negated",
        points=lambda means: middle + (means - middle) * [1, 1, -1],
    )
    for factor, where in ((1000.0, "1000 times as large"), (0.001, "a thousandth as large")):
        text = f"points and translations are in two units of length: with points {where}"
        yield Trial(text, points=lambda means, factor=factor: factor * means)  # type: ignore[misc]
    for setup in cameras:
        if setup.resolution is not None:
            text = f"images of {setup.name!r} are mirrored: with left and right of them exchanged"
            width, name = setup.resolution[0], setup.name
            yield Trial(text, lambda views, n=name, w=width: _mirrored(views, n, w))  # type: ignore[misc]


def _of(body: Body, points: Callable[[Floats], Floats]) -> Body:
    normals: Any = None  # what is seen from where is not what is asked
    return Body(body.name, tuple(PointFeature(point) for point in points(body.means)), normals)


def _swapped(views: Views, a: str, b: str) -> Views:
    seen = {view.name: view.observation for view in views}
    other = {a: b, b: a}
    return [
        replace(view, observation=seen[other.get(view.name, view.name)])
        for view in views
        if other.get(view.name, view.name) in seen
    ]


def _mirrored(views: Views, name: str, width: int) -> Views:
    return [_flipped(view, width) if view.name == name else view for view in views]


def _flipped(view: View, width: int) -> View:
    pattern = view.observation.pattern
    if not isinstance(pattern, PointPattern):
        return view
    points = pattern.points * [-1.0, 1.0] + [width - 1.0, 0.0]
    flipped = PointPattern(np.asarray(points), pattern.weights)
    return replace(view, observation=type(view.observation)(flipped, view.observation.sigma))
