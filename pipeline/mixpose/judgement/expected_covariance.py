"""Expected accuracy of a pose before anything is measured."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from mixpose.body import Body
from mixpose.objective import project_body
from mixpose.records import Floats
from mixpose.sensors import Sensor


def expected_covariance(
    sensors: Sequence[Sensor],
    sigmas: Sequence[float],
    body: Body,
    T_world_object: Floats,
    free: NDArray[np.bool_],
) -> tuple[Floats, list[int]]:
    """Covariance that one frame gives when every feature in view is found with error σ_ε.

    Parameters
    ----------
    sensors : sequence of Sensor
    sigmas : sequence of float
        σ_ε per sensor, in sensor units.
    body : Body
    T_world_object : (4, 4) array
    free : (6,) bool
        Directions that are estimated.

    Returns
    -------
    (6, 6) array
        In the axes of `mixpose.rigid`; infinite on the diagonal where the data leave a direction
        open, zero where it is not free.
    list of int
        Number of features that each sensor sees.
    """
    at = project_body(tuple(sensors), body).project(T_world_object[None])
    J, weights = at.J[:, 0], at.weights[:, 0] / np.square(sigmas)[:, None]
    information = np.einsum("ln,lnmi,lnmj->ij", weights, J, J)
    counts = np.rint(at.weights[:, 0].sum(axis=1)).astype(int).tolist()
    return invert_information(information, free), counts


def invert_information(information: Floats, free: NDArray[np.bool_]) -> Floats:
    """Covariance of the free directions; a direction without information is infinite."""
    covariance = np.zeros((6, 6))
    inner = information[np.ix_(free, free)]
    scale = 1 / np.sqrt(np.maximum(np.diag(inner), np.finfo(np.float64).tiny))
    values, vectors = np.linalg.eigh(inner * scale * scale[:, None])
    open_directions = values < 1e-10
    inverse = np.where(open_directions, 0.0, 1 / np.where(open_directions, 1.0, values))
    solved = (vectors * inverse) @ vectors.T * scale * scale[:, None]
    unknown = (np.abs(vectors[:, open_directions]) > 1e-6).any(axis=1)
    solved[unknown, :] = 0.0
    solved[:, unknown] = 0.0
    solved[unknown, unknown] = np.inf
    covariance[np.ix_(free, free)] = (solved + solved.T) / 2
    return covariance
