"""What met features tell of a pose, and the covariance that is its inverse."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from scipy.linalg.lapack import dposv

from mixpose.matching import Matches
from mixpose.records import Floats, Mask

_SMALLEST = 1e-14  # of a matrix of diagonal 1, float64 tells no smaller eigenvalue from none


def inverted(information: Floats) -> Floats:
    """The inverse of an information matrix (k, k).

    Directions that the data leave open get the variance that their information says: large, and
    at most what float64 can invert.
    """
    if not information.size:
        return information
    scale = 1.0 / np.sqrt(np.maximum(information.diagonal(), 1e-18))
    both = scale[:, None] * scale
    factor, inverse, failure = dposv(information * both, unit(len(scale)))
    if failure or min(factor.diagonal().tolist()) < 1e-5:
        values, vectors = np.linalg.eigh(information * both)
        halves = vectors / np.sqrt(np.maximum(values, _SMALLEST))
        inverse = halves @ halves.T
    return np.asarray(inverse * both)


@lru_cache(maxsize=16)
def unit(size: int) -> Floats:
    """The unit matrix, not to be written to."""
    unit = np.eye(size)
    unit.flags.writeable = False
    return unit


def information_of(found: Matches, variances: Floats, spreads: Floats | None = None) -> Floats:
    """Σ_l Σ_i J_iᵀ J_i / s_l² (..., 6, 6) over the met features, for noise (..., L) in σ_ε².

    What features tell that are off by `spreads` (..., N, 3, 3) in the world is less.
    """
    *poses, sensors, n, m, _ = found.J.shape
    weights = found.shares * found.each_part[:, None] / (variances[..., None] + found.extra)
    rows = np.sqrt(weights)[..., None, None] * found.J
    if spreads is None:
        rows = rows.reshape(*poses, sensors * n * m, 6)
        return np.asarray(rows.swapaxes(-2, -1) @ rows)
    # of each feature the coordinates of all sensors err together
    rows = rows.swapaxes(-4, -3).reshape(*poses, n, sensors * m, 6)
    by_place = rows[..., :3]
    errors = np.eye(sensors * m) + by_place @ spreads @ by_place.swapaxes(-2, -1)
    information = rows.swapaxes(-2, -1) @ np.linalg.solve(errors, rows)
    return np.asarray(information.sum(axis=-3))


def invert_information(information: Floats, free: Mask) -> Floats:
    """Covariance (6, 6) of the free directions; a direction without information is infinite."""
    inner, covariance = np.ix_(free, free), np.zeros((6, 6))
    covariance[inner] = inverted(information[inner])
    # so much larger than if all other directions were known
    inflation = covariance.diagonal() * np.maximum(information.diagonal(), 1e-18)
    unknown = inflation > 1e9
    covariance[unknown], covariance[:, unknown] = 0.0, 0.0
    covariance[unknown, unknown] = np.inf
    return covariance


def log_determinants(information: Floats, least: Floats) -> Floats:
    """Logarithms (K,) of determinants of matrices (K, k, k) of at least diag `least` (K, k).

    Where data are so exact that this is rounded away, what they leave open is still that.
    """
    signs, logs = np.linalg.slogdet(information)
    for i in np.flatnonzero(~(signs > 0)).tolist():
        size = information[i].diagonal()
        values = np.linalg.eigvalsh(information[i] / np.sqrt(np.outer(size, size)))
        bounded = np.where(values > _SMALLEST, values, (least[i] / size).min())
        logs[i] = np.log(size).sum() + np.log(bounded).sum()
    return np.asarray(logs)
