"""What every sensor is: a map from world points to what it measures, with its Jacobian.

Conventions
-----------
* Sensor coordinates y have m numbers: pixels (u right, v down, pixel centres at integers) for
  cameras, one length for ranges.
* A sensor's frame looks along +z, x right, y down (OpenCV); ``x_sensor = T_sensor_world x_world``.
* A point that the sensor cannot measure (behind the camera, outside the image, where the lens
  model no longer holds) is marked invisible, its coordinates are `OUTSIDE` and its Jacobian is
  zero: finite everywhere, on no sensor, and without pull on the pose.
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

    A px covers ``offset + slope * d`` of length across the ray at a distance d from its origin.
    """

    origins: Floats  # (M, 3) centre of projection, or a point on the sensor's plane
    directions: Floats  # (M, 3) unit vectors away from the sensor
    pixels: Floats  # (M, 2) the detections
    central: bool  # whether all start at one centre, in front of which alone the camera sees
    offset: float
    slope: float
    cloud: object = None  # the same for the images of one cloud, whose rows are the same points

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


@runtime_checkable
class Sensor(Protocol):
    """A calibrated sensor: geometry only, no frames and no name."""

    @property
    def dimension(self) -> int:
        """m, the number of sensor coordinates."""

    @property
    def unit(self) -> Literal["px", "length"]:
        """What the sensor coordinates count."""

    @property
    def lower(self) -> Floats:
        """Smallest measurable coordinates (m,); minus infinity where unknown."""

    @property
    def upper(self) -> Floats:
        """Largest measurable coordinates (m,); infinity where unknown."""

    def project(self, points_world: Floats) -> tuple[Floats, Mask]:
        """Map world points (..., 3) to sensor coordinates (..., m) and a visibility mask (...)."""

    def linearise(self, points_world: Floats) -> tuple[Floats, Floats, Mask]:
        """As `project`, with the Jacobian (..., m, 3) by world coordinates in between."""

    def towards(self, points_world: Floats) -> Floats:
        """Directions (..., 3) from world points (..., 3) to the sensor, of any length."""

    def rays(self, y: Floats) -> Rays | None:
        """Lines of sight of detections (M, m) that a point can cause; None if they leave none."""

    def moved(self, motion: Floats) -> Self:
        """The sensor that measures of x what this one does of ``motion @ x``, rigid (4, 4)."""


@runtime_checkable
class AffineSensor(Sensor, Protocol):
    """A sensor without perspective."""

    @property
    def affine(self) -> Floats:
        """Sensor coordinates as rows (m, 4) that are multiplied by (x, y, z, 1) in the world."""


def within(y: Floats, lower: Floats, upper: Floats) -> Mask:
    """Whether coordinates (..., m) lie inside the bounds (m,)."""
    return np.asarray(np.all((y >= lower) & (y <= upper), axis=-1))


def hide(y: Floats, visible: Mask, J: Floats | None = None) -> None:
    """Overwrite what is not visible, in place: coordinates `OUTSIDE`, Jacobian zero."""
    if visible.all():
        return
    y[~visible] = OUTSIDE
    if J is not None:
        J[~visible] = 0.0
