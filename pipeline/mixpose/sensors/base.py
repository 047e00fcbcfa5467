"""The interface of all sensors: a map from world points to measurements, with its Jacobian.

Conventions
-----------
* Sensor coordinates y have m numbers: pixels (u right, v down, pixel centres at integers) for
  cameras, one length for ranges.
* A sensor's frame looks along +z, x right, y down (OpenCV); ``x_sensor = T_sensor_world x_world``.
* A point that the sensor cannot measure (behind the camera, outside the image, beyond the range of
  the lens model) is marked invisible, its coordinates are `OUTSIDE` and its Jacobian is zero:
  values are finite everywhere, and the point has no influence on the pose.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal, Protocol, Self, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from mixpose.records import Floats, Mask

OUTSIDE = -1.0e6


@dataclass(frozen=True)
class Rays:
    """Half-lines (lines, for parallel beams) in the world, one per detection.

    A px is ``offset + slope * d`` wide, across the ray, at a distance d from its origin.
    """

    origins: Floats  # (M, 3) centre of projection, or a point on the sensor's plane
    directions: Floats  # (M, 3) unit vectors away from the sensor
    pixels: Floats  # (M, 2) the detections
    central: bool  # whether all start at one centre; only points in front of it are seen
    offset: float
    slope: float
    cloud: object = None  # token shared by the images of a cloud, whose rows are the same points

    def __len__(self) -> int:
        return len(self.origins)

    def select(self, chosen: NDArray[Any]) -> Rays:
        """Return the rays of the detections with these indices or this mask."""
        return replace(
            self,
            origins=self.origins[chosen],
            directions=self.directions[chosen],
            pixels=self.pixels[chosen],
        )


@runtime_checkable
class Sensor(Protocol):
    """A calibrated sensor: geometry only, no frames and no name."""

    @property
    def dimension(self) -> int:
        """m, the number of sensor coordinates."""

    @property
    def unit(self) -> Literal["px", "length"]:
        """Unit of the sensor coordinates."""

    @property
    def lower(self) -> Floats:
        """Smallest measurable coordinates (m,); minus infinity if unknown."""

    @property
    def upper(self) -> Floats:
        """Largest measurable coordinates (m,); infinity if unknown."""

    def project(self, points_world: Floats) -> tuple[Floats, Mask]:
        """Map world points (..., 3) to sensor coordinates (..., m) and a visibility mask (...)."""

    def linearise(self, points_world: Floats) -> tuple[Floats, Floats, Mask]:
        """Return coordinates as `project`, their Jacobian (..., m, 3) by points, and the mask."""

    def towards(self, points_world: Floats) -> Floats:
        """Return directions (..., 3) of any length from world points (..., 3) to the sensor."""

    def rays(self, y: Floats) -> Rays | None:
        """Return rays of detections (M, m) that a point can cause; None if the sensor has none."""

    def moved(self, motion: Floats) -> Self:
        """Return a sensor whose reading of x is this one's of ``motion @ x``, rigid (4, 4)."""


@runtime_checkable
class AffineSensor(Sensor, Protocol):
    """A sensor without perspective."""

    @property
    def affine(self) -> Floats:
        """Matrix (m, 4) that maps homogeneous world points (x, y, z, 1) to sensor coordinates."""


def within(y: Floats, lower: Floats, upper: Floats) -> Mask:
    """Test which coordinates (..., m) lie inside the bounds (m,)."""
    return np.asarray(np.all((y >= lower) & (y <= upper), axis=-1))


def hide(y: Floats, visible: Mask, J: Floats | None = None) -> None:
    """Set invisible points in place: coordinates to `OUTSIDE`, Jacobians to zero."""
    if visible.all():
        return
    y[~visible] = OUTSIDE
    if J is not None:
        J[~visible] = 0.0
