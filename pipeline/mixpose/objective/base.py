"""What an objective is, and what it knows of each sensor.

An objective maps poses to numbers to be maximised.  `linearise` gives what an optimiser needs at
one pose: value, gradient, and a curvature that is positive semidefinite (minus the Hessian,
without the terms that can make it indefinite).  Order and axes of the six numbers are those of
`mixpose.rigid`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np

from mixpose.density import Observation
from mixpose.objective.kernel import Match
from mixpose.records import Floats
from mixpose.sensors import Sensor


@dataclass(frozen=True)
class View:
    """One sensor with what it observed; times in seconds."""

    name: str
    sensor: Sensor
    observation: Observation
    delay: float = 0.0  # by which the sensor's frame was taken later than the common time
    readout: float = 0.0  # from the first row to the last; the time is that of the middle row
    unsure: float | None = None  # deviation of a delay that is estimated; None where it is told
    estimated: float = 0.0  # of the delay, what was estimated
    # where its calibration is not exact: the sensor as it stands still, and as it might be
    doubts: tuple[Sensor, ...] = ()


class Quadratic(NamedTuple):
    """Second-order model of an objective at a pose: value + gᵀδ − ½ δᵀCδ."""

    value: float
    gradient: Floats  # (6,)
    curvature: Floats  # (6, 6) symmetric, positive semidefinite
    hessian: Floats | None = None  # minus the second derivative itself; may be indefinite
    match: Match | None = None  # what a matched objective made it of


class Objective(Protocol):
    """A function of the pose, to be maximised."""

    def value(self, T_world_object: Floats) -> Floats:
        """Values (...,) at poses (..., 4, 4)."""
        ...

    def linearise(self, T_world_object: Floats) -> Quadratic:
        """Value, gradient and curvature at one pose (4, 4)."""
        ...


def region_of_interest(sensor: Sensor, y: Floats, margin: float) -> tuple[Floats, Floats]:
    """Box (lower, upper) around projected points (n, m), within the sensor.

    Parameters
    ----------
    sensor : Sensor
    y : (n, m) array
        Visible points, at least one.
    margin : float
        Sensor units added on every side.
    """
    lower = np.maximum(y.min(axis=0) - margin, sensor.lower)
    upper = np.minimum(y.max(axis=0) + margin, sensor.upper)
    return lower, upper
