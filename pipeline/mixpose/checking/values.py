"""Adjust values of a session that may be off: size of the body, lenses, camera poses, markers.

Least squares over the matches of several frames adjusts them together with the poses of all frames,
and with velocities if a frame is not seen at one instant; Huber's loss weighs outliers down.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Any

import numpy as np

from mixpose.checking.changes import OTHER_SIZE, misplaced, moved_by, quoted, times_as_large
from mixpose.checking.evidence import CameraMatches
from mixpose.objective import pose_jacobian
from mixpose.records import Floats
from mixpose.rigid import perturb
from mixpose.search import is_pointlike
from mixpose.sensors import PinholeCamera, Sensor
from mixpose.session import SensorSetup, Session

_ITERATIONS = 8
_OUTLYING = 3.0  # standard deviations from which a match counts less
_STEP = 1e-4  # of a standard deviation, for numerical derivatives
_FEWEST = 4  # more coordinates than poses and values have, at least
_SIZE = 0.1  # prior standard deviations: of the body's size
_FOCAL, _CENTRE = 0.1, 0.05  # of the focal length, and of the image
_BENT = 0.1  # distortion: shift of the corners of an image, by their distance from its centre
_MOVED, _TURNED = 1.0, 0.1  # of cameras, in radii of the body and rad
_SHIFTING, _TURNING = 10.0, 5.0  # of the body, in its radii and rad per second
_MARKER = 0.05  # of a marker, in radii: spots near a hidden one are farther
_LEFT_OUT = 6.0  # nats for distortion if none is given: lenses distort
_COPIED = 30.0  # nats for another calibration if two cameras share one: no two lenses are the same


@dataclass(frozen=True)
class Unknown:
    """Corrections to values of a session; 0 if it is right."""

    what: str  # what is wrong, as in `Change`
    remedy: Callable[[Floats], str]  # the remedy in words, by values (k,)
    deviations: Floats  # (k,) prior standard deviations
    # corrected points (N, 3) of the body, by those of the session and values (k,)
    points: Callable[[Floats, Floats], Floats] = lambda points, _: points
    # by name, how values (k,) correct a sensor of the session
    sensors: Mapping[str, Callable[[Any, Floats], Any]] = field(default_factory=dict)
    feature: int | None = None  # the only one that is corrected
    cost: float = 0.0  # nats against it in addition to those of its values

    def sensor(self, name: str, given: Any, values: Floats) -> Any:
        """Return a sensor corrected by values (k,)."""
        return self.sensors[name](given, values) if name in self.sensors else given


@dataclass(frozen=True)
class Adjustment:
    """Matches of frames to which poses and values are fitted."""

    points: Floats  # (N, 3) of the body by the session
    sensors: Mapping[str, Sensor]  # of the session, by name
    frames: Sequence[Sequence[CameraMatches]]
    poses: Sequence[Floats]  # (4, 4) start of each frame
    nearest: Sequence[Sequence[CameraMatches]] = field(default_factory=list)  # of missed features

    def for_unknown(self, unknown: Unknown) -> Adjustment:
        """Match the corrected feature to nearest detections where missed; drop bounds of images."""
        sensors: Mapping[str, Any] = self.sensors
        unbounded = {  # cameras without the bounds of their images
            name: replace(s, resolution=None) if hasattr(s, "resolution") else s
            for name, s in sensors.items()
        }
        frames = [list(frame) for frame in self.frames]
        for frame, nearest in zip(frames, self.nearest):
            for match in nearest if unknown.feature is not None else ():
                is_chosen = match.features == unknown.feature
                if is_chosen.any():
                    frame.append(match.only(is_chosen))
        return replace(self, sensors=unbounded, frames=frames)

    def has_nearest(self, unknown: Unknown) -> bool:
        """Test whether a detection is near the feature that is corrected where it was missed."""
        matches = [match for frame in self.nearest for match in frame]
        return unknown.feature is not None and any(unknown.feature in m.features for m in matches)

    @property
    def count(self) -> int:
        """Count the coordinates of all matches."""
        return 2 * sum(len(match.features) for frame in self.frames for match in frame)

    @cached_property
    def motion(self) -> int:
        """Count the unknowns of a frame: its pose, and its velocity unless all is seen at once."""
        seconds = [m.seconds for frame in self.frames for m in frame if len(m.features)]
        return 12 if seconds and np.ptp(np.concatenate(seconds)) > 0 else 6


def promise(unknown: Unknown, given: Adjustment) -> float:
    """Predict the nats that values gain, by one step of least squares."""
    given, k = given.for_unknown(unknown), len(unknown.deviations)
    if given.count < 6 * len(given.frames) + k + _FEWEST:
        return 0.0
    zero = np.zeros(given.motion * len(given.poses) + k)
    A, b = _normal(unknown, given, given.poses, zero)
    scales, steps = _scales(unknown, given), np.zeros((2, len(b)))
    # a step of poses and velocities alone, and one of all: values gain only what motion does not
    steps[0, :-k], steps[1] = np.linalg.solve(A[:-k, :-k], b[:-k]), np.linalg.solve(A, b)
    gain = 0.0
    for f, T in enumerate(given.poses):
        columns = _columns(given, f, k)
        r, J = _linearised(unknown, given, f, T, zero[columns], scales[columns])
        # a match that is far off may be clutter, and gains no more than an outlier
        remaining = [np.minimum(np.abs(r + J @ step[columns]), _OUTLYING) for step in steps]
        fixed, freed = ((0.5 * residuals**2).sum() for residuals in remaining)
        gain += float(fixed - freed)
    return gain


def adjusted(unknown: Unknown, given: Adjustment) -> tuple[Floats, list[Floats]] | None:
    """Fit values (k,) and poses (4, 4) to the matches; return None if these are too few."""
    given, k = given.for_unknown(unknown), len(unknown.deviations)
    if given.count < 6 * len(given.frames) + k + _FEWEST:
        return None
    poses, state = list(given.poses), np.zeros(given.motion * len(given.poses) + k)
    for _ in range(_ITERATIONS):
        scales = _scales(unknown, given)
        step = np.linalg.solve(*_normal(unknown, given, poses, state)) * scales
        if not np.isfinite(step).all():
            return None
        poses = [perturb(T, step[_columns(given, f, 0)[:6]]) for f, T in enumerate(poses)]
        state = state + step
        if np.abs(step / scales).max() < 1e-4:
            break
    return state[-k:], poses


def _columns(given: Adjustment, f: int, k: int) -> list[int]:
    """Return the indices of a frame's pose and velocity among all unknowns, then of k values."""
    p, F = given.motion, len(given.poses)
    return [*range(p * f, p * f + p), *range(p * F, p * F + k)]


