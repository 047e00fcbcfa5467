"""Check where sensors stand and look, and whether the body starts in their view.

If the session has no start, typical poses have the body in view, turned at random.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from itertools import combinations
from typing import TypeAlias

import numpy as np
from scipy.spatial.transform import Rotation

from mixpose.records import Floats, Mask
from mixpose.rigid import from_parts, inverse, rotation_angle_deg, transform
from mixpose.sensors import (
    CloudSensor,
    FisheyeCamera,
    ParallelBeam,
    PinholeCamera,
    RangeSensor,
    Sensor,
    facing,
)
from mixpose.session import SensorSetup, Session
from mixpose.simulation.central_pose import candidate_places, count_seen, pivot_of

Camera: TypeAlias = PinholeCamera | FisheyeCamera
Looking: TypeAlias = Camera | ParallelBeam

_SAME_ANGLE_DEG = 0.01
_MAPS = "it maps world to sensor coordinates, x_sensor = T_sensor_world x_world"
_LENSES_APART_M = 3e-3  # two lenses do not fit nearer to each other
_LARGEST_M = 20.0  # a lorry: larger things are hardly seen as one rigid body
_SMALL = 3.0  # times sigma: a smaller image of a body shows no orientation
_TRIED = 64


def placement_lines(setup: SensorSetup, unit: str) -> list[str]:
    """Describe the place and the viewing direction of a sensor in the world."""
    sensor = setup.sensor
    if isinstance(sensor, RangeSensor):
        return [f"at {_numbers(sensor.position)} {unit} in the world"]
    if isinstance(sensor, CloudSensor):
        return [f"axes from {_numbers(inverse(sensor.T_sensor_world)[:3, 3])} {unit} in the world"]
    if not isinstance(sensor, Looking):
        return []
    looks = f"looks along {_numbers(sensor.T_sensor_world[2, :3], 3)}"
    if isinstance(sensor, ParallelBeam):
        return [f"{looks} in the world"]
    return [f"at {_numbers(_centre(sensor))} {unit}, {looks} in the world"]


def placement_warnings(session: Session) -> list[str]:
    """Warn of what is most likely wrong about the poses of sensors and body, a line each."""
    at_start = _no_common_view if session.start is None else _out_of_view
    return [*_coincident(session), *_too_large(session), *at_start(session)]


def _out_of_view(session: Session) -> Iterator[str]:
    """Warn of sensors in which the body at [start] is out of view, in part or small."""
    assert session.start is not None
    T = session.start.T_world_object
    seen = {s.name: _seen(s.sensor, session, T) for s in session.sensors}
    unseen = [setup for setup in session.sensors if not seen[setup.name].any()]
    for setup in unseen:
        why = _why_unseen(setup.sensor, session, T)
        yield f"sensor {setup.name!r}: the body at [start] is {why}"
    for setup in session.sensors:
        count = int(seen[setup.name].sum())
        if 0 < count < len(session.body) / 2:
            yield (
                f"sensor {setup.name!r}: only {count} of {len(session.body)} features are in view "
                "at [start]"
            )
        yield from _too_small(setup, session, T, seen[setup.name])
    yield from _inverted(session, unseen, T)


def _coincident(session: Session) -> Iterator[str]:
    """Warn of sensors with the same place and orientation, or too near to each other."""
    for a, b in combinations(session.sensors, 2):
        if isinstance(a.sensor, RangeSensor) and isinstance(b.sensor, RangeSensor):
            if np.array_equal(a.sensor.position, b.sensor.position):
                yield f"sensors {a.name!r} and {b.name!r} stand at one position: check position"
        elif isinstance(a.sensor, Looking) and isinstance(b.sensor, Looking):
            T_a, T_b = a.sensor.T_sensor_world, b.sensor.T_sensor_world
            distance = np.linalg.norm(T_a[:3, 3] - T_b[:3, 3])
            is_near = distance <= 1e-6 * max(session.body.radius, float(np.linalg.norm(T_a[:3, 3])))
            if is_near and rotation_angle_deg(T_a, T_b) < _SAME_ANGLE_DEG:
                yield (
                    f"sensors {a.name!r} and {b.name!r} stand at one place and look the same way: "
                    "does one of them lack its T_sensor_world?"
                )
            elif isinstance(a.sensor, Camera) and isinstance(b.sensor, Camera):
                apart = float(np.linalg.norm(_centre(a.sensor) - _centre(b.sensor)))
                if apart * session.metres_per_unit <= _LENSES_APART_M:
                    yield (
                        f"sensors {a.name!r} and {b.name!r} stand {apart:.2g} {session.unit} "
                        f"apart, less than two lenses need: are translations in {session.unit}? "
                        "Kalibr, ROS and caliscope write metres"
                    )


def _too_large(session: Session) -> Iterator[str]:
    """Warn of bodies larger than is likely: lengths in another unit than the session says."""
    widths = {model.body.name: 2 * model.body.radius for model in session.objects}
    for name, width in widths.items():
        if width * session.metres_per_unit > _LARGEST_M:
            yield (
                f"the body {name!r} is {float(f'{width:.3g}'):g} {session.unit} across: is unit = "
                f'"{session.unit}" that of points and translations?'
            )


def _no_common_view(session: Session) -> Iterator[str]:
    """Warn of cameras that have no common view of the body."""
    cameras = [setup for setup in session.sensors if isinstance(setup.sensor, Looking)]
    blind = _blind(session, cameras)
    if len(cameras) < 2 or not blind:
        return
    names = ", ".join(repr(setup.name) for setup in blind)
    text = f"{names} would not see the body where the other sensors look"
    if len(blind) == len(cameras):
        text = f"no place was found that is in view of {names}"
    flipped = [replace(s, sensor=_with_inverse(s.sensor)) for s in cameras]
    if not _blind(replace(session, sensors=tuple(flipped)), flipped):
        yield f"{text}; with the inverse of each T_sensor_world all would: {_MAPS}"
    else:
        yield f"{text}: check T_sensor_world{_sizes(session, cameras)}"


def _sizes(session: Session, cameras: list[SensorSetup]) -> str:
    """Name the size of the body and the spacing of cameras, which may be in two units."""
    places = [_centre(setup.sensor) for setup in cameras if isinstance(setup.sensor, Camera)]
    spacing = max((float(np.linalg.norm(a - b)) for a, b in combinations(places, 2)), default=0.0)
    if spacing == 0:
        return ""
    width, apart = (f"{float(f'{x:.2g}'):g}" for x in (2 * session.body.radius, spacing))
    return (
        ", and whether points of [object] and translations are in the same unit: the body is "
        f"{width} {session.unit} across, the sensors {apart} {session.unit} apart"
    )


def _blind(session: Session, cameras: list[SensorSetup]) -> list[SensorSetup]:
    """Return the cameras that do not see the body at a typical pose."""
    poses = typical_poses(session, 1)
    if not poses:
        return cameras
    return [setup for setup in cameras if not _seen(setup.sensor, session, poses[0]).any()]


def _inverted(session: Session, unseen: list[SensorSetup], T_start: Floats) -> Iterator[str]:
    """Hint at a pose in the session whose inverse would put the body in view."""
    if not unseen:
        return
    cameras = {s.name: s.sensor for s in session.sensors if isinstance(s.sensor, Looking)}
    placed = {n: s for n, s in cameras.items() if not np.allclose(s.T_sensor_world, np.eye(4))}
    names = {setup.name for setup in unseen}
    # a hint only if it mends every camera: for one, it may be chance
    if placed and names.issuperset(placed):
        flipped = map(_with_inverse, placed.values())
        if all(_seen(sensor, session, T_start).all() for sensor in flipped):
            yield (
                "T_sensor_world looks inverted: with its inverse the body at [start] would be in "
                f"view of {', '.join(map(repr, placed))}; {_MAPS}"
            )
            return
    T_inverse = inverse(T_start)
    if len(unseen) == len(session.sensors) and all(
        _seen(sensor, session, T_inverse).all() for sensor in cameras.values()
    ):
        yield (
            "start.T_world_object looks inverted: with its inverse the body would be in view of "
            "all cameras; it maps object to world coordinates"
        )


def _with_inverse(sensor: Sensor) -> Sensor:
    assert isinstance(sensor, Looking)
    return replace(sensor, T_sensor_world=inverse(sensor.T_sensor_world))


def _why_unseen(sensor: Sensor, session: Session, T_start: Floats) -> str:
    """Say where the body is that a sensor does not see, and which keys to check."""
    points = transform(T_start, session.body.means)
    if not isinstance(sensor, Looking):
        return "out of reach: check position, range_min and the unit of lengths"
    in_sensor = transform(sensor.T_sensor_world, points)
    keys = "check T_sensor_world and [start]"
    if not isinstance(sensor, ParallelBeam) and (in_sensor[:, 2] <= 0).all():
        return f"behind it: {keys}"
    y, _ = replace(sensor, resolution=None).project(points)
    if isinstance(sensor, ParallelBeam | PinholeCamera) and (y > -1e5).all():
        u, v = y.mean(axis=0)
        width, height = sensor.resolution or (0, 0)
        return f"outside of its image of {width}x{height} px, at u = {u:.0f}, v = {v:.0f}: {keys}"
    return f"out of its view: {keys}"


def _too_small(setup: SensorSetup, session: Session, T_start: Floats, seen: Mask) -> Iterator[str]:
    """Warn of a body of a few pixels: mostly two units of length in one file."""
    if not isinstance(setup.sensor, Looking) or seen.sum() < 2:
        return
    y, _ = setup.sensor.project(transform(T_start, session.body.means))
    extent = float(np.ptp(y[seen], axis=0).max())
    if extent <= _SMALL * setup.extract.sigma:
        yield (
            f"sensor {setup.name!r}: the body at [start] is {extent:.2g} px wide: are points, "
            f"translation and T_sensor_world all in {session.unit}?"
        )


def expected_count(setup: SensorSetup, session: Session) -> int:
    """Return how many features a sensor should see: those in view at [start], if at least half.

    Without [start], for a body with normals: the median over views straight at one of its features.
    """
    count, normals = len(session.body), session.body.normals
    if session.start is None:
        if normals is None:
            return count
        return int(np.median(np.count_nonzero(normals @ normals.T > session.body.edge_on, axis=1)))
    T = session.start.T_world_object
    body = session.body
    seen = _seen(setup.sensor, session, T)
    seen &= facing(setup.sensor, T, transform(T, body.means), body.normals, body.edge_on)
    return int(seen.sum()) if seen.sum() >= count / 2 else count


def fewest_count(setup: SensorSetup, session: Session) -> int:
    """Return how many features a sensor should see at least, from the side that shows fewest."""
    normals = session.body.normals
    if normals is None or session.start is not None:
        return expected_count(setup, session)
    return int(np.count_nonzero(normals @ normals.T > session.body.edge_on, axis=1).min())


def _seen(sensor: Sensor, session: Session, T_world_object: Floats) -> Mask:
    """Return which features (N,) are inside a sensor's view."""
    return np.asarray(sensor.project(transform(T_world_object, session.body.means))[1])


