"""What is known of a pose before a frame, as a normal distribution."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mixpose.optimise import Quadratic
from mixpose.records import Floats, Mask
from mixpose.rigid import perturb, twist_between


@dataclass(frozen=True)
class NormalPrior:
    """Logarithm of a normal distribution of the pose, without its constant."""

    T_world_object: Floats  # (4, 4) its mean
    uncertainty: Floats  # (6,) standard deviations, lengths and radians; positive where free
    free: Mask  # (6,) directions in which the pose may change

    @property
    def information(self) -> Floats:
        """Inverse variances (6,)."""
        return np.where(self.free, 1 / np.maximum(self.uncertainty, 1e-12) ** 2, 0.0)

    def linearise(self, poses: Floats) -> Quadratic:
        """Second-order models at poses (H, 4, 4)."""
        information = self.information
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
