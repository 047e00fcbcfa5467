"""A density of point detections, summed where it is asked for.

Few detections need no map: C is a sum of Gaussians, exact with all derivatives at any place.  Where
there are many, every expected feature sums those in its neighbourhood.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from mixpose.density.overlap import peak
from mixpose.records import PointPattern

Floats: TypeAlias = NDArray[np.float64]

_CUT = 6.0  # standard deviations beyond which a detection adds nothing: e^-18
FEW = 32
"""Detections up to which every feature sums all of them."""

_NOWHERE = 1.0e7  # sensor units: coordinates of detections that fill up the rows of a table


@dataclass(frozen=True)
class Mixture:
    """Gaussians of one variance around detections.

    Attributes
    ----------
    points : (1 or n, K, m) float64
        Detections that every feature sums, or those near each of n features.
    heights : (1 or n, K) float64
        What each adds at its centre; 0 for entries that fill up.
    variance : float64, or (L, 1, 1) float64
        In squared sensor units; of L sensors where the others have such a leading axis too.
    """

    points: Floats
    heights: Floats
    variance: Floats

    def sample(self, y: Floats) -> Floats:
        """Density and gradient (..., n, 1 + m) at the places (..., n, m) of n features."""
        away = self.points - y[..., None, :]
        bells = self._bells(away)
        sampled = np.empty((*y.shape[:-1], 1 + y.shape[-1]))
        sampled[..., 0] = bells.sum(axis=-1)
        sampled[..., 1:] = (bells[..., None, :] @ away)[..., 0, :] / self.variance
        return sampled

    def sample_all(self, y: Floats) -> tuple[Floats, Floats]:
        """As `sample`, with the second derivatives (..., n, m, m)."""
        m = y.shape[-1]
        away = self.points - y[..., None, :]
        bells = self._bells(away)
        weighted = away * bells[..., None]
        sampled = np.empty((*y.shape[:-1], 1 + m))
        C = np.add.reduce(bells, axis=-1, out=sampled[..., 0])
        np.divide(np.add.reduce(weighted, axis=-2), self.variance, out=sampled[..., 1:])
        second = weighted.swapaxes(-1, -2) @ away
        second /= self.variance[..., None]
        diagonal = np.einsum("...kk->...k", second)
        diagonal -= C[..., None]
        second /= self.variance[..., None]
        return sampled, second

    def _bells(self, away: Floats) -> Floats:
        squared = np.add.reduce(away * away, axis=-1)
        squared *= -0.5 / self.variance
        return np.asarray(np.exp(squared, out=squared) * self.heights)


def mixture(pattern: PointPattern, sigma: float, centres: Floats | None, reach: float) -> Mixture:
    """Blur detections without drawing them.

    Parameters
    ----------
    pattern : PointPattern
        Not empty.
    sigma : float
        Standard deviation of the blur in sensor units.
    centres : (n, m) array or None
        Where features are expected; None: anywhere, and all detections are summed.
    reach : float
        Distance from there, in sensor units, up to which sums are right.
    """
    points = np.asarray(pattern.points, dtype=np.float64)
    heights = pattern.weights * (peak(sigma**2, points.shape[1]) / pattern.weights.sum())
    variance = np.array(sigma**2)
    if centres is None or len(points) <= FEW:
        return Mixture(points[None], heights[None], variance)
    tree = cKDTree(points)
    radius = reach + _CUT * sigma
    most = int(tree.query_ball_point(centres, radius, return_length=True).max(initial=0))
    if most > len(points) // 2:
        return Mixture(points[None], heights[None], variance)
    _, near = tree.query(centres, k=np.arange(1, max(most, 1) + 1), distance_upper_bound=radius)
    padded = np.append(points, np.full((1, points.shape[1]), _NOWHERE), axis=0)
    return Mixture(padded[near], np.append(heights, 0.0)[near], variance)
