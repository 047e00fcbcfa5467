"""Choose where bodies are simulated if the session has no start: in view of its sensors.

With several cameras that is the point at which they look; with one camera, in front of it where the
body fills about a quarter of the image; with range sensors, to one side of their mean position.
Further bodies are placed around it, so far apart that they touch by their motion at most.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from mixpose.body import Body
from mixpose.errors import SessionError
from mixpose.records import Floats
from mixpose.rigid import from_parts, inverse, rotation_matrix, transform
from mixpose.sensors import CloudSensor, FisheyeCamera, ParallelBeam, PinholeCamera, RangeSensor
from mixpose.session import SensorSetup, Session
from mixpose.simulation.motion import Motion, plan_motion
from mixpose.simulation.options import Purpose, SimulationOptions, generator
from mixpose.simulation.scenery import Actor
from mixpose.simulation.visible_spots import brightness_levels, facing

_SIDE_FILLED = 0.5  # of the image's smaller side: a quarter of the area
_SIDE_VISIBLE = 0.05  # a smaller body would look like a single blob
_ORIENTATIONS = 64
_AMPLITUDE = 0.4  # of the body's radius
_APART = 1.1  # sums of radii between bodies at rest
_TRIES = 48  # candidate places at each distance
_DISTANCES = (1.2, 1.6, 2.2, 3.0, 4.0)  # radii of the largest body
_SEEDS_APART = 101  # between the seeds of bodies


def central_pose(session: Session, seed: int) -> Floats:
    """Return the pose T_world_object (4, 4) about which a simulated motion swings.

    That is ``[start]`` if the session has one.  Otherwise the place follows from the sensors, and
    of several random orientations the one with most features in view is chosen.  Raises a
    `SessionError` if no sensor sees a feature of the body there.
    """
    if session.start is not None:
        T = session.start.T_world_object
        if count_seen(session, T) == 0:
            raise SessionError(
                f"{session.path}: start: no sensor sees a feature of the object there; place the "
                "object in view of the sensors"
            )
        return T
    pivot = pivot_of(session.body)
    rng = generator(seed, Purpose.ORIENTATION)
    rotations = Rotation.random(_ORIENTATIONS, rng=rng).as_matrix()
    places = candidate_places(session)
    poses = [from_parts(R, place - R @ pivot) for place in places for R in rotations]
    counts = [count_seen(session, T) for T in poses]
    best = int(np.argmax(counts))
    if counts[best] == 0:
        raise SessionError(
            f"{session.path}: start: missing, and no place was found where a sensor sees the "
            "object; add [start] with T_world_object"
        )
    return poses[best]


def motion_about(
    session: Session, T_world_object: Floats, options: SimulationOptions, seed: int
) -> Motion:
    """Plan the motion of a session's body about a central pose."""
    body, amplitude = session.body, options.amplitude_translation
    return plan_motion(
        T_world_object,
        pivot_of(body),
        translation=_AMPLITUDE * body.radius if amplitude is None else amplitude,
        rotation_deg=options.amplitude_rotation_deg,
        period_s=options.period_s,
        free=session.estimator.free,
        seed=seed,
    )


def pivot_of(body: Body) -> Floats:
    """Return the point (3,) about which a simulated body turns: the mean of its features."""
    return np.asarray(body.means.mean(axis=0))


def count_seen(session: Session, T_world_object: Floats) -> int:
    """Count the features in view, summed over the sensors."""
    body, points = session.body, transform(T_world_object, session.body.means)
    sensors = [setup.sensor for setup in session.sensors]
    seen = [s.project(points)[1] & facing(s, body, T_world_object) for s in sensors]
    return int(np.sum(seen))


def candidate_places(session: Session) -> list[Floats]:
    """Return candidates for the pivot's place (3,) in the world, best first; needs resolutions."""
    radius = session.body.radius
    all_rays = [_ray(setup, radius) for setup in session.sensors]
    rays = [ray for ray in all_rays if ray is not None]
    if not rays:
        clouds = [s.sensor for s in session.sensors if isinstance(s.sensor, CloudSensor)]
        return [inverse(clouds[0].T_sensor_world)[:3, 3]] if clouds else [_place_by_ranges(session)]
    origin = np.mean([ray.origin for ray in rays], axis=0)
    direction = np.mean([ray.direction for ray in rays], axis=0)
    ahead = origin + direction * float(np.mean([ray.distance or 0.0 for ray in rays]))
    crossing = _crossing(rays)
    if crossing is not None and all(ray.has_in_range(crossing) for ray in rays):
        return [crossing, ahead]
    return [ahead]


@dataclass(frozen=True)
class _Ray:
    """The line of sight through the middle of a camera's image."""

    origin: Floats
    direction: Floats
    distance: float | None  # at which the body fills its share of the image; None for any

    def has_in_range(self, place: Floats) -> bool:
        """Test whether a body at a place is in front, and neither too near nor too small."""
        if self.distance is None:
            return True
        depth = float((place - self.origin) @ self.direction)
        farthest = _SIDE_FILLED / _SIDE_VISIBLE * self.distance
        return 0.5 * self.distance <= depth <= farthest


