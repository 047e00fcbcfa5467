"""Values of a session that may be off: the body's size, lenses, poses of cameras, markers.

They are adjusted by least squares over the matches of several frames, together with the poses of
all frames, and their velocities where a frame is not seen at one instant; outlying matches are
weighed down as by Huber's loss.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Any

import numpy as np

from mixpose.checking.changes import OTHER_SIZE, called, misplaced, moved_by, times_as_large
from mixpose.checking.evidence import Seen
from mixpose.objective import pose_jacobian
from mixpose.records import Floats
from mixpose.rigid import perturb
from mixpose.search import is_pointlike
from mixpose.sensors import PinholeCamera, Sensor
from mixpose.session import SensorSetup, Session

_ITERATIONS = 8
_OUTLYING = 3.0  # deviations from which a match counts less
_STEP = 1e-4  # of a deviation, for derivatives
_FEWEST = 4  # coordinates beyond those of poses and values that are asked for
_SIZE = 0.1  # deviations: of the body's size
_FOCAL, _CENTRE = 0.1, 0.05  # of the focal length, and of the image
_BENT = 0.1  # what a lens moves the corners of its image by, of their distance
_MOVED, _TURNED = 1.0, 0.1  # cameras, in radii of the body and rad
_SHIFTING, _TURNING = 10.0, 5.0  # of the body, in its radii and rad per second
_MARKER = 0.05  # radii, that a marker is off: spots beside a hidden one are further
_LEFT_OUT = 6.0  # nats for distortion where none is given: lenses distort
_COPIED = 30.0  # nats for one of two cameras with the very same calibration: no two lenses have


@dataclass(frozen=True)
class Unknown:
    """Values of a session that may be other than it says, 0 where it is right."""

    what: str  # is wrong, as in `Change`
    remedy: Callable[[Floats], str]  # what values (k,) explain the frames by
    deviations: Floats  # (k,), how far off they may be
    # points (N, 3) of the body by those given and values (k,)
    points: Callable[[Floats, Floats], Floats] = lambda points, _: points
    # those that are changed, by name: a sensor by the one given and values (k,)
    sensors: Mapping[str, Callable[[Any, Floats], Any]] = field(default_factory=dict)
    feature: int | None = None  # the only one that is changed
    cost: float = 0.0  # nats against it, beside what its values cost

    def sensor(self, name: str, given: Any, values: Floats) -> Any:
        """A sensor by the one given and values (k,)."""
        return self.sensors[name](given, values) if name in self.sensors else given


@dataclass(frozen=True)
class Adjustment:
    """Frames to which poses and values are fitted."""

    points: Floats  # (N, 3) of the body as it is given
    sensors: Mapping[str, Sensor]  # as they are given, by name
    frames: Sequence[Sequence[Seen]]
    poses: Sequence[Floats]  # (4, 4) where to begin, one of each frame
    beside: Sequence[Sequence[Seen]] = field(default_factory=list)  # for a feature by itself

    def of(self, unknown: Unknown) -> Adjustment:
        """With what may have met a feature that was missed, for values of that feature."""
        sensors: Mapping[str, Any] = self.sensors
        endless = {  # cameras without the bounds of their images
            name: replace(each, resolution=None) if hasattr(each, "resolution") else each
            for name, each in sensors.items()
        }
        frames = [list(frame) for frame in self.frames]
        for own, others in zip(frames, self.beside):
            for seen in others if unknown.feature is not None else ():
                is_it = seen.features == unknown.feature
                if is_it.any():
                    own.append(seen.only(is_it))
        return replace(self, sensors=endless, frames=frames)

    def has(self, unknown: Unknown) -> bool:
        """Whether anything may have met its feature that was missed."""
        feature, frames = unknown.feature, self.beside
        return feature is not None and any(feature in s.features for own in frames for s in own)

    @property
    def count(self) -> int:
        """Number of coordinates that are met."""
        return 2 * sum(len(seen.features) for frame in self.frames for seen in frame)

    @cached_property
    def motion(self) -> int:
        """Unknowns of each frame: its pose, and its velocity where not all is seen at once."""
        seconds = [seen.seconds for frame in self.frames for seen in frame if len(seen.features)]
        return 12 if seconds and np.ptp(np.concatenate(seconds)) > 0 else 6


def promise(unknown: Unknown, given: Adjustment) -> float:
    """Nats that values are likely to gain, by one step of least squares."""
    given, k = given.of(unknown), len(unknown.deviations)
    if given.count < 6 * len(given.frames) + k + _FEWEST:
        return 0.0
    begun = np.zeros(given.motion * len(given.poses) + k)
    A, b = _normal(unknown, given, given.poses, begun)
    scales, steps = _scales(unknown, given), np.zeros((2, len(b)))
    # what moves gains nothing by values
    steps[0, :-k], steps[1] = np.linalg.solve(A[:-k, :-k], b[:-k]), np.linalg.solve(A, b)
    gain = 0.0
    for f, T in enumerate(given.poses):
        own = _own(given, f, k)
        r, J = _linearised(unknown, given, f, T, begun[own], scales[own])
        # what is far off may be of clutter, and gains no more than what is outlying
        left = [np.minimum(np.abs(r + J @ step[own]), _OUTLYING) for step in steps]
        without, by_values = ((0.5 * each**2).sum() for each in left)
        gain += float(without - by_values)
    return gain


def adjusted(unknown: Unknown, given: Adjustment) -> tuple[Floats, list[Floats]] | None:
    """Values (k,) and poses (4, 4) that suit the matches best; None where these are too few."""
    given, k = given.of(unknown), len(unknown.deviations)
    if given.count < 6 * len(given.frames) + k + _FEWEST:
        return None
    poses, state = list(given.poses), np.zeros(given.motion * len(given.poses) + k)
    for _ in range(_ITERATIONS):
        scales = _scales(unknown, given)
        step = np.linalg.solve(*_normal(unknown, given, poses, state)) * scales
        if not np.isfinite(step).all():
            return None
        poses = [perturb(T, step[_own(given, f, 0)[:6]]) for f, T in enumerate(poses)]
        state = state + step
        if np.abs(step / scales).max() < 1e-4:
            break
    return state[-k:], poses


def _own(given: Adjustment, f: int, k: int) -> list[int]:
    """Where a frame's pose and velocity are among all unknowns, and then the k values."""
    p, F = given.motion, len(given.poses)
    return [*range(p * f, p * f + p), *range(p * F, p * F + k)]


