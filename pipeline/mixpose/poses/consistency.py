"""Whether covariances tell the truth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import chdtri

from mixpose.records import Floats

CONFIDENCE = 0.95


@dataclass(frozen=True)
class Consistency:
    """Whether the covariances tell the truth, over "ok" frames that have one."""

    frames: int
    # mean NEES divided by its dimensions: 1 if the covariances are right, above 1 if they promise
    # too much
    nees_per_dimension: float
    inside_95: float  # share of frames whose truth lies inside the 95 % ellipsoid


def consistency(measured: Sequence[tuple[float, int]]) -> Consistency | None:
    """Of frames, each with its squared error and number of dimensions; None of none."""
    if not measured:
        return None
    nees, dimensions = np.array(measured, dtype=np.float64).T
    limits = chdtri(dimensions, 1.0 - CONFIDENCE)
    return Consistency(
        frames=len(measured),
        nees_per_dimension=float(np.mean(nees / dimensions)),
        inside_95=float(np.mean(nees <= limits)),
    )


def normalised_error_squared(twist: Floats, covariance: Floats) -> tuple[float | None, int]:
    """Mahalanobis distance squared of an error (6,), and its dimensions: the rank of the
    covariance.

    Only directions that the covariance leaves free count: an axis that is held at the start pose
    has no variance, and its error no measure. None where it leaves none free.
    """
    variance = np.diag(covariance)
    kind = np.repeat([variance[:3].max(), variance[3:].max()], 3)
    free = np.flatnonzero(variance > 1e-12 * kind)
    scale = np.sqrt(variance[free])
    correlation = covariance[np.ix_(free, free)] / scale[:, None] / scale
    values, vectors = np.linalg.eigh(correlation)
    kept = values > 1e-9
    along = vectors.T @ (twist[free] / scale)
    dimensions = int(kept.sum())
    if not dimensions:
        return None, 0
    return float(np.sum(along[kept] ** 2 / values[kept])), dimensions
