"""A pose near a start, through narrowing blurs."""

from __future__ import annotations

import numpy as np
from detections import EIGHT, TRUTH, detect, random_start

from mixpose.fit import EstimatorOptions, fit_near
from mixpose.rigid import rotation_angle_deg
from mixpose.sensors import PinholeCamera


def test_exact_detections_give_the_exact_pose(
    pinhole_cameras: list[PinholeCamera]
) -> None:
    views = detect(pinhole_cameras, EIGHT, TRUTH)
    fit = fit_near(
        views,
        EIGHT,
        random_start(1),
        np.repeat([6, 0.05], 3),
        EstimatorOptions(),
        EIGHT.means[:, None],
    )
    assert fit.converged
    # gradients on tiles of 16 points per σ err by 1e-5 σ at a peak: 1.5e-5 px, 2e-5 mm
    assert rotation_angle_deg(fit.T_world_object, TRUTH) < 1e-4
    assert np.linalg.norm((fit.T_world_object - TRUTH)[:3, 3]) < 1e-4