def _scales(unknown: Unknown, given: Adjustment) -> Floats:
    """Units in which poses (the body's size, radians), velocities and values are fitted."""
    # of velocities and values they are deviations
    size = float(np.linalg.norm(given.points - given.points.mean(axis=0), axis=1).max())
    pose = np.array([size] * 3 + [1.0] * 3 + [_SHIFTING * size] * 3 + [_TURNING] * 3)
    return np.concatenate([np.tile(pose[: given.motion], len(given.frames)), unknown.deviations])


def _normal(
    unknown: Unknown, given: Adjustment, poses: Sequence[Floats], state: Floats
) -> tuple[Floats, Floats]:
    """Normal equations of a step of poses, velocities and values, in their scales."""
    # of the state only velocities and values count; poses are what they are
    k, scales = len(unknown.deviations), _scales(unknown, given)
    A, b = 1e-9 * np.eye(len(state)), np.zeros(len(state))
    frames = np.arange(len(state) - k) % given.motion
    known = np.concatenate([np.flatnonzero(frames >= 6), np.arange(len(state) - k, len(state))])
    A[known, known] += 1.0
    b[known] = -(state / scales)[known]
    for f, T in enumerate(poses):
        own = _own(given, f, k)
        r, J = _linearised(unknown, given, f, T, state[own], scales[own])
        w = _OUTLYING / np.maximum(np.abs(r), _OUTLYING)
        A[np.ix_(own, own)] += J.T @ (w[:, None] * J)
        b[own] -= J.T @ (w * r)
    return A, b


def _linearised(
    unknown: Unknown, given: Adjustment, f: int, T: Floats, state: Floats, scales: Floats
) -> tuple[Floats, Floats]:
    """Residuals (R,) of a frame in the noise, and their derivatives (R, p + k), in scales."""
    # of the state (p + k,) of the frame, the velocity and the values
    p, values = given.motion, state[given.motion :]
    points, steps = unknown.points(given.points, values), _STEP * np.diag(unknown.deviations)
    lever = points @ T[:3, :3].T
    world = lever + T[:3, 3]
    by_twist = pose_jacobian(np.broadcast_to(np.eye(3), (len(points), 3, 3)), lever)
    moved = np.zeros((len(points), 3, len(scales)))  # of a point in the world, by pose and values
    moved[:, :, :6] = by_twist * scales[:6]
    for j, step in enumerate(steps if points is not given.points else ()):
        by_step = unknown.points(given.points, values + step) - points
        moved[:, :, p + j] = by_step @ T[:3, :3].T / _STEP
    parts, columns = [np.zeros(0)], [np.zeros((0, len(scales)))]
    for seen in given.frames[f]:
        at, of_point = world[seen.features], moved[seen.features]
        if p > 6:
            late = by_twist[seen.features] * seen.seconds[:, None, None]
            at, of_point[:, :, 6:p] = at + late @ state[6:p], late * scales[6:p]
        sensor = unknown.sensor(seen.name, given.sensors[seen.name], values)
        y, J, visible = sensor.linearise(at)
        by_all = J @ of_point
        for j, step in enumerate(steps if sensor is not given.sensors[seen.name] else ()):
            other = unknown.sensor(seen.name, given.sensors[seen.name], values + step)
            by_all[:, :, p + j] += np.where(visible[:, None], other.project(at)[0] - y, 0.0) / _STEP
        off, noise = np.where(visible[:, None], y - seen.observed, 0.0), seen.noise[:, None]
        parts.append((off / noise).ravel())
        columns.append((by_all / noise[..., None]).reshape(-1, len(scales)))
    return np.concatenate(parts), np.concatenate(columns)


