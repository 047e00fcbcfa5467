"""Lines of sight: where in space the features that a sensor detected may be."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

from numpy.typing import NDArray

from mixpose.records import Floats


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
