"""Changes of a session as a whole: something is inverted, swapped, mirrored, in another unit.

A change is of the body, of sensors, or of what they see.  Changes with values to fit are in
`values`, except those by cameras that find the body alone, which need no start.
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
from mixpose.checking.evidence import Frames, Views, are_sufficient, best_pose, without_start
from mixpose.checking.placement import Camera
from mixpose.checking.rules import DiagnosisRules
from mixpose.objective import View
from mixpose.records import Floats, PointPattern
from mixpose.rigid import inverse, rotation_angle_deg
from mixpose.search import is_pointlike
from mixpose.sensors import CloudSensor, RangeSensor
from mixpose.session import SensorSetup, Session
from mixpose.tracking import plane_names

# between mm, cm and m
_UNITS = (
    (1000.0, "1000 times as large"),
    (0.001, "a thousandth as large"),
    (10.0, "10 times as large"),
    (0.1, "a tenth as large"),
    (100.0, "100 times as large"),
    (0.01, "a hundredth as large"),
)
_OTHER_SIZE = (1e-3, 20.0)  # least change of the body's size and largest factor that are tried


@dataclass(frozen=True)
class Change:
    """A change of a session, in words and as functions of views and body."""

    what: str  # what is wrong; "may be" can replace its verb, written ``{is}`` or ``{are}``
    remedy: str  # what explains the frames: "with ..."
    # changed views, by those of the session
    views: Callable[[Views], Views] = lambda views: views
    body: Callable[[Body], Body] = lambda body: body  # changed body, by that of the session
    cost: float = 0.0  # nats for the choice of its values
    values: int = 0  # number of values that are chosen
    feature: int | None = None  # the only one that is changed
    leads: bool = True  # whether it is combined with other changes

    def and_also(self, other: Change) -> Change:
        """Return the change that makes both changes."""
        return Change(
            f"{self.what}, and {other.what}",
            f"{self.remedy}, and {other.remedy}",
            views=lambda views: other.views(self.views(views)),
            body=lambda body: other.body(self.body(body)),
            cost=self.cost + other.cost,
            values=self.values + other.values,
        )

    def apply(self, session: Session, views: Views) -> Session:
        """Return the session with body and sensors changed, but its recordings as they are."""
        sensors = {view.name: view.sensor for view in self.views(views)}
        setups = [replace(s, sensor=sensors.get(s.name, s.sensor)) for s in session.sensors]
        return replace(session, body=self.body(session.body), sensors=tuple(setups))


def changes(session: Session) -> Iterator[Change]:
    """Yield the changes without values, the simplest first."""
    cameras = [setup for setup in session.sensors if isinstance(setup.sensor, Camera)]
    clouds = [setup.name for setup in session.sensors if isinstance(setup.sensor, CloudSensor)]
    ranges = [setup.name for setup in session.sensors if isinstance(setup.sensor, RangeSensor)]
    planes = [plane for name in clouds for plane in plane_names(name)]
    yield from _sensor_units("points", clouds, planes)
    yield from _sensor_units("ranges", ranges, ranges)
    if is_pointlike(session.body):
        if len(clouds) < len(session.sensors):  # with clouds only, the change of points is the same
            yield from point_units(session.body)
        yield from _body_changes(session.body)
    sensors: dict[str, Any] = {setup.name: setup.sensor for setup in cameras}
    yield from _inversions(sensors)
    for a, b in combinations(sensors, 2):
        remedy, swap = "with the source of each given to the other", {a: b, b: a}
        yield Change(f"{a!r} and {b!r} {{are}} swapped", remedy, partial(_swapped, other=swap))
    for a, b in combinations(sensors, 2):
        if type(sensors[a]) is type(sensors[b]):
            what = f"calibrations of {a!r} and {b!r} {{are}} swapped"
            remedy = "with camera_matrix and distortion of each given to the other"
            swapped = partial(_with_lens, lenses={a: sensors[b], b: sensors[a]})
            yield _sensor_change(what, remedy, (a, b), swapped)
    yield from _flips(cameras, "mirrored", "left and right", 0)
    for names in _all_or_one(list(sensors)):
        for factor, images, done in ((2.0, "half", "doubled"), (0.5, "twice", "halved")):
            what = f"camera_matrix of {quoted(names)} {{is}} that of images {images} as large"
            remedy = f"with fx, fy, cx and cy {done}"
            yield _sensor_change(what, remedy, names, partial(_scaled, factor=factor))
    if len(cameras) > 1:  # for one camera it is a mirror image and half a turn
        for change in _flips(cameras, "upside down", "top and bottom", 1):
            yield replace(change, leads=False)


def _flips(cameras: Sequence[SensorSetup], what: str, ends: str, axis: int) -> Iterator[Change]:
    """Yield changes by which an axis of images counts from the other end."""
    sized = {s.name: s.resolution for s in cameras if s.resolution is not None}
    is_flipped = np.arange(2) == axis

    def flipped(view: View) -> View:
        last = sized[view.name][axis] - 1.0
        return _with_points(view, lambda points: np.where(is_flipped, last - points, points))

    for names in _all_or_one(list(sized)):
        remedy = f"with {ends} of them exchanged"
        yield _sensor_change(f"images of {quoted(names)} {{are}} {what}", remedy, names, flipped)


def _sensor_change(
    what: str, remedy: str, names: Sequence[str], changed: Callable[[View], View]
) -> Change:
    """Return a change of the views of the sensors with these names."""
    return Change(what, remedy, lambda views: [changed(v) if v.name in names else v for v in views])


def _with(view: View, **changed: Floats) -> View:
    """Return a view with fields of its camera changed."""
    camera: Any = view.sensor
    return replace(view, sensor=replace(camera, **changed))


def _scaled(view: View, factor: float) -> View:
    """Return a view with the camera matrix of images `factor` times as large."""
    camera: Any = view.sensor
    return _with(view, camera_matrix=camera.camera_matrix * np.array([[factor], [factor], [1.0]]))


def _with_lens(view: View, lenses: Mapping[str, Any]) -> View:
    """Return a view with the lens of another camera at the same pose."""
    lens = lenses[view.name]
    return _with(view, camera_matrix=lens.camera_matrix, distortion=lens.distortion)


def _sensor_units(what: str, names: Sequence[str], views: Sequence[str]) -> Iterator[Change]:
    """Yield changes of the unit of length in which sensors measure."""
    for factor, scaled in _UNITS if names else ():
        wrong = f"the {what} of {quoted(names)} {{are}} in another unit than the session"
        changed = partial(_with_points, changed=partial(np.multiply, factor))
        yield _sensor_change(wrong, f"with them {scaled}", views, changed)


def _body_changes(body: Body) -> Iterator[Change]:
    middle, normals = body.means.mean(axis=0), body.normals
    mirror = np.array([1.0, 1.0, -1.0])
    mirrored = None if normals is None else normals * mirror
    yield Change(
        "the body of [object] {is} mirrored, or seen in a mirror",
        "with one coordinate of all points negated",
        body=lambda body: of_points(body, middle + (body.means - middle) * mirror, mirrored),
    )
    if normals is not None:
        yield Change(
            "normals of [object] {are} of the wrong sign",
            "with all of them negated",
            body=lambda body: of_points(body, body.means, -normals),
        )


def point_units(body: Body) -> Iterator[Change]:
    """Yield changes of the unit of the body's points alone, say metres for millimetres."""
    for factor, scaled in _UNITS:
        what = "points and translations {are} in two units of length"
        yield Change(what, f"with points {scaled}", body=partial(of_size, factor=factor))


