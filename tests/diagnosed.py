"""What cameras of a session would see, and what is told of a session that says something else."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from mixpose.body import Body, PointFeature
from mixpose.checking.trials import diagnosis
from mixpose.density import Observation
from mixpose.objective import View
from mixpose.records import PointPattern
from mixpose.rigid import from_rotation_vector, inverse, transform
from mixpose.sensors import PinholeCamera
from mixpose.session import Session

SIGMA, NOISE = 1.5, 0.1
Frames = list[tuple[int, list[View]]]


def poses() -> list[np.ndarray]:
    rng = np.random.default_rng(4)
    return [
        from_rotation_vector(rng.normal(0, 1, 3), rng.normal([10, -8, 5], 25)) for _ in range(4)
    ]


def recorded(session: Session) -> dict[str, list[np.ndarray]]:
    """What the cameras of a session see, shuffled."""
    rng = np.random.default_rng(5)
    seen: dict[str, list[np.ndarray]] = {}
    for setup in session.sensors:
        for T in poses():
            y, visible = setup.sensor.project(transform(T, session.body.means))
            if session.body.normals is not None:
                world = transform(T, session.body.means)
                towards = setup.sensor.towards(world)
                facing = ((session.body.normals @ T[:3, :3].T) * towards).sum(axis=1) > 0
                visible = visible & facing
            y = y[visible] + rng.normal(0, NOISE, y[visible].shape)
            seen.setdefault(setup.name, []).append(rng.permutation(y))
    return seen


def frames_of(session: Session, seen: dict[str, list[np.ndarray]]) -> Frames:
    """The same as a session takes it for."""
    count = len(next(iter(seen.values())))
    return [
        (
            f,
            [
                View(setup.name, setup.sensor, Observation(of_points(seen[setup.name][f]), SIGMA))
                for setup in session.sensors
            ],
        )
        for f in range(count)
    ]


def of_points(points: np.ndarray) -> PointPattern:
    return PointPattern(points, np.ones(len(points)))


def with_points(session: Session, points: np.ndarray, normals: Any = None) -> Session:
    body = Body(session.body.name, tuple(PointFeature(p) for p in points), normals)
    return replace(session, body=body)


def with_cameras(session: Session, change: Callable[[Any], Any]) -> Session:
    setups = [replace(s, sensor=change(s.sensor)) for s in session.sensors]
    return replace(session, sensors=tuple(setups))


def enlarged(sensor: PinholeCamera) -> PinholeCamera:
    return replace(sensor, camera_matrix=sensor.camera_matrix * [[0.5], [0.5], [1.0]])


def inverted(sensor: PinholeCamera) -> PinholeCamera:
    return replace(sensor, T_sensor_world=inverse(sensor.T_sensor_world))


def bare(sensor: PinholeCamera) -> PinholeCamera:
    return replace(sensor, distortion=np.zeros(0))


def told(session: Session, seen: dict[str, list[np.ndarray]]) -> str:
    return diagnosis(session, frames_of(session, seen)).change