def _centre(sensor: Camera) -> Floats:
    return np.asarray(inverse(sensor.T_sensor_world)[:3, 3])


def _numbers(values: Floats, digits: int = 4) -> str:
    largest = float(np.abs(values).max())
    # rounding errors, by the largest value, are shown as zero
    shown = (0.0 if abs(v) <= 1e-9 * largest else float(f"{v:.{digits}g}") for v in values)
    return f"({', '.join(f'{value:g}' for value in shown)})"


def with_image_sizes(session: Session, sizes: Mapping[str, tuple[int, int] | None]) -> Session:
    """Return a session whose cameras have the size of their images, those of recordings by name.

    If neither has it, the optical axis is assumed to meet the middle of the image.
    """
    setups = []
    for setup in session.sensors:
        sensor = setup.sensor
        size = setup.resolution or sizes.get(setup.name) or _size_by_axis(sensor)
        if isinstance(sensor, Looking):
            sensor = replace(sensor, resolution=size)
        setups.append(replace(setup, resolution=size, sensor=sensor))
    return replace(session, sensors=tuple(setups))


def _size_by_axis(sensor: Sensor) -> tuple[int, int] | None:
    if isinstance(sensor, Camera):
        u, v = sensor.camera_matrix[:2, 2]
    elif isinstance(sensor, ParallelBeam):
        u, v = sensor.principal_point
    else:
        return None
    return max(round(2 * u) + 1, 1), max(round(2 * v) + 1, 1)


def typical_poses(session: Session, count: int, *, away: float = 1.0) -> list[Floats]:
    """Return poses T_world_object in the sensors' common view, if any, that show most features.

    Every camera has a resolution. A single camera is `away` times as far from the body as where it
    fills half of the image's smaller side.
    """
    rotations = Rotation.random(_TRIED, rng=np.random.default_rng(0)).as_matrix()
    pivot = pivot_of(session.body)
    seen_at_best = 0
    chosen: list[Floats] = []
    for place in candidate_places(session):
        if depends_on_distance(session):
            centre = session.sensors[0].sensor.towards(place)
            place = place + (1 - away) * centre  # noqa: PLW2901
        poses = [from_parts(R, place - R @ pivot) for R in rotations]
        seen = np.array([count_seen(session, T) for T in poses])
        if seen.max() > seen_at_best:
            seen_at_best = int(seen.max())
            best = np.argsort(-seen, kind="stable")[:count]
            chosen = [poses[int(i)] for i in best if seen[i]]
    return chosen


def depends_on_distance(session: Session) -> bool:
    """Test whether there is one camera only, so that accuracy depends on the distance from it."""
    return len(session.sensors) == 1 and isinstance(session.sensors[0].sensor, Camera)
