"""Lines of sight: where in space the features that a sensor detected may be."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from mixpose.records import Floats, Mask
from mixpose.rigid import inverse

_WORST_ROUND_TRIP = 1.0  # px between a detection and its ray projected again


@dataclass(frozen=True)
class Rays:
    """Half-lines (lines, for parallel beams) in the world, one per detection.

    A px covers ``offset + slope * d`` of length across the ray at a distance d from its origin.
    """

    origins: Floats  # (M, 3) centre of projection, or a point on the sensor's plane
    directions: Floats  # (M, 3) unit vectors away from the sensor
    pixels: Floats  # (M, 2) the detections
    central: bool  # whether all start at one centre, in front of which alone the camera sees
    offset: float
    slope: float
    # Of lines that images of one cloud of points give: the same for each of its images, in which
    # the lines of one point have the same number.
    cloud: object = None

    def __len__(self) -> int:
        return len(self.origins)

    def select(self, chosen: NDArray[Any]) -> Rays:
        """The rays of some detections."""
        return replace(
            self,
            origins=self.origins[chosen],
            directions=self.directions[chosen],
            pixels=self.pixels[chosen],
        )


class CentralCamera(Protocol):
    """What rays through one centre ask of a camera."""

    @property
    def T_sensor_world(self) -> Floats:
        """Where it stands (4, 4)."""
        ...

    @property
    def camera_matrix(self) -> Floats:
        """Its intrinsics (3, 3)."""
        ...

    def project(self, points_world: Floats) -> tuple[Floats, Mask]:
        """Pixels (M, 2) of points (M, 3), and which it sees."""
        ...


def central_rays(camera: CentralCamera, pixels: Floats, directions: Floats) -> Rays:
    """Rays through the centre of projection, along directions (M, 3) in the camera's axes.

    Detections outside of what the lens model explains are left out.
    """
    T_world_sensor = inverse(camera.T_sensor_world)
    directions = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    directions = directions @ T_world_sensor[:3, :3].T
    origin = T_world_sensor[:3, 3]
    focal = float(np.sqrt(abs(np.linalg.det(camera.camera_matrix[:2, :2]))))
    rays = Rays(np.tile(origin, (len(pixels), 1)), directions, pixels, True, 0.0, 1.0 / focal)
    again, visible = camera.project(origin + directions)
    error = np.linalg.norm(again - pixels, axis=1)
    return rays.select(visible & (error < _WORST_ROUND_TRIP))
