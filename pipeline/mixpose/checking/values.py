"""Values of a session that may be off: the body's size, lenses, poses of cameras, markers."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from mixpose.body import PointFeature
from mixpose.checking.adjusted import Unknown
from mixpose.checking.changes import OTHER_SIZE, called
from mixpose.records import Floats
from mixpose.rigid import perturb
from mixpose.sensors import PinholeCamera
from mixpose.session import SensorSetup, Session

_SIZE = 0.1  # deviations: of the body's size
_FOCAL, _CENTRE = 0.1, 0.05  # of the focal length, and of the image
_BENT = 0.1  # what a lens moves the corners of its image by, of their distance
_MOVED, _TURNED = 1.0, 0.1  # cameras, in radii of the body and rad
_MARKER = 0.05  # radii, that a marker is off: spots beside a hidden one are further
_LEFT_OUT = 6.0  # nats for distortion where none is given: lenses distort
_COPIED = 30.0  # nats for one of two cameras with the very same calibration: no two lenses have


def unknowns(session: Session) -> Iterator[Unknown]:
    """Values that may be off, those that few describe first."""
    cameras = [s for s in session.sensors if isinstance(s.sensor, PinholeCamera)]
    body = session.body
    are_points = all(isinstance(feature, PointFeature) for feature in body.features)
    if are_points and len(cameras) > 1:
        yield Unknown(
            OTHER_SIZE,
            lambda v: f"with points {1 + v[0]:.3g} times as large",
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
        name, radius = setup.name, body.radius
        yield Unknown(
            f"T_sensor_world of {name!r} {{is}} off",
            lambda v: (
                f"with it moved by {_length(v[:3]):.2g} {session.unit} and turned by "
                f"{np.degrees(_length(v[3:])):.2g} deg"
            ),
            np.array([_MOVED * radius] * 3 + [_TURNED] * 3),
            sensor=lambda own, sensor, v, name=name: (  # type: ignore[misc]
                replace(sensor, T_sensor_world=perturb(sensor.T_sensor_world, v))
                if own == name
                else sensor
            ),
        )


def _length(vector: Floats) -> float:
    return float(np.linalg.norm(vector))


def _markers(session: Session) -> Iterator[Unknown]:
    body = session.body
    for i, label in enumerate(body.labels):
        only = np.eye(len(body))[:, [i]]
        yield Unknown(
            f"marker {label} of [object] {{is}} measured wrong",
            lambda v, i=i: (
                f"with it {_length(v):.2g} {session.unit} away at "  # type: ignore[misc]
                f"{np.round(body.means[i] + v, 2).tolist()}"
            ),
            np.full(3, _MARKER * body.radius),
            points=lambda points, v, only=only: points + only * v,  # type: ignore[misc]
            feature=i,
        )


def _distortion(names: Sequence[str]) -> Unknown:
    """Two coefficients of each camera that has none."""

    def bent(name: str, sensor: Any, v: Floats) -> Any:
        k = names.index(name) if name in names else None
        return sensor if k is None else _bent(sensor, v[2 * k : 2 * k + 2])

    return Unknown(
        f"distortion of {called(names)} {{is}} left out",
        lambda v: "with two coefficients k1 and k2 for each lens",
        np.full(2 * len(names), _BENT),
        sensor=bent,
        cost=-_LEFT_OUT,
    )


def _calibration(setup: SensorSetup, cameras: Sequence[SensorSetup]) -> Unknown:
    """Focal length, principal point and two coefficients of the distortion of a camera."""
    camera: Any = setup.sensor
    given, name = camera.camera_matrix, setup.name
    others: dict[str, Any] = {each.name: each.sensor for each in cameras if each is not setup}
    twins = [
        other
        for other, each in others.items()
        if np.array_equal(given, each.camera_matrix)
        and np.array_equal(camera.distortion, each.distortion)
        and np.any(camera.distortion)
    ]
    centre = _CENTRE * 2 * float(given[0, 2])

    def matrix(K: Floats, v: Floats) -> Floats:
        changed = np.array(K)
        changed[:2, :2] *= 1 + v[0]
        changed[:2, 2] += v[1:3]
        return changed

    def other(own: str, sensor: Any, v: Floats) -> Any:
        if own != name:
            return sensor
        return replace(_bent(sensor, v[3:]), camera_matrix=matrix(sensor.camera_matrix, v))

    def remedy(v: Floats) -> str:
        K = matrix(given, v)
        return f"with about fx = {K[0, 0]:.5g}, cx = {K[0, 2]:.4g}, cy = {K[1, 2]:.4g}"

    copied = f", but that of {twins[0]!r}" if twins else ""
    return Unknown(
        f"the calibration of {name!r} {{is}} not that of its images{copied}",
        remedy,
        np.array([_FOCAL, centre, centre, _BENT, _BENT]),
        sensor=other,
        cost=-_COPIED if twins else 0.0,
    )


def _bent(sensor: Any, v: Floats) -> Any:
    """A camera whose lens moves the corners of its image by so much more, of their distance."""
    K = sensor.camera_matrix
    squared = float((K[:2, 2] / K[[0, 1], [0, 1]]) @ (K[:2, 2] / K[[0, 1], [0, 1]]))
    k = np.zeros(max(len(sensor.distortion), 4))
    k[: len(sensor.distortion)] = sensor.distortion
    k[:2] += v / [squared, squared**2]
    return replace(sensor, distortion=k)
