"""Sensors perturbed by errors of their calibration, and the shifts of points that these cause."""

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
    """Standard deviations of the calibrated parameters of a sensor."""

    focal: float = 0.0  # of the focal length, as a share; of the pixel size, with parallel beams
    principal_point: float = 0.0  # along each axis, px
    rotation_deg: float = 0.0  # of the orientation, about each axis
    position: float = 0.0  # along each axis, length units
    range_bias: float = 0.0  # length units


def perturbed(sensor: Sensor, error: CalibrationError) -> tuple[Sensor, ...]:
    """Return a sensor, and copies of it, each with one parameter off by a standard deviation."""
    copies: list[Sensor] = []
    turn = np.radians(error.rotation_deg)
    if isinstance(sensor, RangeSensor):
        biased = replace(sensor, range_bias=sensor.range_bias + error.range_bias)
        copies, turn = [biased] if error.range_bias else [], 0.0
    if isinstance(sensor, PinholeCamera | FisheyeCamera):
        for row in (0, 1) if error.principal_point else ():
            K = sensor.camera_matrix.copy()
            K[row, 2] += error.principal_point
            copies.append(replace(sensor, camera_matrix=K))
        K = sensor.camera_matrix.copy()
        K[:2, :2] *= 1 + error.focal
        copies += [replace(sensor, camera_matrix=K)] if error.focal else []
    if isinstance(sensor, ParallelBeam):
        for axis in np.eye(2) if error.principal_point else ():
            point = sensor.principal_point + error.principal_point * axis
            copies.append(replace(sensor, principal_point=point))
        size = sensor.pixel_size / (1 + error.focal)
        copies += [replace(sensor, pixel_size=size)] if error.focal else []
    T = np.asarray(getattr(sensor, "T_sensor_world", np.eye(4)))
    steps = [(k, turn) for k in (3, 4, 5)] + [(k, error.position) for k in range(3)]
    return (sensor, *copies, *(sensor.moved(_moved(T, k, by)) for k, by in steps if by))


def _moved(T_sensor_world: Floats, direction: int, by: float) -> Floats:
    """Return the world motion (4, 4) equal to a sensor's motion along or about one of its axes."""
    twist = np.zeros(6)
    twist[direction] = by
    return np.asarray(inverse(T_sensor_world) @ perturb(np.eye(4), twist) @ T_sensor_world)


def lens_shifts(sensors: tuple[Sensor, ...], k1: float, points_world: Floats) -> Floats:
    """Return shifts (L, n, 2) of projected points (n, 3) if radial coefficients are `k1` larger."""
    L, (y, _, seen) = len(sensors), _with_other_lenses(sensors, k1).linearise(points_world)
    return np.where((seen[:L] & seen[L:])[..., None], y[L:] - y[:L], 0.0)


@lru_cache(maxsize=64)
def _with_other_lenses(sensors: tuple[Sensor, ...], k1: float) -> SensorBatch:
    """Return a batch of sensors, then of the same with a first radial coefficient `k1` larger."""
    changed = list(sensors)
    for k, sensor in enumerate(sensors):
        if isinstance(sensor, PinholeCamera | FisheyeCamera):
            distortion = np.ravel(sensor.distortion)
            distortion = np.pad(distortion, (0, max(4 - len(distortion), 0)))
            distortion[0] += k1
            changed[k] = replace(sensor, distortion=distortion)
    return side_by_side((*sensors, *changed))


def calibration_shifts(sensors: tuple[Sensor, ...], points_world: Floats) -> Floats:
    """Return shifts (n, m, K) of points (n, 3) in K copies of a sensor, as of `perturbed`."""
    sensor, *copies = sensors
    y, seen = sensor.project(points_world)
    shifts = np.zeros((*y.shape, len(copies)))
    for k, copy in enumerate(copies):
        y_copy, seen_by_copy = copy.project(points_world)
        shifts[..., k] = np.where((seen & seen_by_copy)[..., None], y_copy - y, 0.0)
    return shifts
