"""What an objective is, what it knows of each sensor, and what is known of a pose before.

Order and axes of the six numbers that a pose is moved by are those of `mixpose.rigid`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from mixpose.density import Observation
from mixpose.optimise import Quadratic, Term
from mixpose.records import Floats, Mask
from mixpose.rigid import perturb, twist_between
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


class Objective(Term, Protocol):
    """A function of the pose, to be maximised: a term with values of its own."""

    def value(self, T_world_object: Floats) -> Floats:
        """Values (...,) at poses (..., 4, 4)."""
        ...


@dataclass(frozen=True)
class NormalPrior:
    """Logarithm of a normal distribution of the pose, without its constant."""

    T_world_object: Floats  # (4, 4) its mean
    uncertainty: Floats  # (6,) standard deviations, lengths and radians; positive where free
    free: Mask  # (6,) directions in which the pose may change

    def linearise(self, poses: Floats) -> Quadratic:
        """Second-order models at poses (H, 4, 4)."""
        information = np.where(self.free, 1 / np.maximum(self.uncertainty, 1e-12) ** 2, 0.0)
        away = twist_between(self.T_world_object, poses)
        pull = -information * away
        C = np.broadcast_to(np.diag(information), (len(poses), 6, 6))
        return Quadratic(0.5 * (away * pull).sum(axis=1), pull, C, C)

    def points(self) -> Floats:
        """The mean, and √k standard deviations to either side along each of k directions."""
        count = int(self.free.sum())
        steps = np.sqrt(count) * np.diag(np.where(self.free, self.uncertainty, 0.0))[self.free]
        twists = np.concatenate([np.zeros((1, 6)), np.stack([steps, -steps], 1).reshape(-1, 6)])
        return perturb(self.T_world_object, twists)


def region_of_interest(sensor: Sensor, y: Floats, margin: float) -> tuple[Floats, Floats]:
    """Box (lower, upper) with a margin around visible points (n, m), within the sensor."""
    lower, upper = y.min(axis=0) - margin, y.max(axis=0) + margin
    return np.maximum(lower, sensor.lower), np.minimum(upper, sensor.upper)
