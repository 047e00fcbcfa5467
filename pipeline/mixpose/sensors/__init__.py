"""Sensors: from world points to sensor coordinates, with Jacobians.

A new kind of sensor is one file beside these and one line in `SENSOR_MODELS`.
"""

from __future__ import annotations

from mixpose.sensors.base import OUTSIDE, AffineSensor, Sensor
from mixpose.sensors.batch import SensorBatch
from mixpose.sensors.doubted import CalibrationError, by_calibration, doubted
from mixpose.sensors.facing import facing
from mixpose.sensors.fisheye import FisheyeCamera
from mixpose.sensors.lateration import RangeSensor
from mixpose.sensors.moving import Motion, RollingSensor, in_motion, moments, side_by_side
from mixpose.sensors.parallel import ParallelBeam
from mixpose.sensors.pinhole import PinholeCamera
from mixpose.sensors.rays import Rays

SENSOR_MODELS: dict[str, type[Sensor]] = {
    "pinhole": PinholeCamera,
    "fisheye": FisheyeCamera,
    "parallel": ParallelBeam,
    "lateration": RangeSensor,
}

__all__ = [
    "OUTSIDE",
    "SENSOR_MODELS",
    "AffineSensor",
    "CalibrationError",
    "FisheyeCamera",
    "Motion",
    "ParallelBeam",
    "PinholeCamera",
    "RangeSensor",
    "Rays",
    "RollingSensor",
    "Sensor",
    "SensorBatch",
    "by_calibration",
    "doubted",
    "facing",
    "in_motion",
    "moments",
    "side_by_side",
]
