"""Sensors as they might be, where their calibration is not exact."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from mixpose.records import Floats
from mixpose.rigid import inverse, perturb
from mixpose.sensors.base import Sensor
from mixpose.sensors.batch import SensorBatch, side_by_side
from mixpose.sensors.fisheye import FisheyeCamera
from mixpose.sensors.lateration import RangeSensor
from mixpose.sensors.parallel import ParallelBeam
from mixpose.sensors.pinhole import PinholeCamera


@dataclass(frozen=True)
class CalibrationError:
    """Standard deviations of what a calibration says of a sensor."""

    focal: float = 0.0  # of the focal length, as a share; of the pixel size, with parallel beams
    principal_point: float = 0.0  # along each axis, px
    rotation_deg: float = 0.0  # of the orientation, about each axis
    position: float = 0.0  # along each axis, length units
    range_bias: float = 0.0  # length units


def doubted(sensor: Sensor, error: CalibrationError) -> tuple[Sensor, ...]:
    """A sensor, and the same one off by a standard deviation in one thing each."""
    others: list[Sensor] = []
    turn = np.radians(error.rotation_deg)
    if isinstance(sensor, RangeSensor):
        biased = replace(sensor, range_bias=sensor.range_bias + error.range_bias)
        others, turn = [biased] if error.range_bias else [], 0.0
    if isinstance(sensor, PinholeCamera | FisheyeCamera):
        for row in (0, 1) if error.principal_point else ():
            K = sensor.camera_matrix.copy()
            K[row, 2] += error.principal_point
            others.append(replace(sensor, camera_matrix=K))
        K = sensor.camera_matrix.copy()
        K[:2, :2] *= 1 + error.focal
        others += [replace(sensor, camera_matrix=K)] if error.focal else []
    if isinstance(sensor, ParallelBeam):
        for axis in np.eye(2) if error.principal_point else ():
            point = sensor.principal_point + error.principal_point * axis
            others.append(replace(sensor, principal_point=point))
        size = sensor.pixel_size / (1 + error.focal)
        others += [replace(sensor, pixel_size=size)] if error.focal else []
    T = np.asarray(getattr(sensor, "T_sensor_world", np.eye(4)))
    steps = [(k, turn) for k in (3, 4, 5)] + [(k, error.position) for k in range(3)]
    return (sensor, *others, *(sensor.moved(_moved(T, k, by)) for k, by in steps if by))


def _moved(T_sensor_world: Floats, direction: int, by: float) -> Floats:
    """A motion (4, 4) of the world that is one of the sensor along or about an axis of its own."""
    twist = np.zeros(6)
    twist[direction] = by
    return np.asarray(inverse(T_sensor_world) @ perturb(np.eye(4), twist) @ T_sensor_world)


def by_lenses(sensors: tuple[Sensor, ...], k1: float, points_world: Floats) -> Floats:
    """By how much points (n, 3) are elsewhere (L, n, 2) with radial coefficients `k1` larger."""
    L, (y, _, seen) = len(sensors), _with_other_lenses(sensors, k1).linearise(points_world)
    return np.where((seen[:L] & seen[L:])[..., None], y[L:] - y[:L], 0.0)


@lru_cache(maxsize=64)
def _with_other_lenses(sensors: tuple[Sensor, ...], k1: float) -> SensorBatch:
    """Sensors, and these again, cameras with a first radial coefficient that is larger."""
    others = list(sensors)
    for k, sensor in enumerate(sensors):
        if isinstance(sensor, PinholeCamera | FisheyeCamera):
            given = np.ravel(sensor.distortion)
            distortion = np.pad(given, (0, max(4 - len(given), 0)))
            distortion[0] += k1
            others[k] = replace(sensor, distortion=distortion)
    return side_by_side((*sensors, *others))


def by_calibration(doubts: tuple[Sensor, ...], points_world: Floats) -> Floats:
    """By how much points (n, 3) are elsewhere (n, m, K) in K sensors as they might be."""
    first, *others = doubts
    y, seen = first.project(points_world)
    away = np.zeros((*y.shape, len(others)))
    for k, one in enumerate(others):
        other, also = one.project(points_world)
        away[..., k] = np.where((seen & also)[..., None], other - y, 0.0)
    return away
