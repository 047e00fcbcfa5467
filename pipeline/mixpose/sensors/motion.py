"""Sensors seen from a world that moves."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mixpose.sensors.base import Floats, Sensor
from mixpose.sensors.fisheye import FisheyeCamera
from mixpose.sensors.lateration import RangeSensor
from mixpose.sensors.parallel import ParallelBeam
from mixpose.sensors.pinhole import PinholeCamera


def moved_against(sensor: Sensor, motion: Floats) -> Sensor:
    """The sensor that measures of points x what the given one measures of `motion` x.

    Parameters
    ----------
    sensor : Sensor
    motion : (4, 4) array
        A rigid motion of the world.

    Raises
    ------
    TypeError
        If the kind of sensor is not known here.
    """
    if isinstance(sensor, PinholeCamera | FisheyeCamera | ParallelBeam):
        return replace(sensor, T_sensor_world=sensor.T_sensor_world @ motion)
    if isinstance(sensor, RangeSensor):
        # distances stay when the source moves back in place of the points
        position = motion[:3, :3].T @ (sensor.position - motion[:3, 3])
        return replace(sensor, position=np.asarray(position))
    raise TypeError(f"{type(sensor).__name__} is no kind of sensor that can be moved")
