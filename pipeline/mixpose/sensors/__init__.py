"""Sensors: from world points to sensor coordinates, with Jacobians.

A new kind of sensor is one file beside these and one line in `SENSOR_MODELS`.
"""

from __future__ import annotations

from mixpose.sensors.base import OUTSIDE, AffineSensor, Sensor
from mixpose.sensors.batch import SensorBatch
from mixpose.sensors.cloud import (
    PLANES,
    CloudPlane,
    CloudSensor,
    as_images,
    clouds_among,
    from_planes,
)
from mixpose.sensors.doubted import CalibrationError, by_calibration, doubted, with_another_lens
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
    "cloud": CloudSensor,
}

__all__ = [
    "OUTSIDE",
    "PLANES",
    "SENSOR_MODELS",
    "AffineSensor",
    "CalibrationError",
    "CloudPlane",
    "CloudSensor",
    "FisheyeCamera",
    "Motion",
    "ParallelBeam",
    "PinholeCamera",
    "RangeSensor",
    "Rays",
    "RollingSensor",
    "Sensor",
    "SensorBatch",
    "as_images",
    "by_calibration",
    "clouds_among",
    "doubted",
    "facing",
    "from_planes",
    "in_motion",
    "moments",
    "side_by_side",
    "with_another_lens",
]