def _ray(setup: SensorSetup, radius: float) -> _Ray | None:
    sensor = setup.sensor
    if not isinstance(sensor, ParallelBeam | PinholeCamera | FisheyeCamera):
        return None
    size = np.asarray(setup.resolution, dtype=np.float64)
    middle, R, t = (size - 1) / 2, sensor.T_sensor_world[:3, :3], sensor.T_sensor_world[:3, 3]
    if isinstance(sensor, ParallelBeam):
        offset = np.append((middle - sensor.principal_point) * sensor.pixel_size, 0.0)
        return _Ray(R.T @ (offset - t), R[2], None)
    K = sensor.camera_matrix
    sight = np.append((middle - K[:2, 2]) / K.diagonal()[:2], 1.0)
    distance = 2 * radius * K[0, 0] / (_SIDE_FILLED * size.min())
    return _Ray(-R.T @ t, R.T @ sight / np.linalg.norm(sight), float(distance))


def _crossing(rays: list[_Ray]) -> Floats | None:
    """Return the point (3,) nearest to all rays; None if they are about parallel."""
    projections = [np.eye(3) - np.outer(ray.direction, ray.direction) for ray in rays]
    total = np.sum(projections, axis=0)
    if np.linalg.eigvalsh(total)[0] < 1e-3 * len(rays):
        return None
    return np.asarray(np.linalg.solve(total, sum(P @ r.origin for P, r in zip(projections, rays))))


def _place_by_ranges(session: Session) -> Floats:
    """Return a place off the plane of the range sensors, in which ranges cannot tell the side."""
    sensors = [setup.sensor for setup in session.sensors]
    positions = np.array([s.position for s in sensors if isinstance(s, RangeSensor)])
    nearest = max((s.range_min or 0.0 for s in session.sensors), default=0.0)
    centred = positions - positions.mean(axis=0)
    spread = float(np.sqrt((centred**2).sum(axis=1).mean()))
    aside = max(spread / 2, nearest + 5 * session.body.radius)
    _, _, axes = np.linalg.svd(centred, full_matrices=True)
    return np.asarray(positions.mean(axis=0) + aside * axes[2])


def plan_companions(
    session: Session, first: Motion, options: SimulationOptions
) -> tuple[Actor, ...]:
    """Place and move the further bodies of a session; a `SessionError` if there is no place."""
    members = [(entry, i) for entry in session.objects for i in entry.instances][1:]
    if not members:
        return ()
    if any(setup.sensor.dimension != 2 for setup in session.sensors):
        raise SessionError(
            f"{session.path}: object: found {len(members) + 1} bodies before range sensors or "
            "clouds; simulate draws several bodies before cameras only"
        )
    placed = [(_middle(first.T_world_object, session.body), session.body.radius)]
    companions = []
    for k, (entry, instance) in enumerate(members, start=1):
        alone = session.with_only(entry.body.name)
        seed = options.seed + _SEEDS_APART * k
        T = central_pose(alone, seed)
        if entry.start is None or instance:
            T = _pose_apart(alone, T, placed, seed, turned=entry.start is not None)
        placed.append((_middle(T, entry.body), entry.body.radius))
        motion = motion_about(alone, T, options, seed)
        rng = generator(seed, Purpose.BRIGHTNESS)
        levels = brightness_levels(len(entry.body), options.brightness_spread, rng)
        companions.append(Actor(entry.body, motion.pose, levels, is_body=True))
    return tuple(companions)


def _middle(T_world_object: Floats, body: Body) -> Floats:
    return np.asarray(T_world_object[:3, :3] @ pivot_of(body) + T_world_object[:3, 3])


def _pose_apart(
    session: Session, T: Floats, placed: Sequence[tuple[Floats, float]], seed: int, *, turned: bool
) -> Floats:
    """Return a pose apart from all placed bodies, as near as possible with all features seen."""
    body = session.body
    rng = generator(seed, Purpose.ORIENTATION)
    largest = max([body.radius, *(radius for _, radius in placed)])
    for distance in _DISTANCES:
        most, best = -1, T
        for _ in range(_TRIES):
            direction = rng.standard_normal(3)
            shift = distance * largest * direction / np.linalg.norm(direction)
            middle = placed[0][0] + shift
            R = rotation_matrix(rng.standard_normal(3)) @ T[:3, :3] if turned else T[:3, :3]
            near = [np.linalg.norm(middle - m) < _APART * (body.radius + r) for m, r in placed]
            if any(near):
                continue
            T_candidate = from_parts(R, middle - R @ pivot_of(body))
            seen = count_seen(session, T_candidate)
            if seen > most:
                most, best = seen, T_candidate
        if most == len(body) * len(session.sensors):
            return best
    raise SessionError(
        f"{session.path}: object {body.name!r}: found no place apart from the other bodies in view "
        "of all cameras; give it an [object.start]"
    )