def _all_or_one(names: Sequence[str]) -> list[list[str]]:
    """Return all names together, then each alone."""
    return ([list(names)] if names else []) + ([[n] for n in names] if len(names) > 1 else [])


OTHER_SIZE = (
    "the body of [object] {is} not of the size that was seen, or translations are in another unit "
    "than points"
)


def times_as_large(factor: float) -> str:
    """Say a factor in words, to two digits of its difference from 1."""
    places = 1 - math.floor(math.log10(max(abs(factor - 1), 1e-9)))
    return f"{round(factor, max(places, 2)):.9g} times as large"


def misplaced(setup: SensorSetup) -> str:
    """Say that a sensor stands elsewhere, as in `Change.what`."""
    sensor: Any = setup.sensor
    at_origin = np.array_equal(sensor.T_sensor_world, np.eye(4))
    return f"T_sensor_world of {setup.name!r} {{is}} off{' or left out' if at_origin else ''}"


def moved_by(before: Floats, after: Floats, unit: str) -> str:
    """Say in words how two T_sensor_world (4, 4) differ."""
    shift, turn = np.linalg.norm((after - before)[:3, 3]), rotation_angle_deg(before, after)
    length, angle = (f"{float(f'{float(value):.2g}'):g}" for value in (shift, turn))
    return f"with it moved by {length} {unit} and turned by {angle} deg"


