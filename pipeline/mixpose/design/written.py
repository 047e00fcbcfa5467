"""A plan as a session file, whose recordings are tables of detections."""

from __future__ import annotations

import json
from collections.abc import Iterable
from typing import Any

import numpy as np

from mixpose.body import Body, SegmentFeature
from mixpose.design.prediction import Plan
from mixpose.errors import SessionError
from mixpose.records import Floats
from mixpose.sensors import (
    FisheyeCamera,
    ParallelBeam,
    PinholeCamera,
    RangeSensor,
    Sensor,
)
from mixpose.session import Session


def plan_text(session: Session, plan: Plan, T_world_object: Floats) -> str:
    """The text of a session in which a plan's body starts at a pose.

    Raises
    ------
    SessionError
        If a kind of sensor or feature cannot be written.
    """
    free = [name for name, is_free in zip(_TWIST, plan.free, strict=True) if is_free]
    parts = [
        f'unit = "{session.unit}"',
        _body(plan.body),
        f"[start]\nT_world_object = {_toml(T_world_object)}",
        # every frame stands for itself: none is to profit from the one before
        f"[estimator]\nfuse = false\nfree = {_toml(free)}",
    ]
    rows = zip(plan.names, plan.sensors, plan.sigmas, strict=True)
    parts += [_sensor(name, sensor, sigma) for name, sensor, sigma in rows]
    return "\n\n".join(parts) + "\n"


_TWIST = ("x", "y", "z", "rx", "ry", "rz")


def _body(body: Body) -> str:
    points = [f for f in body.features if not isinstance(f, SegmentFeature)]
    segments = [[f.start, f.end] for f in body.features if isinstance(f, SegmentFeature)]
    lines = ["[object]", f"name = {_toml(body.name)}"]
    if points:
        lines.append(f"points = {_toml([f.mean for f in points])}")
    if segments:
        lines.append(f"segments = {_toml(segments)}")
    if body.covariances.any():
        lines.append(f"sigma = {_toml(list(body.covariances))}")
        lines.append(f"spread = {_toml(body.features[0].spread)}")
    if body.normals is not None:
        lines.append(f"normals = {_toml(body.normals)}")
    if body.gravity is not None:
        direction, sigma = _toml(body.gravity.direction), _toml(body.gravity.sigma)
        lines.append(f"gravity = {{ direction = {direction}, sigma = {sigma} }}")
    return "\n".join(lines)


def _sensor(name: str, sensor: Sensor, width: float) -> str:
    keys: dict[str, Any] = {"name": name}
    match sensor:
        case RangeSensor():
            keys |= {"model": "lateration", "position": sensor.position}
            keys |= {"range_bias": sensor.range_bias}
        case PinholeCamera() | FisheyeCamera():
            keys["model"] = "pinhole" if isinstance(sensor, PinholeCamera) else "fisheye"
            keys["camera_matrix"] = sensor.camera_matrix
            if sensor.distortion.size:
                keys["distortion"] = sensor.distortion
        case ParallelBeam():
            keys |= {"model": "parallel", "pixel_size": sensor.pixel_size}
            keys["principal_point"] = sensor.principal_point
        case _:
            raise SessionError(f"design: a {type(sensor).__name__} cannot be simulated")
    if not isinstance(sensor, RangeSensor):
        keys |= {"resolution": list(sensor.resolution or ()), "T_sensor_world": _T(sensor)}
    keys["source"] = f"{name}.csv"
    lines = [f"{key} = {_toml(value)}" for key, value in keys.items()]
    return "\n".join(["[[sensor]]", *lines, f"extract = {{ sigma = {_toml(width)} }}"])


def _T(sensor: PinholeCamera | FisheyeCamera | ParallelBeam) -> Floats:
    return sensor.T_sensor_world


def _toml(value: Any) -> str:
    """A value of TOML, numbers to the last bit."""
    if isinstance(value, np.ndarray):
        return _toml(value.tolist())
    if isinstance(value, list | tuple):
        return f"[{', '.join(_each(value))}]"
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False)
    return repr(value) if isinstance(value, int) else repr(float(value))


def _each(values: Iterable[Any]) -> Iterable[str]:
    return (_toml(value) for value in values)
