"""Sensors: maps from world points to sensor coordinates, with Jacobians.

A new kind of sensor needs a module in this package and a line in `SENSOR_MODELS`.
"""

from __future__ import annotations

from mixpose.sensors.base import (
    OUTSIDE as OUTSIDE,
    AffineSensor as AffineSensor,
    Rays as Rays,
    Sensor as Sensor,
    hide as hide,
)
from mixpose.sensors.batch import SensorBatch as SensorBatch
from mixpose.sensors.cloud import (
    PLANES as PLANES,
    CloudPlane as CloudPlane,
    CloudSensor as CloudSensor,
    as_images as as_images,
    clouds_among as clouds_among,
    facing as facing,
    from_planes as from_planes,
)
from mixpose.sensors.fisheye import FisheyeCamera as FisheyeCamera
from mixpose.sensors.lateration import RangeSensor as RangeSensor
from mixpose.sensors.moving import (
    Motion as Motion,
    RollingSensor as RollingSensor,
    in_motion as in_motion,
    read_times as read_times,
    side_by_side as side_by_side,
)
from mixpose.sensors.parallel import ParallelBeam as ParallelBeam
from mixpose.sensors.perturbed import (
    CalibrationError as CalibrationError,
    calibration_shifts as calibration_shifts,
    lens_shifts as lens_shifts,
    perturbed as perturbed,
)
from mixpose.sensors.pinhole import PinholeCamera as PinholeCamera

SENSOR_MODELS: dict[str, type[Sensor]] = {
    "pinhole": PinholeCamera,
    "fisheye": FisheyeCamera,
    "parallel": ParallelBeam,
    "lateration": RangeSensor,
    "cloud": CloudSensor,
}
