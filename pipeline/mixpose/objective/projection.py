"""A body in several sensors at once, at one pose or many.

Arrays have the sensors first, then the poses: places y (L, H, n, 2), Jacobians J (L, H, n, 2, 6).
Sensors of one coordinate have 0 as their second.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from mixpose.body import Body
from mixpose.objective.markers import MarkerBatch
from mixpose.records import Floats, Mask
from mixpose.sensors import Sensor, facing, side_by_side


class Projected(NamedTuple):
    """A body in L sensors at H poses."""

    y: Floats  # (L, H, n, 2)
    J: Floats  # (L, H, n, 2, 6) by the twist of the pose; zero where a feature is not visible
    seen: Mask  # (L, H, n) in view, and facing the sensor where normals are known
    faced: Mask  # (L, H, n) facing the sensor, in view or not
    weights: Floats  # (L, H, n) zero where a feature is not seen


class BodyProjection:
    """Sensors that look at a body; made once for the same ones by `project_body`.

    `dimensions` (L,) are m, the coordinates of each sensor.
    """

    def __init__(self, sensors: Sequence[Sensor], body: Body) -> None:
        self.sensors = tuple(sensors)
        self.body = body
        self.dimensions = np.array([sensor.dimension for sensor in sensors])
        self._points = body.nodes.points
        self._weights = body.nodes.weights
        self._normals = body.node_normals
        self._batch = side_by_side(self.sensors)
        sized = body.node_radii is not None and bool(body.node_radii.any())
        self._markers = MarkerBatch(self.sensors, body, self._batch) if sized else None

    def project(self, poses: Floats) -> Projected:
        """Where the sensors see the body at poses (H, 4, 4)."""
        H, n, L = len(poses), self._points.shape[-2], len(self.sensors)
        arms = self._points @ poses[:, :3, :3].swapaxes(1, 2)
        world = (arms + poses[:, None, :3, 3]).reshape(-1, 3)
        if self._markers is None:
            y, by_world, visible = self._batch.linearise(world)
        else:
            y, by_world, visible = self._markers.linearise(poses, world)
        J = pose_jacobian(by_world, arms.reshape(-1, 3)).reshape(L, H, n, 2, 6)
        seen = visible.reshape(L, H, n)
        if self._normals is None:
            faced = np.ones(seen.shape, dtype=np.bool_)
        else:
            points = world.reshape(H, n, 3)
            each = [facing(one, poses, points, self._normals) for one in self.sensors]
            faced = np.array(each)
            seen &= faced
        return Projected(y.reshape(L, H, n, 2), J, seen, faced, self._weights * seen)


@lru_cache(maxsize=64)
def project_body(sensors: tuple[Sensor, ...], body: Body) -> BodyProjection:
    """The projection of a body into sensors, which are the same objects from frame to frame."""
    return BodyProjection(sensors, body)


def in_image(spreads: Floats, J: Floats) -> Floats:
    """How far features are off in a sensor's coordinates, mean variance along one (..., n).

    For covariances (..., n, 3, 3) in the world, and J (..., n, m, 6) in a sensor's m coordinates.
    """
    by_world = J[..., :3]
    total = np.einsum("...nmi,...nij,...nmj->...n", by_world, spreads, by_world)
    return np.asarray(total / J.shape[-2])


def pose_jacobian(by_world: Floats, arms: Floats) -> Floats:
    """Chain Jacobians (..., n, m, 3) by world points into (..., n, m, 6) by the pose's twist.

    A turn ω about the object's origin moves an arm x = R z, one of (..., n, 3), by ω × x, and
    a · (ω × x) = ω · (x × a).
    """
    J = np.empty((*by_world.shape[:-1], 6))
    x, y, z = arms[..., 0, None], arms[..., 1, None], arms[..., 2, None]
    a, b, c = by_world[..., 0], by_world[..., 1], by_world[..., 2]
    J[..., :3] = by_world
    J[..., 3] = y * c - z * b
    J[..., 4] = z * a - x * c
    J[..., 5] = x * b - y * a
    return J
