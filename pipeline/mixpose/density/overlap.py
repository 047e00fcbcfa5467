"""Inner products of Gaussian mixtures: ⟨g, g⟩ of a pattern, ⟨h, h⟩ of a prediction."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from scipy.spatial import cKDTree

from mixpose.density.rules import DRAWING
from mixpose.records import Floats, Indices


def peak(variance: float, dimension: int) -> float:
    """Value of an isotropic Gaussian density at its centre."""
    return float((2 * np.pi * variance) ** (-dimension / 2))


def close_pairs(points: Floats, variance: float) -> Indices:
    """Pairs i < j of points (n, m) that overlap at the given variance, or all of few: (P, 2)."""
    if len(points) <= DRAWING.few:
        return _all_pairs(len(points))
    pairs = cKDTree(points).query_pairs(DRAWING.overlap * np.sqrt(variance), output_type="ndarray")
    return np.asarray(pairs, dtype=np.intp)


@lru_cache(maxsize=DRAWING.few)
def _all_pairs(count: int) -> Indices:
    pairs = np.stack(np.triu_indices(count, 1), axis=1)
    pairs.flags.writeable = False
    return pairs


def self_overlap(points: Floats, weights: Floats, variance: float) -> float:
    """Σ_ij w_i w_j N(y_i − y_j; 0, variance): the inner product of a mixture with itself.

    Of points (n, m) with weights (n,); the variance is 2σ² for features of standard deviation σ.
    """
    pairs = close_pairs(points, variance)
    away = points[pairs[:, 0]] - points[pairs[:, 1]]
    bells = np.exp(-0.5 * (away * away).sum(axis=1) / variance)
    cross = float(np.sum(weights[pairs[:, 0]] * weights[pairs[:, 1]] * bells))
    return (float(weights @ weights) + 2 * cross) * peak(variance, points.shape[1])