def quoted(names: Sequence[str]) -> str:
    """Join names of sensors in words."""
    return " and ".join(repr(name) for name in names)


def _inversions(sensors: Mapping[str, Any]) -> Iterator[Change]:
    """Yield changes that invert T_sensor_world, for sessions with poses of cameras in the world."""
    poses = {name: sensor.T_sensor_world for name, sensor in sensors.items()}
    far = [name for name, T in poses.items() if not np.allclose(T, np.eye(4), atol=1e-5)]
    for names in _all_or_one(far):
        yield _sensor_change(
            f"T_sensor_world of {quoted(names)} {'{is}' if len(names) == 1 else '{are}'} inverted "
            "(it maps world to sensor coordinates)",
            "with the inverse",
            names,
            lambda view: _with(view, T_sensor_world=inverse(view.sensor.T_sensor_world)),  # type: ignore[attr-defined]
        )


def _swapped(views: Views, other: Mapping[str, str]) -> Views:
    seen = {other.get(view.name, view.name): view.observation for view in views}
    return [replace(view, observation=seen[view.name]) for view in views if view.name in seen]


def _with_points(view: View, changed: Callable[[Floats], Floats]) -> View:
    """Return a view with the places of its detections changed."""
    pattern = view.observation.pattern
    if not isinstance(pattern, PointPattern):
        return view
    moved = replace(pattern, points=np.asarray(changed(pattern.points)))
    return replace(view, observation=type(view.observation)(moved, view.observation.sigma))


def by_cameras_alone(session: Session, frames: Frames) -> Iterator[Change]:
    """Yield another size of the body, and other poses of cameras, by poses from single cameras."""
    alone = list[dict[str, tuple[Any, Floats]]]()  # of each frame: cameras, T_world_object
    for number, views in frames:
        poses = [(view, _alone(session, number, view)) for view in views]
        alone.append({view.name: (view.sensor, T) for view, T in poses if T is not None})
    if is_pointlike(session.body):
        yield from _other_sizes(session, alone)
    for setup in session.sensors:
        name, shared = setup.name, [c for c in alone if setup.name in c and len(c) > 1]
        for cameras in shared[:1]:
            sensor, T_alone = cameras[name]
            T_other = next(T for other, (_, T) in cameras.items() if other != name)
            T = sensor.T_sensor_world @ T_alone @ inverse(T_other)
            remedy = moved_by(sensor.T_sensor_world, T, session.unit)
            change = partial(_with, T_sensor_world=T)
            moved = _sensor_change(misplaced(setup), remedy, [name], change)
            yield replace(moved, cost=3 * math.log(2 * len(session.body) * len(alone)), values=6)


def _other_sizes(session: Session, alone: Sequence[dict[str, Any]]) -> Iterator[Change]:
    """Yield the body of the size by which poses from single cameras agree, if it is another."""
    # a camera alone finds the body at a distance in proportion to the size it is given, so that
    # p_b = R p_a + t / size relates the places in two cameras, (R, t) being from a to b
    middle, sizes = np.append(session.body.means.mean(axis=0), 1.0), list[float]()
    for cameras in alone:
        for (a, T_a), (b, T_b) in combinations(cameras.values(), 2):
            T_ba = b.T_sensor_world @ inverse(a.T_sensor_world)
            p_a = (a.T_sensor_world @ T_a @ middle)[:3]
            p_b = (b.T_sensor_world @ T_b @ middle)[:3]
            shift = p_b - T_ba[:3, :3] @ p_a
            sizes.append(float(shift @ T_ba[:3, 3] / max(float(shift @ shift), 1e-300)))
    size, (least, most) = float(np.median(sizes or [1.0])), _OTHER_SIZE
    if abs(size - 1) > least and 1 / most < size < most:
        remedy = f"with points {times_as_large(size)}"
        yield Change(OTHER_SIZE, remedy, body=partial(of_size, factor=size), values=1)


def _alone(session: Session, number: int, view: View) -> Floats | None:
    """Search T_world_object (4, 4) by one camera alone; return None if it finds none."""
    if not (isinstance(view.sensor, Camera) and are_sufficient([view], len(session.body))):
        return None
    anywhere, guesses = without_start(session), DiagnosisRules().guesses
    pose, _ = best_pose(anywhere, session.body, number, [view], guesses)
    return None if pose is None else pose.T_world_object
