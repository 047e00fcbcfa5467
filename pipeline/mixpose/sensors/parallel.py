"""The parallel-beam camera (orthographic), as in the paper's systems 1 and 2."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from mixpose.records import Floats, Mask
from mixpose.rigid import inverse
from mixpose.sensors.base import Rays, hide, within
from mixpose.sensors.camera import Camera


@dataclass(frozen=True, eq=False)
class ParallelBeam(Camera):
    """A camera without perspective: pixel = (x_s, y_s) / pixel_size + principal_point.

    The paper's rotated projections are ``x_s = cos γ x + sin γ y, y_s = z``.
    """

    pixel_size: float  # length per px
    principal_point: Floats  # (2,) where the sensor's origin projects, px
    resolution: tuple[int, int] | None = None  # width and height, px; None: unbounded
    T_sensor_world: Floats = field(default_factory=lambda: np.eye(4))  # (4, 4)

    def __post_init__(self) -> None:
        self._as_floats("principal_point", "T_sensor_world")

    @property
    def affine(self) -> Floats:
        """Matrix (2, 4) that maps homogeneous world points (x, y, z, 1) to pixels."""
        rows = self.T_sensor_world[:2] / self.pixel_size
        rows[:, 3] += self.principal_point
        return np.asarray(rows)

    def project(self, points_world: Floats) -> tuple[Floats, Mask]:
        """Return pixels (..., 2) of world points (..., 3), and which of them the camera sees."""
        T = self.T_sensor_world
        y = (points_world @ T[:2, :3].T + T[:2, 3]) / self.pixel_size + self.principal_point
        visible = within(y, self.lower, self.upper)
        hide(y, visible)
        return y, visible

    def linearise(self, points_world: Floats) -> tuple[Floats, Floats, Mask]:
        """Return pixels as `project`, their Jacobian (..., 2, 3), px per length, and the mask."""
        y, visible = self.project(points_world)
        J = np.empty((*y.shape, 3))
        J[...] = self.T_sensor_world[:2, :3] / self.pixel_size
        hide(y, visible, J)
        return y, J, visible

    def towards(self, points_world: Floats) -> Floats:
        """Return unit vectors (..., 3) against the beam, the same for all world points (..., 3)."""
        return np.broadcast_to(-self.T_sensor_world[2, :3], points_world.shape)

    def rays(self, y: Floats) -> Rays:
        """Return the parallel lines of sight of pixels (M, 2)."""
        T_world_sensor = inverse(self.T_sensor_world)
        across = (y - self.principal_point) * self.pixel_size
        origins = across @ T_world_sensor[:3, :2].T + T_world_sensor[:3, 3]
        directions = np.tile(T_world_sensor[:3, 2], (len(y), 1))
        return Rays(origins, directions, y, False, self.pixel_size, 0.0)