def _scales(unknown: Unknown, given: Adjustment) -> Floats:
    """Return the units of poses (the body's size, radians), velocities and values in the fit."""
    # for velocities and values they are prior standard deviations
    size = float(np.linalg.norm(given.points - given.points.mean(axis=0), axis=1).max())
    pose = np.array([size] * 3 + [1.0] * 3 + [_SHIFTING * size] * 3 + [_TURNING] * 3)
    return np.concatenate([np.tile(pose[: given.motion], len(given.frames)), unknown.deviations])


def _normal(
    unknown: Unknown, given: Adjustment, poses: Sequence[Floats], state: Floats
) -> tuple[Floats, Floats]:
    """Return the normal equations of a step of poses, velocities and values, in their scales."""
    # only velocities and values have a prior, about 0; the part of poses in the state is not used
    k, scales = len(unknown.deviations), _scales(unknown, given)
    A, b = 1e-9 * np.eye(len(state)), np.zeros(len(state))
    offsets = np.arange(len(state) - k) % given.motion
    known = np.concatenate([np.flatnonzero(offsets >= 6), np.arange(len(state) - k, len(state))])
    A[known, known] += 1.0
    b[known] = -(state / scales)[known]
    for f, T in enumerate(poses):
        columns = _columns(given, f, k)
        r, J = _linearised(unknown, given, f, T, state[columns], scales[columns])
        w = _OUTLYING / np.maximum(np.abs(r), _OUTLYING)
        A[np.ix_(columns, columns)] += J.T @ (w[:, None] * J)
        b[columns] -= J.T @ (w * r)
    return A, b


