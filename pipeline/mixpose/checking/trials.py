"""What a session would have to say for its frames to be explained: inverted, swapped, other sizes.

Each change is tried by itself on a few frames that are not explained as they are.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, pairwise
from typing import Any, TypeAlias

import numpy as np

from mixpose.body import Body, PointFeature
from mixpose.fit import free_mask
from mixpose.objective import View
from mixpose.records import Floats, PointPattern
from mixpose.rigid import inverse
from mixpose.runner import begin
from mixpose.sensors import FisheyeCamera, PinholeCamera
from mixpose.session import SensorSetup, Session

Views: TypeAlias = Sequence[View]

PATIENCE_S = 20.0  # of processor time, for all trials together
_TRIED = 2  # frames that a change must explain
_OTHER_SIZE = (1e-3, 20.0)  # least change of the body's size that is tried, and largest factor


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
        Frames, by number, that are not explained as they are; three in a row tell of a sensor that
        is one late.
    """
    began = time.process_time()
    late = _late(session, frames)
    if late is not None:
        return late
    frames = frames[:_TRIED]
    for trial in _trials(session, frames):
        if time.process_time() - began > PATIENCE_S:
            return None
        body = session.body if trial.points is None else _of(session.body, trial.points)
        changed = replace(_anywhere(session), body=body)
        if frames and all(_explains(changed, n, trial.views(views)) for n, views in frames):
            return trial.meaning
    return None


def _anywhere(session: Session) -> Session:
    """The session without a start, where none is needed: it may be what is wrong."""
    return replace(session, start=None) if free_mask(session.estimator).all() else session


def _late(session: Session, frames: Sequence[tuple[int, Views]]) -> str | None:
    """The sensor whose frames belong to those before, in words."""
    numbers = [number for number, _ in frames[: _TRIED + 1]]
    in_a_row = len(numbers) > _TRIED and len({*np.diff(numbers).tolist()}) == 1
    if not in_a_row:
        return None
    anywhere = _anywhere(session)
    for setup in session.sensors:
        given = [
            _with_next(now, after, setup.name)
            for (_, now), (_, after) in pairwise(frames[: _TRIED + 1])
        ]
        if all(_explains(anywhere, n, views) for n, views in zip(numbers, given)):
            return (
                f"{setup.name!r} is a frame late: with each of its frames given to the one before"
            )
    return None


def _with_next(views: Views, after: Views, name: str) -> Views:
    """The views of a frame, that of one sensor from the frame after."""
    return [view for view in views if view.name != name] + [v for v in after if v.name == name]


def _explains(session: Session, number: int, views: Views) -> bool:
    tracker, track = begin(session)
    with np.errstate(all="ignore"):  # a body of another size may be anywhere
        _, estimate = tracker.advance(track, number, None, views)
    shares = [one.explained or 0.0 for one in estimate.sensors.values() if one.used]
    return estimate.status == "ok" and min(shares, default=0.0) > 0.1


def _trials(session: Session, frames: Sequence[tuple[int, Views]]) -> Iterator[Trial]:
    cameras = [s for s in session.sensors if s.sensor.unit == "px" and s.sensor.dimension == 2]
    yield from _inversions(cameras)
    for a, b in combinations([setup.name for setup in cameras], 2):
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
    size = _size(session, frames)
    if size is not None:
        yield Trial(
            "the body of [object] is not of the size that was seen, or translations are in another "
            f"unit than points: with points {size:.3g} times as large",
            points=lambda means: size * means,
        )


def _inversions(cameras: Sequence[SensorSetup]) -> Iterator[Trial]:
    """Cameras of which the session has their own poses in the world: all of them, or one."""
    placed = [s.name for s in cameras if not np.allclose(s.sensor.T_sensor_world, np.eye(4))]  # type: ignore[attr-defined]
    groups = [placed] if placed else []
    groups += [[name] for name in placed] if len(placed) > 1 else []
    for names in groups:
        called = " and ".join(repr(name) for name in names)
        text = (
            f"T_sensor_world of {called} {'is' if len(names) == 1 else 'are'} inverted (it maps "
            "world to sensor coordinates): with the inverse"
        )
        yield Trial(text, lambda views, names=names: _turned_round(views, names))  # type: ignore[misc]


def _turned_round(views: Views, names: Sequence[str]) -> Views:
    return [_inverted(view) if view.name in names else view for view in views]


def _inverted(view: View) -> View:
    sensor: Any = view.sensor
    return replace(view, sensor=replace(sensor, T_sensor_world=inverse(sensor.T_sensor_world)))


def _size(session: Session, frames: Sequence[tuple[int, Views]]) -> float | None:
    """How many times as large as given the body looks to several cameras together.

    Each alone finds it as far away as its size has it; p_b = R p_a + t / size relates the places
    in two cameras that stand at (R, t) to each other.
    """
    middle = np.append(session.body.means.mean(axis=0), 1.0)
    found = []
    for number, views in frames:
        places = [(view.sensor, _alone(session, number, view)) for view in views]
        seen = [(each, T) for each, T in places if T is not None]
        for (a, T_a), (b, T_b) in combinations(seen, 2):
            T_ba = b.T_sensor_world @ inverse(a.T_sensor_world)  # type: ignore[attr-defined]
            p_a = (a.T_sensor_world @ T_a @ middle)[:3]  # type: ignore[attr-defined]
            p_b = (b.T_sensor_world @ T_b @ middle)[:3]  # type: ignore[attr-defined]
            apart = p_b - T_ba[:3, :3] @ p_a
            found.append(float(apart @ T_ba[:3, 3] / max(float(apart @ apart), 1e-300)))
    if not found:
        return None
    size, (least, most) = float(np.median(found)), _OTHER_SIZE
    return size if abs(size - 1) > least and 1 / most < size < most else None


def _alone(session: Session, number: int, view: View) -> Floats | None:
    """T_world_object (4, 4) that one camera finds by itself."""
    if not isinstance(view.sensor, PinholeCamera | FisheyeCamera):
        return None
    tracker, track = begin(_anywhere(session))
    with np.errstate(all="ignore"):
        _, estimate = tracker.advance(track, number, None, [view])
    return estimate.T_world_object


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
