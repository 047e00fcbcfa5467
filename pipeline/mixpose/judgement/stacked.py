"""Associations of K poses, each with the same L sensors, in arrays: worked on at once.

Every one of the N features has a place, also where a sensor does not have it in view, and every
sensor M coordinates; what is not there has no share, no Jacobian and no offset.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from mixpose.judgement.association import Association

Floats: TypeAlias = NDArray[np.float64]


@dataclass(frozen=True)
class Stacked:
    """Associations of K poses.

    Attributes
    ----------
    each : sequence of sequence of Association
        By pose and sensor.
    dimensions : (L,) int
        Coordinates of each sensor.
    weights : (K, L, N) float64
        Of the features in view; 0 of the others.
    shares : (K, L, N) float64
        How far each was met, 0 to its weight.
    places : (K, L, N, M) float64
        Where they are predicted, sensor units.
    offsets : (K, L, N, M) float64
        Observed minus predicted place, in σ_ε.
    J : (K, L, N, M, 6) float64
        Jacobian of the predicted places by the pose, in σ_ε.
    """

    each: Sequence[Sequence[Association]]
    dimensions: NDArray[np.intp]
    weights: Floats
    shares: Floats
    places: Floats
    offsets: Floats
    J: Floats

    @classmethod
    def of(cls, each: Sequence[Sequence[Association]]) -> Stacked:
        """Put associations side by side."""
        dimensions = np.array([one.J.shape[1] for one in each[0]])
        all_of_them = [one for found in each for one in found]
        most = 1 + max(int(one.features.max(initial=0)) for one in all_of_them)
        shape = len(each), len(dimensions), most
        weights, shares = np.zeros((2, *shape))
        places, offsets = np.zeros((2, *shape, int(dimensions.max())))
        J = np.zeros((*places.shape, 6))
        for k, found in enumerate(each):
            for i, one in enumerate(found):
                n, m = one.offsets.shape
                at = k, i, one.features
                weights[at] = one.expected / max(n, 1)
                shares[at] = one.shares
                places[(*at, slice(m))] = one.places
                offsets[(*at, slice(m))] = one.offsets / one.sigma
                J[(*at, slice(m))] = one.J / one.sigma
        return cls(each, dimensions, weights, shares, places, offsets, J)

    def gathered(self, name: str) -> Floats:
        """An attribute of the associations (K, L)."""
        return np.array([[getattr(one, name) for one in found] for found in self.each])
