"""What detections err by, as residuals show it, and the covariance of a pose that follows.

Offsets of met features from their prediction, in units of each sensor's σ_ε, have one unknown
common variance φ².  It is estimated from the frame's residuals and those of frames before it.
With ν degrees of freedom the estimate itself is uncertain: the covariance is enlarged so that its
95 % ellipsoid is that of the F distribution with (d, ν) degrees, d directions being free.  For
many degrees of freedom nothing is added.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri, fdtri

from mixpose.constants import constant
from mixpose.judgement.association import Association

Floats: TypeAlias = NDArray[np.float64]

_MIN_INFORMATION = 1e-18  # per squared length or radian: less is as good as none


@dataclass(frozen=True)
class NoiseModel:
    """What is believed of detection noise before residuals are seen, and for how long."""

    typical: float = constant(
        0.2, "of σ_ε: centres of blobs err by 0.01-0.3 px where sigma is 1.5 px (recordings)"
    )
    typical_degrees: float = constant(
        4.0, "degrees of freedom that `typical` counts as where evidence is weighed: two features"
    )
    smallest: float = constant(1e-3, "of σ_ε: float32 densities do not resolve residuals below")
    by_chance: float = constant(
        0.999, "frames whose residuals are larger than so many by chance stand on their own"
    )
    known: float = constant(
        20.0, "degrees of freedom from which the noise of a recording is known to 16 %, √(1/2ν)"
    )
    memory: float = constant(0.95, "per frame, of the residuals before: 20 frames count")
    confidence: float = constant(
        0.95, "of the ellipsoid that is as large as the F distribution's; 0 enlarges nothing"
    )
    forgetting: float = constant(0.8, "the same where they no longer seem to hold: 5 frames count")

    def enlargement(self, directions: int, degrees: float) -> float:
        """Factor that makes the Gaussian ellipsoid as large as that of the F distribution.

        Parameters
        ----------
        directions : int
            Of the pose that are free.
        degrees : float
            Of freedom, from which the variance was estimated.
        """
        if directions == 0 or self.confidence == 0:
            return 1.0
        tail = fdtri(directions, max(degrees, 1.0), self.confidence)
        return float(directions * tail / chdtri(directions, 1 - self.confidence))


@dataclass(frozen=True)
class Noise:
    """Sum of squared residuals in σ_ε, and its degrees of freedom."""

    squares: float = 0.0
    degrees: float = 0.0

    @property
    def variance(self) -> float:
        """Mean of the squares."""
        return self.squares / max(self.degrees, 1e-12)

    def joined(self, other: Noise, memory: float = 1.0) -> Noise:
        """Add another noise to what is remembered of the present one."""
        return Noise(memory * self.squares + other.squares, memory * self.degrees + other.degrees)

    def is_outdone_by(self, frame: Noise, model: NoiseModel) -> bool:
        """Whether a frame's residuals are larger than chance makes them."""
        if self.degrees < model.known or frame.degrees < 1:
            return False
        limit = float(fdtri(frame.degrees, self.degrees, model.by_chance))
        return frame.variance > limit * self.variance


def noises(before: Noise, own: Noise, model: NoiseModel) -> tuple[Noise, Noise]:
    """The noise that a frame's covariance goes by, and the one that is remembered.

    As a rule both are that of the frames so far.  A frame with residuals of another kind, as where
    two features run into each other, goes by its own, and the frames after it forget it.
    """
    if before.is_outdone_by(own, model):
        forgotten = model.forgetting
        return own, Noise(forgotten * before.squares, forgotten * before.degrees)
    joined = before.joined(own, model.memory)
    return joined, joined


def noise_of(associations: Sequence[Association], free: NDArray[np.bool_]) -> Noise:
    """Residuals of a frame, with the degrees of freedom that the pose has left."""
    measurements = sum(one.measurements for one in associations)
    degrees = max(measurements - int(free.sum()), 0.0)
    return Noise(sum(one.squares for one in associations) if degrees else 0.0, degrees)


def information_of(associations: Sequence[Association]) -> Floats:
    """Σ_l Σ_i J_iᵀ J_i / σ_l² over the met features: (6, 6), for noise of one σ."""
    information = np.zeros((6, 6))
    for one in associations:
        weighted = (one.J * (one.shares / one.sigma**2)[:, None, None]).reshape(-1, 6)
        information += weighted.T @ one.J.reshape(-1, 6)
    return information


def covariance_of(
    information: Floats, noise: Noise, free: NDArray[np.bool_], model: NoiseModel
) -> Floats:
    """Covariance of a pose (6, 6), zero where it is not free.

    Directions that the data leave open get the variance that their information says: large, and
    at most what float64 can invert.
    """
    inner = information[np.ix_(free, free)]
    scale = 1.0 / np.sqrt(np.maximum(inner.diagonal(), _MIN_INFORMATION))
    values, vectors = np.linalg.eigh(inner * scale * scale[:, None])
    inverse = (vectors / np.maximum(values, 1e-12)) @ vectors.T * scale * scale[:, None]
    variance = noise.variance if noise.degrees >= 1 else model.typical**2
    variance = max(variance, model.smallest**2) * model.enlargement(int(free.sum()), noise.degrees)
    covariance = np.zeros((6, 6))
    covariance[np.ix_(free, free)] = variance / 2 * (inverse + inverse.T)
    return covariance
