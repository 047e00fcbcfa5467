"""The covariance to expect from one frame, given only sensors and a body."""

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
