"""Changes that would improve a system: a moved marker, one more sensor, or less noise."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np
from scipy.optimize import brentq

from mixpose.body import Body, PointFeature
from mixpose.design.prediction import Plan
from mixpose.records import Floats
from mixpose.rigid import from_parts
from mixpose.sensors import FisheyeCamera, ParallelBeam, PinholeCamera, RangeSensor, Sensor

ErrorOf: TypeAlias = Callable[[Plan], float]

_STEP = 0.25  # of the body's radius
_PLACES = 60  # for one more sensor, all around
_WIDEST = 1e4  # largest factor on the noise: nobody would build a system beyond it


@dataclass(frozen=True)
class MarkerMove:
    """A marker that is moved."""

    marker: int  # from 0
    shift: Floats  # (3,): in the object's frame
    error: float  # with the marker moved


@dataclass(frozen=True)
class NewSensor:
    """One more sensor, a copy of an existing one."""

    like: str  # name of the sensor that it copies
    sensor: Sensor
    error: float  # with the new sensor


def best_marker_move(plan: Plan, error_of: ErrorOf) -> MarkerMove | None:
    """Find the marker whose move by a quarter of the body's radius leaves the least error.

    Returns None if no move helps, or features are no points.
    """
    if not all(isinstance(feature, PointFeature) for feature in plan.body.features):
        return None
    best: MarkerMove | None = None
    least = error_of(plan)
    for marker in range(len(plan.body)):
        for direction in _directions(26):
            shift = _STEP * plan.body.radius * direction
            error = error_of(replace(plan, body=_with_marker_moved(plan.body, marker, shift)))
            if error < least:
                best, least = MarkerMove(marker, shift, error), error
    return best


def best_new_sensor(plan: Plan, error_of: ErrorOf, middle: Floats) -> NewSensor | None:
    """Find the place around the body where a copy of a sensor leaves the least error.

    It looks at the middle (3,) of the volume from its original's distance.  None if no place helps.
    """
    best: NewSensor | None = None
    least = error_of(plan)
    kinds: dict[tuple[type, float], int] = {}
    for k, sensor in enumerate(plan.sensors):
        kinds.setdefault((type(sensor), plan.noises[k]), k)
    for k in kinds.values():
        for direction in _directions(_PLACES):
            copy = _copy_at(plan.sensors[k], middle, direction)
            if copy is None:
                continue
            extended = replace(
                plan,
                names=(*plan.names, "new"),
                sensors=(*plan.sensors, copy),
                noises=(*plan.noises, plan.noises[k]),
                sigmas=(*plan.sigmas, plan.sigmas[k]),
            )
            error = error_of(extended)
            if error < least:
                best, least = NewSensor(plan.names[k], copy, error), error
    return best


def _with_marker_moved(body: Body, marker: int, shift: Floats) -> Body:
    features = list(body.features)
    feature = features[marker]
    assert isinstance(feature, PointFeature), "others are not moved"
    features[marker] = replace(feature, position=np.asarray(feature.position) + shift)
    return replace(body, features=tuple(features))


def _directions(count: int) -> Floats:
    """Return unit vectors (count, 3) spread evenly over the sphere, by the golden angle."""
    k = np.arange(count) + 0.5
    height = 1 - 2 * k / count
    around = np.pi * (1 + np.sqrt(5)) * k
    across = np.sqrt(1 - height**2)
    return np.array([across * np.cos(around), across * np.sin(around), height]).T


def _copy_at(sensor: Sensor, middle: Floats, direction: Floats) -> Sensor | None:
    """Return a copy of a sensor in a direction from the middle, as far from it as the original."""
    if isinstance(sensor, RangeSensor):
        distance = np.linalg.norm(sensor.position - middle)
        return replace(sensor, position=middle + distance * direction)
    if not isinstance(sensor, PinholeCamera | FisheyeCamera | ParallelBeam):
        return None
    depth = float(sensor.T_sensor_world[2, :3] @ middle + sensor.T_sensor_world[2, 3])
    down = np.array([0.0, 0.0, -1.0]) if abs(direction[2]) < 0.9 else np.array([0.0, 1.0, 0.0])
    forward = -direction
    right = np.cross(down, forward)
    right /= np.linalg.norm(right)
    R = np.array([right, np.cross(forward, right), forward])
    seen_at = sensor.T_sensor_world[:3, :3] @ middle + sensor.T_sensor_world[:3, 3]
    if not isinstance(sensor, ParallelBeam):
        seen_at = np.array([0.0, 0.0, abs(depth)])
    return replace(sensor, T_sensor_world=from_parts(R, seen_at - R @ middle))


def noise_to_equal(plan: Plan, wanted: float, error_of: ErrorOf) -> float | None:
    """Return the factor on all noises of a plan with which its error, which grows, is as wanted.

    None if errors of markers alone are too large, or no factor is large enough.
    """

    def excess(log_factor: float) -> float:
        return float(np.log(error_of(scaled(plan, float(np.exp(log_factor)))) / wanted))

    low, high = -np.log(_WIDEST), np.log(_WIDEST)
    if not (np.isfinite(wanted) and np.isfinite(error_of(plan))):
        return None
    if excess(low) > 0 or excess(high) < 0:
        return None
    return float(np.exp(brentq(excess, low, high, xtol=1e-10)))


def scaled(plan: Plan, factor: float) -> Plan:
    """Return the plan with noises and sigmas multiplied by a factor."""
    noises, sigmas = (tuple(factor * x for x in values) for values in (plan.noises, plan.sigmas))
    return replace(plan, noises=noises, sigmas=sigmas)