def _linearised(
    unknown: Unknown, given: Adjustment, f: int, T: Floats, state: Floats, scales: Floats
) -> tuple[Floats, Floats]:
    """Return residuals (R,) of a frame in the noise, and derivatives (R, p + k) in scales."""
    # of the state (p + k,) of the frame only velocity and values are used: T is the pose
    p, values = given.motion, state[given.motion :]
    points, steps = unknown.points(given.points, values), _STEP * np.diag(unknown.deviations)
    lever = points @ T[:3, :3].T
    world = lever + T[:3, 3]
    by_twist = pose_jacobian(np.broadcast_to(np.eye(3), (len(points), 3, 3)), lever)
    moved = np.zeros((len(points), 3, len(scales)))  # derivatives of points in the world
    moved[:, :, :6] = by_twist * scales[:6]
    for j, step in enumerate(steps if points is not given.points else ()):
        by_step = unknown.points(given.points, values + step) - points
        moved[:, :, p + j] = by_step @ T[:3, :3].T / _STEP
    parts, columns = [np.zeros(0)], [np.zeros((0, len(scales)))]
    for match in given.frames[f]:
        x, by_state = world[match.features], moved[match.features]
        if p > 6:
            by_velocity = by_twist[match.features] * match.seconds[:, None, None]
            x, by_state[:, :, 6:p] = x + by_velocity @ state[6:p], by_velocity * scales[6:p]
        sensor = unknown.sensor(match.name, given.sensors[match.name], values)
        y, J, visible = sensor.linearise(x)
        rows = J @ by_state
        for j, step in enumerate(steps if sensor is not given.sensors[match.name] else ()):
            other = unknown.sensor(match.name, given.sensors[match.name], values + step)
            rows[:, :, p + j] += np.where(visible[:, None], other.project(x)[0] - y, 0.0) / _STEP
        offsets, noise = np.where(visible[:, None], y - match.observed, 0.0), match.noise[:, None]
        parts.append((offsets / noise).ravel())
        columns.append((rows / noise[..., None]).reshape(-1, len(scales)))
    return np.concatenate(parts), np.concatenate(columns)


def unknowns(session: Session) -> Iterator[Unknown]:
    """Yield the values that may be off, the simplest first."""
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
    bare = [name for name, lens in lenses.items() if not np.any(lens.distortion)]
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
    """Return two coefficients of distortion for each camera that has none."""
    return Unknown(
        f"distortion of {quoted(names)} {{is}} left out",
        lambda v: "with two coefficients k1 and k2 for each lens",
        np.full(2 * len(names), _BENT),
        sensors={n: partial(_bent, chosen=slice(2 * k, 2 * k + 2)) for k, n in enumerate(names)},
        cost=-_LEFT_OUT,
    )


def _calibration(setup: SensorSetup, cameras: Sequence[SensorSetup]) -> Unknown:
    """Return focal length, principal point and two coefficients of distortion of a camera."""
    camera: Any = setup.sensor
    given = camera.camera_matrix
    others: dict[str, Any] = {s.name: s.sensor for s in cameras if s is not setup}
    twins = [
        name
        for name, other in others.items()
        if np.array_equal(given, other.camera_matrix)
        and np.array_equal(camera.distortion, other.distortion)
        and np.any(camera.distortion)
    ]
    centre = _CENTRE * 2 * float(given[0, 2])

    def corrected(sensor: Any, v: Floats) -> Any:
        K = np.array(sensor.camera_matrix)
        K[:2, :2] *= 1 + v[0]
        K[:2, 2] += v[1:3]
        return replace(_bent(sensor, v, slice(3, None)), camera_matrix=K)

    def remedy(v: Floats) -> str:
        changed = corrected(camera, v)
        K, k = changed.camera_matrix, changed.distortion[:2]
        return (
            f"with about fx = {K[0, 0]:.5g}, cx = {K[0, 2]:.4g}, cy = {K[1, 2]:.4g}, "
            f"k1 = {k[0]:.2g}, k2 = {k[1]:.2g}{moved}"
        )

    moved = " (or it was moved: mixpose calibrate --check tells)" * bool(others)
    is_copied = len(twins) == 1  # with more, cameras of one kind may share a nominal calibration
    copied = f", but that of {twins[0]!r}" if is_copied else ""
    return Unknown(
        f"the calibration of {setup.name!r} {{is}} not that of its images{copied}",
        remedy,
        np.array([_FOCAL, centre, centre, _BENT, _BENT]),
        sensors={setup.name: corrected},
        cost=-_COPIED if is_copied else 0.0,
    )


def _bent(sensor: Any, v: Floats, chosen: slice) -> Any:
    """Return a camera with k1 and k2 changed by two values, in relative shifts of the corners."""
    K = sensor.camera_matrix
    squared = float((K[:2, 2] / K[[0, 1], [0, 1]]) @ (K[:2, 2] / K[[0, 1], [0, 1]]))
    k = np.zeros(max(len(sensor.distortion), 4))
    k[: len(sensor.distortion)] = sensor.distortion
    k[:2] += v[chosen] / [squared, squared**2]
    return replace(sensor, distortion=k)
