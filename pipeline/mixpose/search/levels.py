"""Observations at one level of blur, looked up for many poses at once.

As in the matched objective, C is the observed density g blurred once more by σ, so that
⟨g, h⟩ = Σ_i C(p_i).  Detections are few, and C is a sum over them: no map is drawn.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from mixpose.density import Density, peak
from mixpose.records import PointPattern
from mixpose.search.sightings import Sighting
from mixpose.sensors import Sensor

Floats: TypeAlias = NDArray[np.float64]

_MOST_PAIRS = 4_000_000  # of predicted features and detections in memory at once


@dataclass(frozen=True)
class Level:
    """One sensor's observation at one blur.

    Attributes
    ----------
    sensor : Sensor
    observed : (M, m) array or Density
        Detections of equal weight, or C itself.
    sigma : float
        Standard deviation of a feature, in sensor units.
    energy : float
        ⟨g, g⟩.
    weight : float
        ω_l of the matched objective.
    """

    sensor: Sensor
    observed: Floats | Density
    sigma: float
    energy: float
    weight: float

    @property
    def variance(self) -> float:
        """2σ², that of the product of two features."""
        return 2 * self.sigma**2

    def sample(self, y: Floats) -> tuple[Floats, Floats]:
        """C (H, n) and its gradient (H, n, m) at projected features (H, n, m)."""
        if isinstance(self.observed, Density):
            looked_up = self.observed.sample(y).astype(np.float64)
            return looked_up[..., 0], looked_up[..., 1:]
        C, gradient = np.empty(y.shape[:-1]), np.empty(y.shape)
        rows = max(_MOST_PAIRS // max(y.shape[1] * len(self.observed), 1), 1)
        for start in range(0, len(y), rows):
            part = slice(start, start + rows)
            C[part], gradient[part] = self._sum_of_bells(y[part], self.observed)
        return C, gradient

    def _sum_of_bells(self, y: Floats, detections: Floats) -> tuple[Floats, Floats]:
        away = [detections[:, k] - y[..., k, None] for k in range(y.shape[-1])]
        squared = sum(a * a for a in away)
        bells = np.exp(squared * (-0.5 / self.variance))
        top = peak(self.variance, y.shape[-1]) / len(detections)
        pull = [np.einsum("hnm,hnm->hn", bells, a) for a in away]
        return top * bells.sum(axis=-1), np.stack(pull, axis=-1) * (top / self.variance)


def levels(sightings: Sequence[Sighting], factors: Sequence[float], features: int) -> list[Level]:
    """All sightings with features wider than σ_ε.

    Parameters
    ----------
    sightings : sequence of Sighting
    factors : sequence of float
        How many times as wide, per sighting; at least 1.
    features : int
        Number of features of the body.
    """
    made = []
    for sighting, factor in zip(sightings, factors, strict=True):
        observation, sensor = sighting.view.observation, sighting.view.sensor
        sigma = factor * sighting.sigma
        observed: Floats | Density
        if isinstance(observation.pattern, PointPattern):
            observed = observation.pattern.points
        else:
            observed = observation.matched(sigma, (sensor.lower, sensor.upper))
        energy = observation.energy(sigma)
        weight = peak(2 * sigma**2, observation.dimension) / energy / features
        made.append(Level(sensor, observed, sigma, energy, weight))
    return made
