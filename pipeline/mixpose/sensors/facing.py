"""Which features turn their face to a sensor."""

from __future__ import annotations

import numpy as np

from mixpose.records import Floats, Mask
from mixpose.sensors.base import Sensor
from mixpose.sensors.cloud import CloudPlane, CloudSensor


def facing(
    sensor: Sensor,
    T_world_object: Floats,
    points_world: Floats,
    normals: Floats | None,
    edge_on: float = 0.0,
) -> Mask:
    """Which features (..., n, 3) turn their face to a sensor: (..., n), true without normals.

    Normals (n, 3) are in the object's frame, poses (..., 4, 4). In images a feature is `edge_on`
    from that cosine of the angle to its normal; ranges are measured from all of its front. All
    features face a cloud, whose system sees them from several sides.
    """
    if normals is None or isinstance(sensor, CloudPlane | CloudSensor):
        return np.ones(points_world.shape[:-1], dtype=np.bool_)
    outward = normals @ np.swapaxes(T_world_object[..., :3, :3], -1, -2)
    towards = sensor.towards(points_world)
    cosines = np.vecdot(outward, towards) / np.linalg.norm(towards, axis=-1)
    return np.asarray(cosines > (edge_on if sensor.dimension > 1 else 0.0))
