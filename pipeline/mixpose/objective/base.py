"""What an objective is, and what it knows of each sensor.

An objective maps poses to numbers to be maximised: a term with values of its own.  Order and axes
of the six numbers that a pose is moved by are those of `mixpose.rigid`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from mixpose.density import Observation
from mixpose.optimise import Quadratic
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


class Objective(Protocol):
    """A function of the pose, to be maximised."""

    def value(self, T_world_object: Floats) -> Floats:
        """Values (...,) at poses (..., 4, 4)."""
        ...

    def linearise(self, T_world_object: Floats) -> Quadratic:
        """Second-order models at poses (H, 4, 4)."""
        ...


def region_of_interest(sensor: Sensor, y: Floats, margin: float) -> tuple[Floats, Floats]:
    """Box (lower, upper) around visible points (n, m), at least one, within the sensor.

    The margin, in sensor units, is added on every side.
    """
    lower = np.maximum(y.min(axis=0) - margin, sensor.lower)
    upper = np.minimum(y.max(axis=0) + margin, sensor.upper)
    return lower, upper
