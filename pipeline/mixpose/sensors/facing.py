"""Which features turn their face to a sensor."""

from __future__ import annotations

import numpy as np

from mixpose.records import Floats, Mask
from mixpose.sensors.base import Sensor
from mixpose.sensors.cloud import CloudPlane, CloudSensor


def facing(
    sensor: Sensor, T_world_object: Floats, points_world: Floats, normals: Floats | None
) -> Mask:
    """Which features turn their face to a sensor: (..., n), true where normals are not known.

    So they are in a cloud, whose system sees them from several sides.

    Parameters
    ----------
    sensor : Sensor
    T_world_object : (..., 4, 4) array
    points_world : (..., n, 3) array
    normals : (n, 3) array or None
        In the object's frame.
    """
    if normals is None or isinstance(sensor, CloudPlane | CloudSensor):
        return np.ones(points_world.shape[:-1], dtype=np.bool_)
    outward = normals @ np.swapaxes(T_world_object[..., :3, :3], -1, -2)
    return np.asarray((outward * sensor.towards(points_world)).sum(axis=-1) > 0)
