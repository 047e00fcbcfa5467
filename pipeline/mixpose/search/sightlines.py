"""Lines of sight: where in space the features that a camera detected may be."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from mixpose.rigid import inverse
from mixpose.sensors import FisheyeCamera, ParallelBeam, PinholeCamera, Sensor

Floats: TypeAlias = NDArray[np.float64]

_WORST_ROUND_TRIP = 1.0  # px between a detection and its line of sight projected again


@dataclass(frozen=True)
class Sightlines:
    """Half-lines (lines, for parallel beams) in the world, one per detection.

    Attributes
    ----------
    origins : (M, 3) float64
        Centre of projection, or a point on the sensor's plane.
    directions : (M, 3) float64
        Unit vectors away from the sensor.
    pixels : (M, 2) float64
        The detections.
    central : bool
        Whether all lines meet in one centre, in front of which alone the camera sees.
    offset, slope : float
        Length that a px covers across the line at a distance d from its origin:
        ``offset + slope * d``.
    """

    origins: Floats
    directions: Floats
    pixels: Floats
    central: bool
    offset: float
    slope: float

    def __len__(self) -> int:
        return len(self.origins)

    def select(self, chosen: NDArray[Any]) -> Sightlines:
        """The lines of some detections."""
        return Sightlines(
            self.origins[chosen],
            self.directions[chosen],
            self.pixels[chosen],
            self.central,
            self.offset,
            self.slope,
        )


def sightlines(sensor: Sensor, pixels: Floats) -> Sightlines | None:
    """Lines of sight of detections (M, 2); None for sensors that have none.

    Detections outside of what the lens model explains are left out.
    """
    for kind, unproject in _UNPROJECT.items():
        if isinstance(sensor, kind):
            return unproject(sensor, pixels)
    return None


def _pinhole(camera: PinholeCamera, pixels: Floats) -> Sightlines:
    K = camera.camera_matrix
    # cv2 ignores skew, so that the camera matrix is taken off before
    distorted = (pixels - K[:2, 2]) @ np.linalg.inv(K[:2, :2]).T
    xy = distorted
    if camera.lens is not None:
        xy = cv2.undistortPoints(
            distorted.reshape(-1, 1, 2), np.eye(3), camera.lens.coefficients
        ).reshape(-1, 2)
    return _central(camera, pixels, xy)


def _fisheye(camera: FisheyeCamera, pixels: Floats) -> Sightlines:
    K = camera.camera_matrix
    distorted = (pixels - K[:2, 2]) @ np.linalg.inv(K[:2, :2]).T
    xy = cv2.fisheye.undistortPoints(distorted.reshape(-1, 1, 2), np.eye(3), camera.distortion)
    return _central(camera, pixels, np.asarray(xy, dtype=np.float64).reshape(-1, 2))


def _central(camera: PinholeCamera | FisheyeCamera, pixels: Floats, xy: Floats) -> Sightlines:
    T_world_sensor = inverse(camera.T_sensor_world)
    directions = np.concatenate([xy, np.ones((len(xy), 1))], axis=1)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    directions = directions @ T_world_sensor[:3, :3].T
    origin = T_world_sensor[:3, 3]
    focal = float(np.sqrt(abs(np.linalg.det(camera.camera_matrix[:2, :2]))))
    lines = Sightlines(
        np.tile(origin, (len(pixels), 1)), directions, pixels, True, 0.0, 1.0 / focal
    )
    again, visible = camera.project(origin + directions)
    error = np.linalg.norm(again - pixels, axis=1)
    return lines.select(visible & (error < _WORST_ROUND_TRIP))


def _parallel(camera: ParallelBeam, pixels: Floats) -> Sightlines:
    T_world_sensor = inverse(camera.T_sensor_world)
    across = (pixels - camera.principal_point) * camera.pixel_size
    origins = across @ T_world_sensor[:3, :2].T + T_world_sensor[:3, 3]
    directions = np.tile(T_world_sensor[:3, 2], (len(pixels), 1))
    return Sightlines(origins, directions, pixels, False, camera.pixel_size, 0.0)


_UNPROJECT: dict[type, Callable[[Any, Floats], Sightlines]] = {
    PinholeCamera: _pinhole,
    FisheyeCamera: _fisheye,
    ParallelBeam: _parallel,
}
