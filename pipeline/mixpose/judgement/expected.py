"""The covariance that a frame is expected to give, of sensors and a body alone."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mixpose.body import Body
from mixpose.judgement.information import invert_information
from mixpose.objective import project_body
from mixpose.records import Floats, Mask
from mixpose.sensors import Sensor, as_images


def expected_covariance(
    sensors: Sequence[Sensor],
    sigmas: Sequence[float],  # σ_ε, sensor units
    body: Body,
    T_world_object: Floats,
    free: Mask,
) -> tuple[Floats, list[int]]:
    """Covariance that one frame gives when every feature in view is found with error σ_ε.

    As `invert_information` has it, in the axes of `mixpose.rigid`; and the number of features
    that each sensor sees.
    """
    images, deviations, first = as_images(sensors, sigmas)
    at = project_body(images, body).project(T_world_object[None])
    J, weights = at.J[:, 0], at.weights[:, 0] / np.square(deviations)[:, None]
    information = np.einsum("ln,lnmi,lnmj->ij", weights, J, J)
    counts = np.rint(at.weights[first, 0].sum(axis=1)).astype(int).tolist()
    return invert_information(information, free), counts
