"""Base classes of cameras: pose, size of images and lines of sight.

Fields declared here are set by the dataclasses that inherit them.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property
from typing import Literal, Self

import numpy as np

from mixpose.records import Floats, Mask
from mixpose.rigid import inverse
from mixpose.sensors.base import Rays

_WORST_ROUND_TRIP = 1.0  # px between a detection and the projection of its ray


class PlacedSensor:
    """A sensor with a position and an orientation."""

    T_sensor_world: Floats  # (4, 4)

    def moved(self, motion: Floats) -> Self:
        """Return a sensor whose reading of points x is this one's of ``motion @ x``."""
        return replace(self, T_sensor_world=self.T_sensor_world @ motion)  # type: ignore[type-var]

    def _as_floats(self, *names: str) -> None:
        """Convert fields to arrays of float64."""
        for name in names:
            object.__setattr__(self, name, np.asarray(getattr(self, name), dtype=np.float64))


class Camera(PlacedSensor):
    """A sensor with images."""

    resolution: tuple[int, int] | None  # width and height, px; None: unbounded
    dimension = 2
    unit: Literal["px", "length"] = "px"

    @cached_property
    def lower(self) -> Floats:
        """Upper left corner (2,) of the image in pixel coordinates."""
        return np.full(2, -np.inf if self.resolution is None else -0.5)

    @cached_property
    def upper(self) -> Floats:
        """Lower right corner (2,) of the image in pixel coordinates."""
        if self.resolution is None:
            return np.full(2, np.inf)
        return np.asarray(self.resolution, dtype=np.float64) - 0.5


class CentralCamera(Camera):
    """A camera with perspective."""

    camera_matrix: Floats  # (3, 3)

    def project(self, points_world: Floats) -> tuple[Floats, Mask]:
        """Return pixels (..., 2) of world points (..., 3), and which of them the camera sees."""
        raise NotImplementedError

    def towards(self, points_world: Floats) -> Floats:
        """Return vectors (..., 3) from world points (..., 3) to the centre of projection."""
        centre = -self.T_sensor_world[:3, :3].T @ self.T_sensor_world[:3, 3]
        return np.asarray(centre - points_world)

    def _rays_along(self, directions: Floats, pixels: Floats) -> Rays:
        """Return rays along directions (M, 3), in camera axes, that project to their pixels."""
        T_world_sensor = inverse(self.T_sensor_world)
        directions = directions / np.linalg.norm(directions, axis=1, keepdims=True)
        directions = directions @ T_world_sensor[:3, :3].T
        origin = T_world_sensor[:3, 3]
        focal = float(np.sqrt(abs(np.linalg.det(self.camera_matrix[:2, :2]))))
        rays = Rays(np.tile(origin, (len(pixels), 1)), directions, pixels, True, 0.0, 1.0 / focal)
        projected, visible = self.project(origin + directions)
        error = np.linalg.norm(projected - pixels, axis=1)
        return rays.select(visible & (error < _WORST_ROUND_TRIP))
