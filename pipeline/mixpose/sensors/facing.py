"""Which features turn their face to a sensor."""

from __future__ import annotations

import numpy as np

from mixpose.records import Floats, Mask
from mixpose.sensors.base import Sensor
from mixpose.sensors.cloud import CloudPlane, CloudSensor


def facing(
    sensor: Sensor, T_world_object: Floats, points_world: Floats, normals: Floats | None
) -> Mask:
    """Which features (..., n, 3) turn their face to a sensor: (..., n), true without normals.

    Normals (n, 3) are in the object's frame, poses (..., 4, 4).  All features face a cloud, whose
    system sees them from several sides.
    """
    if normals is None or isinstance(sensor, CloudPlane | CloudSensor):
        return np.ones(points_world.shape[:-1], dtype=np.bool_)
    outward = normals @ np.swapaxes(T_world_object[..., :3, :3], -1, -2)
    return np.asarray((outward * sensor.towards(points_world)).sum(axis=-1) > 0)
