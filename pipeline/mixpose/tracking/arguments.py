"""Check the arguments of Python callers: arrays of wrong shape or content are errors."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from mixpose.body import Body
from mixpose.objective import View
from mixpose.records import Floats
from mixpose.rigid import is_rigid

_RIGID = "a rotation and a translation as one 4x4 matrix"


def start_pose(start: Any) -> Floats | None:
    """Return a start as a pose (4, 4), or None; raise ValueError if it is not rigid."""
    if start is None:
        return None
    T = np.asarray(start, dtype=np.float64)
    if not is_rigid(T):
        raise ValueError(f"start: not {_RIGID}")
    return T


def require_valid(views: Sequence[View], model: Body) -> None:
    """Raise a ValueError that says what is wrong with views or a body, and what is allowed."""
    if not views:
        raise ValueError(
            "views: found none; allowed: one or more, also of sensors that saw nothing"
        )
    for number, feature in enumerate(model.features, 1):
        where = f"feature {number} of {model.name!r}"
        if not hasattr(feature, "nodes"):
            raise ValueError(f"{where}: found {type(feature).__name__}; allowed: a PointFeature")
        spread = np.asarray(feature.covariance)
        _require(feature.mean, (3,), f"{where}, its position")
        _require(spread, (3, 3), f"{where}, its covariance")
        if np.linalg.eigvalsh(spread)[0] < -1e-9 * np.abs(spread).max():
            raise ValueError(f"{where}: a covariance with a variance below zero")
    if len(model.features) > 1 and not np.ptp(model.means, axis=0).any():
        raise ValueError(f"body {model.name!r}: all features are at one place")
    names = [view.name for view in views]
    if doubled := {name for name in names if names.count(name) > 1}:
        raise ValueError(f"view {min(doubled)!r}: given twice; allowed: a name of its own for each")
    for view in views:
        where, sensor = f"view {view.name!r}", view.sensor
        seen, allowed = view.observation.dimension, sensor.dimension
        if seen != allowed:
            raise ValueError(f"{where}: features of {seen} coordinates; its sensor has {allowed}")
        for name, shape in (("camera_matrix", (3, 3)), ("position", (3,)), ("distortion", None)):
            if hasattr(sensor, name):
                _require(getattr(sensor, name), shape, f"{where}, {name} of its sensor")
        if min(getattr(sensor, "resolution", None) or (1,)) < 1:
            raise ValueError(f"{where}, resolution of its sensor: allowed: pixels, 1 or more")
        if not is_rigid(getattr(sensor, "T_sensor_world", np.eye(4))):
            raise ValueError(f"{where}, T_sensor_world of its sensor: not {_RIGID}")


def _require(values: Any, shape: tuple[int, ...] | None, what: str) -> None:
    """Raise a ValueError unless an array is finite and of a shape, if one is given."""
    array = np.asarray(values, dtype=np.float64)
    shape = array.shape if shape is None else shape
    if array.shape != shape or not np.isfinite(array).all():
        actual = f"shape {array.shape}" if array.shape != shape else "NaN or infinity"
        raise ValueError(f"{what}: found {actual}; allowed: finite numbers of shape {shape}")
