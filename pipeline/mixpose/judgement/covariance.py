"""Covariances as inverses of information, and what one frame is expected to give."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from mixpose.body import Body
from mixpose.matching import Matches
from mixpose.objective import project_body
from mixpose.records import Floats
from mixpose.sensors import Sensor


def inverses(information: Floats) -> Floats:
    """Inverses of information matrices (..., k, k).

    Directions that the data leave open get the variance that their information says: large, and
    at most what float64 can invert.
    """
    scale = 1.0 / np.sqrt(np.maximum(information.diagonal(axis1=-2, axis2=-1), 1e-18))
    both = scale[..., :, None] * scale[..., None, :]
    values, vectors = np.linalg.eigh(information * both)
    # of a matrix of diagonal 1, float64 tells no smaller eigenvalue from none
    halves = vectors / np.sqrt(np.maximum(values, 1e-14))[..., None, :]
    return np.asarray(halves @ halves.swapaxes(-2, -1) * both)


def information_of(found: Matches, variances: Floats, spreads: Floats | None = None) -> Floats:
    """Σ_l Σ_i J_iᵀ J_i / s_l² (K, 6, 6) over the met features, for noise (K, L) in σ_ε².

    What features tell that are off by `spreads` (K, N, 3, 3) in the world is less.
    """
    frames, sensors, n, m, _ = found.J.shape
    weights = (found.shares / variances[..., None])[..., None, None]
    J, scaled = (
        one.swapaxes(1, 2).reshape(frames, n, sensors * m, 6)
        for one in (found.J, weights * found.J)
    )
    information = scaled.swapaxes(2, 3) @ J
    if spreads is not None:
        place = information[..., :3, :3]
        taken = spreads @ np.linalg.inv(np.eye(3) + place @ spreads)
        information = information - information[..., :3] @ taken @ information[..., :3, :]
    return np.asarray(information.sum(axis=1))


def invert_information(information: Floats, free: NDArray[np.bool_]) -> Floats:
    """Covariance (6, 6) of the free directions; a direction without information is infinite."""
    inner = np.ix_(free, free)
    covariance = np.zeros((6, 6))
    covariance[inner] = inverses(information[inner])
    # so much larger than if all other directions were known
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
    free: NDArray[np.bool_],
) -> tuple[Floats, list[int]]:
    """Covariance that one frame gives when every feature in view is found with error σ_ε.

    As `invert_information` has it, in the axes of `mixpose.rigid`; and the number of features
    that each sensor sees.
    """
    at = project_body(tuple(sensors), body).project(T_world_object[None])
    J, weights = at.J[:, 0], at.weights[:, 0] / np.square(sigmas)[:, None]
    information = np.einsum("ln,lnmi,lnmj->ij", weights, J, J)
    counts = np.rint(at.weights[:, 0].sum(axis=1)).astype(int).tolist()
    return invert_information(information, free), counts
