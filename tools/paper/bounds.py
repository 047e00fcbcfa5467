"""What the table is measured against: known correspondences, Cramér-Rao."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy import optimize

from mixpose.body import Body
from mixpose.rigid import transform
from paper.measurements import Measurement, grid_axes, sum_of_gaussians
from paper.systems import POINTS, START_ANGLE, START_SHIFT, Scenario, System, pose

Floats: TypeAlias = NDArray[np.float64]

START_INFORMATION = 3.0 / np.array([START_ANGLE] * 3 + [START_SHIFT] * 3) ** 2
"""Inverse variances of the starts (6,), radians and units: those of uniform distributions."""

_STEP = np.array([1e-5] * 3 + [1e-3] * 3)  # of central differences, radians and units


def oracle(system: System, scenario: Scenario, body: Body, truth: Floats) -> Floats:
    """Parameters (6,) by least squares to the true projections, correspondences known."""
    seen = _projections(system, scenario, truth)

    def residuals(beta: Floats) -> Floats:
        points = transform(pose(beta), body.means)
        pairs = zip(system.sensors, seen, strict=True)
        return np.concatenate([(sensor.project(points)[0] - y).ravel() for sensor, y in pairs])

    scale = np.array([0.01] * 3 + [1.0] * 3)
    tolerances = {"xtol": 1e-14, "ftol": 1e-14, "gtol": 1e-14}
    result = optimize.least_squares(residuals, truth, x_scale=scale, **tolerances)
    return np.asarray(result.x, dtype=np.float64)


def cramer_rao(
    system: System, scenario: Scenario, measurements: Sequence[Measurement], truth: Floats
) -> tuple[Floats, Floats]:
    """Least variances (6,) under pixel noise, radians² and units²: unbiased, and with the start.

    The amplitude of each sensor is unknown, as it is to the matched objective.  The start counts as
    a normal prior with the variances that starts have.
    """
    information = np.zeros((6, 6))
    for k, measurement in enumerate(measurements):
        h = measurement.clean.ravel()
        columns = []
        for step in np.diag(_STEP):
            ahead, behind = (_image(system, scenario, truth + s, k) for s in (step, -step))
            columns.append((ahead - behind).ravel() / (2 * step.max()))
        D = np.array(columns)
        along = D @ h
        information += (D @ D.T - np.outer(along, along) / (h @ h)) / measurement.noise**2
    unbiased = np.diag(np.linalg.inv(information))
    return unbiased, np.diag(np.linalg.inv(information + np.diag(START_INFORMATION)))


def _projections(system: System, scenario: Scenario, beta: Floats) -> list[Floats]:
    points = transform(pose(beta), scenario.observed(POINTS))
    return [sensor.project(points)[0] for sensor in system.sensors]


def _image(system: System, scenario: Scenario, beta: Floats, k: int) -> Floats:
    y = _projections(system, scenario, beta)[k]
    return sum_of_gaussians(y, grid_axes(system.sensors[k]), scenario.sigma)
