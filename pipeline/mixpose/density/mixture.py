"""A density of point detections, summed where it is asked for.

Few detections need no map: C is a sum of Gaussians, exact with all derivatives at any place.  Where
there are many, every expected feature sums those in its neighbourhood.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
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
        C, pull, _ = self.sums(y)
        return np.concatenate([C[..., None], pull / self.variance], axis=-1)

    def sample_all(self, y: Floats) -> tuple[Floats, Floats]:
        """As `sample`, with the second derivatives (..., n, m, m)."""
        C, pull, spread = self.sums(y)
        second = spread / self.variance[..., None] - C[..., None, None] * np.eye(y.shape[-1])
        sampled = np.concatenate([C[..., None], pull / self.variance], axis=-1)
        return sampled, second / self.variance[..., None]

    def sums(self, y: Floats) -> tuple[Floats, Floats, Floats]:
        """Σ_j b_j, Σ_j b_j (d_j − y) and Σ_j b_j (d_j − y)(d_j − y)ᵀ over the bells b_j at y.

        Parameters
        ----------
        y : (..., n, m) array

        Returns
        -------
        (..., n), (..., n, m), (..., n, m, m) arrays
        """
        away = self.points - y[..., None, :]
        squares = away * away
        exponents = squares[..., 0] if y.shape[-1] == 1 else squares[..., 0] + squares[..., 1]
        exponents *= self._scale
        bells = np.exp(exponents, out=exponents)
        bells *= self.heights
        weighted = away * bells[..., None]
        return bells @ self._ones, self._ones @ weighted, weighted.swapaxes(-1, -2) @ away

    @cached_property
    def _scale(self) -> Floats:
        return np.asarray(-0.5 / self.variance)

    @cached_property
    def _ones(self) -> Floats:
        return np.ones(self.points.shape[-2])


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