def unknowns(session: Session) -> Iterator[Unknown]:
    """Values that may be off, those that few describe first."""
    cameras = [s for s in session.sensors if isinstance(s.sensor, PinholeCamera)]
    body = session.body
    are_points = is_pointlike(body)
    if are_points and len(cameras) > 1:
        yield Unknown(
            OTHER_SIZE,
            lambda v: f"with points {times_as_large(1 + v[0])}",
            np.array([_SIZE]),
            points=lambda points, v: points + v[0] * (points - points.mean(axis=0)),
        )
    if are_points:
        yield from _markers(session)
    lenses: dict[str, Any] = {setup.name: setup.sensor for setup in cameras}
    bare = [name for name, each in lenses.items() if not np.any(each.distortion)]
    if bare:
        yield _distortion(bare)
    for setup in cameras:
        yield _calibration(setup, cameras)
    for setup in cameras if len(cameras) > 1 else ():
        yield Unknown(
            misplaced(setup),
            lambda v: moved_by(np.eye(4), perturb(np.eye(4), v), session.unit),
            np.array([_MOVED * body.radius] * 3 + [_TURNED] * 3),
            sensors={setup.name: _moved},
        )


def _markers(session: Session) -> Iterator[Unknown]:
    body = session.body
    for i, label in enumerate(body.labels):
        only = np.eye(len(body))[:, [i]]
        yield Unknown(
            f"marker {label} of [object] {{is}} measured wrong",
            lambda v, i=i: (
                f"with it {np.linalg.norm(v):.2g} {session.unit} away at "  # type: ignore[misc]
                f"{np.round(body.means[i] + v, 2).tolist()}"
            ),
            np.full(3, _MARKER * body.radius),
            points=lambda points, v, only=only: points + only * v,  # type: ignore[misc]
            feature=i,
        )


def _moved(sensor: Any, v: Floats) -> Any:
    return replace(sensor, T_sensor_world=perturb(sensor.T_sensor_world, v))


def _distortion(names: Sequence[str]) -> Unknown:
    """Two coefficients of each camera that has none."""
    return Unknown(
        f"distortion of {called(names)} {{is}} left out",
        lambda v: "with two coefficients k1 and k2 for each lens",
        np.full(2 * len(names), _BENT),
        sensors={name: partial(_bent, own=slice(2 * k, 2 * k + 2)) for k, name in enumerate(names)},
        cost=-_LEFT_OUT,
    )


def _calibration(setup: SensorSetup, cameras: Sequence[SensorSetup]) -> Unknown:
    """Focal length, principal point and two coefficients of the distortion of a camera."""
    camera: Any = setup.sensor
    given = camera.camera_matrix
    others: dict[str, Any] = {each.name: each.sensor for each in cameras if each is not setup}
    twins = [
        other
        for other, each in others.items()
        if np.array_equal(given, each.camera_matrix)
        and np.array_equal(camera.distortion, each.distortion)
        and np.any(camera.distortion)
    ]
    centre = _CENTRE * 2 * float(given[0, 2])

    def other(sensor: Any, v: Floats) -> Any:
        K = np.array(sensor.camera_matrix)
        K[:2, :2] *= 1 + v[0]
        K[:2, 2] += v[1:3]
        return replace(_bent(sensor, v, slice(3, None)), camera_matrix=K)

    def remedy(v: Floats) -> str:
        changed = other(camera, v)
        K, k = changed.camera_matrix, changed.distortion[:2]
        return (
            f"with about fx = {K[0, 0]:.5g}, cx = {K[0, 2]:.4g}, cy = {K[1, 2]:.4g}, "
            f"k1 = {k[0]:.2g}, k2 = {k[1]:.2g}{moved}"
        )

    moved = " (or it was moved: mixpose calibrate --check tells)" * bool(others)
    is_copied = len(twins) == 1  # cameras of a kind may all have the same
    copied = f", but that of {twins[0]!r}" if is_copied else ""
    return Unknown(
        f"the calibration of {setup.name!r} {{is}} not that of its images{copied}",
        remedy,
        np.array([_FOCAL, centre, centre, _BENT, _BENT]),
        sensors={setup.name: other},
        cost=-_COPIED if is_copied else 0.0,
    )


def _bent(sensor: Any, v: Floats, own: slice) -> Any:
    """A camera whose lens moves the corners of its image by two values more, of their distance."""
    K = sensor.camera_matrix
    squared = float((K[:2, 2] / K[[0, 1], [0, 1]]) @ (K[:2, 2] / K[[0, 1], [0, 1]]))
    k = np.zeros(max(len(sensor.distortion), 4))
    k[: len(sensor.distortion)] = sensor.distortion
    k[:2] += v[own] / [squared, squared**2]
    return replace(sensor, distortion=k)
