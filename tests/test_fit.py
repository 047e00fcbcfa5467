"""A pose near a start, through narrowing blurs."""

from __future__ import annotations

import numpy as np
from detections import ALL_FREE, EIGHT, TRUTH, detect, interpolation_bound, random_start

from mixpose.fit import EstimatorOptions, fit_near
from mixpose.rigid import twist_between
from mixpose.sensors import PinholeCamera


def test_exact_detections_give_the_exact_pose(pinhole_cameras: list[PinholeCamera]) -> None:
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
    twist = np.abs(twist_between(TRUTH, fit.T_world_object))
    bound = interpolation_bound(views, EIGHT, TRUTH, ALL_FREE)
    assert (twist < bound).all()
    # a three-hundredth of the 0.2 px that detections err by as a rule
    assert np.linalg.norm(twist[:3]) < 2e-3
    assert np.degrees(np.linalg.norm(twist[3:])) < 2e-3
