"""What a session may have said wrong as a whole: inverted, swapped, mirrored, in another unit.

A change is of the body, of sensors, or of what they see; those with values to be found are in
`values`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any

import numpy as np

from mixpose.body import Body, PointFeature
from mixpose.checking.evidence import Frames, Views, anywhere, best_pose
from mixpose.objective import View
from mixpose.records import Floats, PointPattern
from mixpose.rigid import inverse
from mixpose.sensors import FisheyeCamera, PinholeCamera
from mixpose.session import SensorSetup, Session

_OTHER_SIZE = (1e-3, 20.0)  # least change of the body's size that is tried, and largest factor


@dataclass(frozen=True)
class Change:
    """A change of a session, and what it would mean."""

    what: str  # is wrong, with a verb that "may be" can replace in ``{is}`` or ``{are}``
    remedy: str  # what explains the frames: "with ..."
    # what is seen, and by which sensors, by what is given
    views: Callable[[Views], Views] = lambda views: views
    body: Callable[[Body], Body] = lambda body: body  # by the one given
    cost: float = 0.0  # nats that the choice of its values costs
    values: int = 0  # how many are chosen
    feature: int | None = None  # the only one that is changed


def of_points(body: Body, points: Floats, normals: Floats | None = None) -> Body:
    """A body of other points; one whose features have an extent is of points, too."""
    features = tuple(PointFeature(point) for point in points)
    return replace(body, features=features, normals=normals)


def of_size(body: Body, factor: float) -> Body:
    """A body whose points, and what is about them, are so many times as large."""
    larger = of_points(body, factor * body.means, body.normals)
    return larger if body.radii is None else replace(larger, radii=factor * body.radii)


def changes(session: Session) -> Iterator[Change]:
    """Changes without values, those that are simple first."""
    cameras = [s for s in session.sensors if isinstance(s.sensor, PinholeCamera | FisheyeCamera)]
    are_points = all(isinstance(feature, PointFeature) for feature in session.body.features)
    if are_points:
        yield from _of_the_body(session.body)
    yield from _inversions(cameras)
    for a, b in combinations([setup.name for setup in cameras], 2):
        yield Change(
            f"{a!r} and {b!r} {{are}} swapped",
            "with the source of each given to the other",
            lambda views, a=a, b=b: _swapped(views, a, b),  # type: ignore[misc]
        )
    sensors: dict[str, Any] = {setup.name: setup.sensor for setup in cameras}
    for a, b in combinations(sensors, 2):
        if type(sensors[a]) is type(sensors[b]):
            lenses = {a: _with_lens(sensors[a], sensors[b]), b: _with_lens(sensors[b], sensors[a])}
            yield _of_sensors(
                f"calibrations of {a!r} and {b!r} {{are}} swapped",
                "with camera_matrix and distortion of each given to the other",
                (a, b),
                lambda view, lenses=lenses: with_sensor(view, lenses[view.name]),  # type: ignore[misc]
            )
    sized = {s.name: s.resolution[0] for s in cameras if s.resolution is not None}
    for names in _all_or_one(list(sized)):
        yield _of_sensors(
            f"images of {called(names)} {{are}} mirrored",
            "with left and right of them exchanged",
            names,
            lambda view: _flipped(view, sized[view.name]),
        )
    for names in _all_or_one([setup.name for setup in cameras]):
        for factor, images, done in ((2.0, "half", "doubled"), (0.5, "twice", "halved")):
            yield _of_sensors(
                f"camera_matrix of {called(names)} {{is}} that of images {images} as large",
                f"with fx, fy, cx and cy {done}",
                names,
                lambda view, k=factor: with_sensor(view, scaled(view.sensor, k)),  # type: ignore[misc]
            )


def _of_sensors(
    what: str, remedy: str, names: Sequence[str], changed: Callable[[View], View]
) -> Change:
    """A change of the views of some sensors."""
    return Change(what, remedy, lambda views: [changed(v) if v.name in names else v for v in views])


def scaled(sensor: Any, factor: float) -> Any:
    """A camera of images that are so many times as large."""
    K = np.array(sensor.camera_matrix) * np.array([[factor], [factor], [1.0]])
    return replace(sensor, camera_matrix=K)


def with_sensor(view: View, sensor: Any) -> View:
    """A view as if by another sensor."""
    return view if sensor is view.sensor else replace(view, sensor=sensor)


def _of_the_body(body: Body) -> Iterator[Change]:
    yield from of_units(body)  # before what takes long to search with a tiny body
    middle, normals = body.means.mean(axis=0), body.normals
    other_side = np.array([1.0, 1.0, -1.0])
    turned = None if normals is None else normals * other_side
    yield Change(
        "the body of [object] {is} mirrored",
        "with one coordinate of all points negated",
        body=lambda body: of_points(body, middle + (body.means - middle) * other_side, turned),
    )
    if normals is not None:
        yield Change(
            "normals of [object] {are} of the wrong sign",
            "with all of them negated",
            body=lambda body: of_points(body, body.means, -normals),
        )


def of_units(body: Body) -> Iterator[Change]:
    """Points in metres for millimetres, and the reverse."""
    for factor, where in ((1000.0, "1000 times as large"), (0.001, "a thousandth as large")):
        yield Change(
            "points and translations {are} in two units of length",
            f"with points {where}",
            body=lambda body, k=factor: of_size(body, k),  # type: ignore[misc]
        )


def _all_or_one(names: Sequence[str]) -> list[list[str]]:
    """All of some sensors, or one of them."""
    return ([list(names)] if names else []) + ([[n] for n in names] if len(names) > 1 else [])


OTHER_SIZE = (
    "the body of [object] {is} not of the size that was seen, or translations are in another unit "
    "than points"
)


def called(names: Sequence[str]) -> str:
    """Sensors in words."""
    return " and ".join(repr(name) for name in names)


def _inversions(cameras: Sequence[SensorSetup]) -> Iterator[Change]:
    """Cameras of which the session has their own poses in the world: all of them, or one."""
    sensors: dict[str, Any] = {setup.name: setup.sensor for setup in cameras}
    far = [
        n
        for n, each in sensors.items()
        if not np.allclose(each.T_sensor_world, np.eye(4), atol=1e-5)
    ]
    for names in _all_or_one(far):
        yield _of_sensors(
            f"T_sensor_world of {called(names)} {'{is}' if len(names) == 1 else '{are}'} inverted "
            "(it maps world to sensor coordinates)",
            "with the inverse",
            names,
            _inverted,
        )


def _with_lens(sensor: Any, other: Any) -> Any:
    """A camera where it is, with the lens of another."""
    return replace(sensor, camera_matrix=other.camera_matrix, distortion=other.distortion)


def _inverted(view: View) -> View:
    sensor: Any = view.sensor
    return replace(view, sensor=replace(sensor, T_sensor_world=inverse(sensor.T_sensor_world)))


def _swapped(views: Views, a: str, b: str) -> Views:
    seen = {view.name: view.observation for view in views}
    other = {a: b, b: a}
    return [
        replace(view, observation=seen[other.get(view.name, view.name)])
        for view in views
        if other.get(view.name, view.name) in seen
    ]


def _flipped(view: View, width: int) -> View:
    pattern = view.observation.pattern
    if not isinstance(pattern, PointPattern):
        return view
    points = pattern.points * [-1.0, 1.0] + [width - 1.0, 0.0]
    flipped = replace(pattern, points=np.asarray(points))
    return replace(view, observation=type(view.observation)(flipped, view.observation.sigma))


def other_sizes(session: Session, frames: Frames) -> Iterator[Change]:
    """A body of the size that cameras see where each alone finds it.

    Each alone finds it as far away as its size has it; p_b = R p_a + t / size relates the places
    in two cameras that stand at (R, t) to each other.
    """
    body = session.body
    if not all(isinstance(feature, PointFeature) for feature in body.features):
        return
    middle = np.append(body.means.mean(axis=0), 1.0)
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
    size, (least, most) = float(np.median(found or [1.0])), _OTHER_SIZE
    if abs(size - 1) > least and 1 / most < size < most:
        yield Change(
            OTHER_SIZE,
            f"with points {size:.3g} times as large",
            body=lambda body: of_size(body, size),
            values=1,
        )


def _alone(session: Session, number: int, view: View) -> Floats | None:
    """T_world_object (4, 4) that one camera finds by itself."""
    if not isinstance(view.sensor, PinholeCamera | FisheyeCamera):
        return None
    pose = best_pose(anywhere(session), session.body, number, [view])
    return None if pose is None else pose.T_world_object
