"""Sensors: from world points to sensor coordinates, with Jacobians.

A new kind of sensor is one file beside these and one line in `SENSOR_MODELS`.
"""

from __future__ import annotations

from mixpose.sensors.bank import Bank, bank
from mixpose.sensors.base import OUTSIDE, Sensor
from mixpose.sensors.fisheye import FisheyeCamera
from mixpose.sensors.lateration import RangeSensor
from mixpose.sensors.motion import moved_against
from mixpose.sensors.parallel import ParallelBeam
from mixpose.sensors.pinhole import PinholeCamera

SENSOR_MODELS: dict[str, type[Sensor]] = {
    "pinhole": PinholeCamera,
    "fisheye": FisheyeCamera,
    "parallel": ParallelBeam,
    "lateration": RangeSensor,
}

__all__ = [
    "OUTSIDE",
    "SENSOR_MODELS",
    "Bank",
    "FisheyeCamera",
    "ParallelBeam",
    "PinholeCamera",
    "RangeSensor",
    "Sensor",
    "bank",
    "moved_against",
]
