"""Information about a pose from the features met, and the covariance that is its inverse."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from scipy.linalg.lapack import dposv

from mixpose.body import Body
from mixpose.matching import Matches
from mixpose.objective import project_body
from mixpose.records import Floats, Mask
from mixpose.sensors import Sensor, as_images

_SMALLEST = 1e-14  # eigenvalue of a matrix of diagonal 1 that float64 tells from zero


def inverted(information: Floats) -> Floats:
    """Return the inverse of an information matrix (k, k).

    Variances of directions that the data leave open are large, bounded by what float64 can invert.
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
    """Return the unit matrix, shared and read-only."""
    unit = np.eye(size)
    unit.flags.writeable = False
    return unit


def information_of(matches: Matches, variances: Floats, spreads: Floats | None = None) -> Floats:
    """Return Σ_l Σ_i J_iᵀ J_i / s_l² (..., 6, 6) over the features met, for noise (..., L) in σ_ε².

    With `spreads`, covariances (..., N, 3, 3) of features in the world, it is smaller.
    """
    *poses, sensors, n, m, _ = matches.J.shape
    weights = matches.shares * matches.coordinate_weight[:, None]
    rows = np.sqrt(weights / (variances[..., None] + matches.extra))[..., None, None] * matches.J
    if spreads is None:
        rows = rows.reshape(*poses, sensors * n * m, 6)
        return np.asarray(rows.swapaxes(-2, -1) @ rows)
    # the error of a feature is common to the coordinates of all sensors
    rows = rows.swapaxes(-4, -3).reshape(*poses, n, sensors * m, 6)
    by_place = rows[..., :3]
    errors = np.eye(sensors * m) + by_place @ spreads @ by_place.swapaxes(-2, -1)
    information = rows.swapaxes(-2, -1) @ np.linalg.solve(errors, rows)
    return np.asarray(information.sum(axis=-3))


def invert_information(information: Floats, free: Mask) -> Floats:
    """Return the covariance (6, 6) of free directions; infinite in those without information."""
    inner, covariance = np.ix_(free, free), np.zeros((6, 6))
    covariance[inner] = inverted(information[inner])
    # by how much a variance is larger than if all other directions were known
    inflation = covariance.diagonal() * np.maximum(information.diagonal(), 1e-18)
    unknown = inflation > 1e9
    covariance[unknown], covariance[:, unknown] = 0.0, 0.0
    covariance[unknown, unknown] = np.inf
    return covariance


def expected_covariance(
    sensors: Sequence[Sensor],
    sigmas: Sequence[float],  # σ_ε, sensor units
    body: Body,
    T_world_object: Floats,
    free: Mask,
) -> tuple[Floats, list[int]]:
    """Return the covariance of a pose if every feature in view is detected with an error of σ_ε.

    It is that of `invert_information`, in the axes of `mixpose.rigid`.  Also returned is the number
    of features in view of each sensor.
    """
    images, deviations, first = as_images(sensors, sigmas)
    match = project_body(images, body).project(T_world_object[None])
    J, weights = match.J[:, 0], match.weights[:, 0] / np.square(deviations)[:, None]
    information = np.einsum("ln,lnmi,lnmj->ij", weights, J, J)
    counts = np.rint(match.weights[first, 0].sum(axis=1)).astype(int).tolist()
    return invert_information(information, free), counts


def log_determinants(information: Floats, least: Floats) -> Floats:
    """Return the log determinants (K,) of matrices (K, k, k) that are at least diag `least` (K, k).

    The bound holds even where it is rounded away beside very exact data.
    """
    signs, logs = np.linalg.slogdet(information)
    for i in np.flatnonzero(~(signs > 0)).tolist():
        size = information[i].diagonal()
        values = np.linalg.eigvalsh(information[i] / np.sqrt(np.outer(size, size)))
        bounded = np.where(values > _SMALLEST, values, (least[i] / size).min())
        logs[i] = np.log(size).sum() + np.log(bounded).sum()
    return np.asarray(logs)
