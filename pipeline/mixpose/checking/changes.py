"""What a session may have said wrong as a whole: inverted, swapped, mirrored, in another unit.

A change is of the body, of sensors, or of what they see; those with values to be found are in
`values`, but for what cameras tell that each find the body alone: they need no start for that.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations
from typing import Any

import numpy as np

from mixpose.body import Body, of_points, of_size
from mixpose.checking.evidence import Frames, Views, anywhere, best_pose, can_tell
from mixpose.checking.placement import Camera
from mixpose.checking.rules import DiagnosisRules
from mixpose.objective import View
from mixpose.records import Floats, PointPattern
from mixpose.rigid import inverse, rotation_angle_deg
from mixpose.search import is_pointlike
from mixpose.sensors import CloudSensor, RangeSensor
from mixpose.session import SensorSetup, Session
from mixpose.tracking import plane_names

# of mm, cm and m
_UNITS = (
    (1000.0, "1000 times as large"),
    (0.001, "a thousandth as large"),
    (10.0, "10 times as large"),
    (0.1, "a tenth as large"),
    (100.0, "100 times as large"),
    (0.01, "a hundredth as large"),
)
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
    leads: bool = True  # whether others are tried along with it

    def and_also(self, other: Change) -> Change:
        """Both together."""
        return Change(
            f"{self.what}, and {other.what}",
            f"{self.remedy}, and {other.remedy}",
            views=lambda views: other.views(self.views(views)),
            body=lambda body: other.body(self.body(body)),
            cost=self.cost + other.cost,
            values=self.values + other.values,
        )

    def of(self, session: Session, views: Views) -> Session:
        """A session of one body as it should have been, but for what is in its recordings."""
        sensors = {view.name: view.sensor for view in self.views(views)}
        setups = [replace(s, sensor=sensors.get(s.name, s.sensor)) for s in session.sensors]
        return replace(session, body=self.body(session.body), sensors=tuple(setups))


def changes(session: Session) -> Iterator[Change]:
    """Changes without values, those that are simple first."""
    cameras = [setup for setup in session.sensors if isinstance(setup.sensor, Camera)]
    clouds = [setup.name for setup in session.sensors if isinstance(setup.sensor, CloudSensor)]
    ranges = [setup.name for setup in session.sensors if isinstance(setup.sensor, RangeSensor)]
    planes = [plane for name in clouds for plane in plane_names(name)]
    yield from _in_another_unit("points", clouds, planes)
    yield from _in_another_unit("ranges", ranges, ranges)
    if is_pointlike(session.body):
        if len(clouds) < len(session.sensors):  # beside nothing else it is told of the cloud
            yield from of_units(session.body)
        yield from _of_the_body(session.body)
    sensors: dict[str, Any] = {setup.name: setup.sensor for setup in cameras}
    yield from _inversions(sensors)
    for a, b in combinations(sensors, 2):
        yield Change(
            f"{a!r} and {b!r} {{are}} swapped",
            "with the source of each given to the other",
            partial(_swapped, other={a: b, b: a}),
        )
    for a, b in combinations(sensors, 2):
        if type(sensors[a]) is type(sensors[b]):
            yield _of_sensors(
                f"calibrations of {a!r} and {b!r} {{are}} swapped",
                "with camera_matrix and distortion of each given to the other",
                (a, b),
                partial(_with_lens, lenses={a: sensors[b], b: sensors[a]}),
            )
    yield from _flips(cameras, "mirrored", "left and right", 0)
    for names in _all_or_one(list(sensors)):
        for factor, images, done in ((2.0, "half", "doubled"), (0.5, "twice", "halved")):
            yield _of_sensors(
                f"camera_matrix of {called(names)} {{is}} that of images {images} as large",
                f"with fx, fy, cx and cy {done}",
                names,
                partial(_scaled, factor=factor),
            )
    if len(cameras) > 1:  # to one camera that is mirrored, but for a half-turn
        for change in _flips(cameras, "upside down", "top and bottom", 1):
            yield replace(change, leads=False)


def _flips(cameras: Sequence[SensorSetup], what: str, ends: str, axis: int) -> Iterator[Change]:
    """Images of which an axis counts from the other end."""
    sized = {s.name: s.resolution for s in cameras if s.resolution is not None}
    along = np.arange(2) == axis

    def flipped(view: View) -> View:
        last = sized[view.name][axis] - 1.0
        return _with_points(view, lambda points: np.where(along, last - points, points))

    for names in _all_or_one(list(sized)):
        yield _of_sensors(
            f"images of {called(names)} {{are}} {what}",
            f"with {ends} of them exchanged",
            names,
            flipped,
        )


def _of_sensors(
    what: str, remedy: str, names: Sequence[str], changed: Callable[[View], View]
) -> Change:
    """A change of the views of some sensors."""
    return Change(what, remedy, lambda views: [changed(v) if v.name in names else v for v in views])


def _by(view: View, **changed: Floats) -> View:
    """A view as if by a camera that differs in what is changed."""
    camera: Any = view.sensor
    return replace(view, sensor=replace(camera, **changed))


def _scaled(view: View, factor: float) -> View:
    """A view as if by a camera of images that are so many times as large."""
    camera: Any = view.sensor
    return _by(view, camera_matrix=camera.camera_matrix * np.array([[factor], [factor], [1.0]]))


def _with_lens(view: View, lenses: Mapping[str, Any]) -> View:
    """A view as if by a camera that is where it is, with another lens."""
    lens = lenses[view.name]
    return _by(view, camera_matrix=lens.camera_matrix, distortion=lens.distortion)


def _in_another_unit(what: str, names: Sequence[str], views: Sequence[str]) -> Iterator[Change]:
    """What sensors measure, in some views, in a unit of length that is not that of the session."""
    for factor, where in _UNITS if names else ():
        yield _of_sensors(
            f"the {what} of {called(names)} {{are}} in another unit than the session",
            f"with them {where}",
            views,
            partial(_with_points, changed=partial(np.multiply, factor)),
        )


def _of_the_body(body: Body) -> Iterator[Change]:
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
    """Points in another unit than all else: metres for millimetres, say."""
    for factor, where in _UNITS:
        yield Change(
            "points and translations {are} in two units of length",
            f"with points {where}",
            body=partial(of_size, factor=factor),
        )


def _all_or_one(names: Sequence[str]) -> list[list[str]]:
    """All of some sensors, or one of them."""
    return ([list(names)] if names else []) + ([[n] for n in names] if len(names) > 1 else [])


OTHER_SIZE = (
    "the body of [object] {is} not of the size that was seen, or translations are in another unit "
    "than points"
)


def times_as_large(factor: float) -> str:
    """A factor in words, to two digits of what it differs from 1 by."""
    places = 1 - math.floor(math.log10(max(abs(factor - 1), 1e-9)))
    return f"{round(factor, max(places, 2)):.9g} times as large"


def misplaced(setup: SensorSetup) -> str:
    """A sensor that stands elsewhere, as in `Change.what`."""
    sensor: Any = setup.sensor
    at_origin = np.array_equal(sensor.T_sensor_world, np.eye(4))
    return f"T_sensor_world of {setup.name!r} {{is}} off{' or left out' if at_origin else ''}"


def moved_by(before: Floats, after: Floats, unit: str) -> str:
    """How another T_sensor_world (4, 4) differs, in words."""
    away, turn = np.linalg.norm((after - before)[:3, 3]), rotation_angle_deg(before, after)
    length, angle = (f"{float(f'{float(each):.2g}'):g}" for each in (away, turn))
    return f"with it moved by {length} {unit} and turned by {angle} deg"


def called(names: Sequence[str]) -> str:
    """Sensors in words."""
    return " and ".join(repr(name) for name in names)


def _inversions(sensors: Mapping[str, Any]) -> Iterator[Change]:
    """Cameras of which the session has their own poses in the world: all of them, or one."""
    stand = {name: each.T_sensor_world for name, each in sensors.items()}
    far = [name for name, T in stand.items() if not np.allclose(T, np.eye(4), atol=1e-5)]
    for names in _all_or_one(far):
        yield _of_sensors(
            f"T_sensor_world of {called(names)} {'{is}' if len(names) == 1 else '{are}'} inverted "
            "(it maps world to sensor coordinates)",
            "with the inverse",
            names,
            lambda view: _by(view, T_sensor_world=inverse(view.sensor.T_sensor_world)),  # type: ignore[attr-defined]
        )


def _swapped(views: Views, other: Mapping[str, str]) -> Views:
    seen = {other.get(view.name, view.name): view.observation for view in views}
    return [replace(view, observation=seen[view.name]) for view in views if view.name in seen]


def _with_points(view: View, changed: Callable[[Floats], Floats]) -> View:
    """A view of detections that are elsewhere."""
    pattern = view.observation.pattern
    if not isinstance(pattern, PointPattern):
        return view
    moved = replace(pattern, points=np.asarray(changed(pattern.points)))
    return replace(view, observation=type(view.observation)(moved, view.observation.sigma))


def by_cameras_alone(session: Session, frames: Frames) -> Iterator[Change]:
    """Another size of the body, and other places of cameras, by where each of them alone has it."""
    found = list[dict[str, tuple[Any, Floats]]]()  # of each frame: cameras, T_world_object
    for number, views in frames:
        poses = [(view, _alone(session, number, view)) for view in views]
        found.append({view.name: (view.sensor, T) for view, T in poses if T is not None})
    if is_pointlike(session.body):
        yield from _other_sizes(session, found)
    for setup in session.sensors:
        name, seen = setup.name, [each for each in found if setup.name in each and len(each) > 1]
        for each in seen[:1]:
            sensor, T_own = each[name]
            T_other = next(T for other, (_, T) in each.items() if other != name)
            T = sensor.T_sensor_world @ T_own @ inverse(T_other)
            moved = _of_sensors(
                misplaced(setup),
                moved_by(sensor.T_sensor_world, T, session.unit),
                [name],
                partial(_by, T_sensor_world=T),
            )
            yield replace(moved, cost=3 * math.log(2 * len(session.body) * len(found)), values=6)


def _other_sizes(session: Session, found: Sequence[dict[str, Any]]) -> Iterator[Change]:
    """A body of the size that cameras see."""
    # each alone finds it as far away as its size has it; p_b = R p_a + t / size relates the places
    # in two cameras that stand at (R, t) to each other
    middle, sizes = np.append(session.body.means.mean(axis=0), 1.0), list[float]()
    for each in found:
        for (a, T_a), (b, T_b) in combinations(each.values(), 2):
            T_ba = b.T_sensor_world @ inverse(a.T_sensor_world)
            p_a = (a.T_sensor_world @ T_a @ middle)[:3]
            p_b = (b.T_sensor_world @ T_b @ middle)[:3]
            apart = p_b - T_ba[:3, :3] @ p_a
            sizes.append(float(apart @ T_ba[:3, 3] / max(float(apart @ apart), 1e-300)))
    size, (least, most) = float(np.median(sizes or [1.0])), _OTHER_SIZE
    if abs(size - 1) > least and 1 / most < size < most:
        yield Change(
            OTHER_SIZE,
            f"with points {times_as_large(size)}",
            body=lambda body: of_size(body, size),
            values=1,
        )


def _alone(session: Session, number: int, view: View) -> Floats | None:
    """T_world_object (4, 4) that one camera finds by itself."""
    if not (isinstance(view.sensor, Camera) and can_tell([view], len(session.body))):
        return None
    pose, _ = best_pose(anywhere(session), session.body, number, [view], DiagnosisRules().guesses)
    return None if pose is None else pose.T_world_object
