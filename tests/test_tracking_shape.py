"""A body of few markers before one camera is told from other things by its shape, as it turns."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from mixpose.body import Body, PointFeature
from mixpose.density import Observation
from mixpose.fit import EstimatorOptions
from mixpose.objective import View
from mixpose.records import Estimate, PointPattern
from mixpose.rigid import inverse, transform, twist_between
from mixpose.sensors import PinholeCamera
from mixpose.tracking import Tracker

Floats = NDArray[np.float64]

POINTS = np.array([[-48.0, -20, 10], [40, -35, -25], [10, 52, -12], [5, 8, 50]])
BODY = Body("four", tuple(PointFeature(point) for point in POINTS))
K = np.array([[1200.0, 0, 640], [0, 1200, 512], [0, 0, 1]])
CAMERA = PinholeCamera(K, np.zeros(5), (1280, 1024), np.eye(4))


def pose(frame: int, turn_deg: float) -> Floats:
    """T_world_object of a body 0.8 m before the camera that turns so much a frame."""
    axis = np.array([0.5, 0.8, 0.33])
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec([0.3, 0.2, 0.1]).as_matrix()
    T[:3, :3] = Rotation.from_rotvec(np.radians(turn_deg) * frame * axis).as_matrix() @ T[:3, :3]
    T[:3, 3] = [10.0, -20.0, 800.0]
    return T


def told(turn_deg: float, points: Floats = POINTS, noise: float = 0.1) -> list[Estimate]:
    """Estimates of what moves as the body would, seen to so many px."""
    rng, tracker = np.random.default_rng(0), Tracker.create(BODY, EstimatorOptions())
    track, estimates = tracker.begin(), []
    for frame in range(10):
        y = CAMERA.project(transform(pose(frame, turn_deg), points))[0]
        y += rng.normal(0, noise, y.shape)
        views = [View("0", CAMERA, Observation(PointPattern(y, np.ones(len(y))), 1.5))]
        track, estimate = tracker.advance(track, frame, frame / 30, views)
        estimates.append(estimate)
    return estimates


def test_four_markers_are_the_body_once_they_were_seen_from_other_sides() -> None:
    estimates = told(turn_deg=2.0)
    # by the first frame alone a part of clutter may look like it
    assert estimates[0].status == "ambiguous"
    assert [one.status for one in estimates[3:]] == ["ok"] * 7
    for frame, one in enumerate(estimates[3:], 3):
        assert one.T_world_object is not None
        assert one.covariance is not None
        away = twist_between(one.T_world_object, pose(frame, 2.0))
        # of χ² of six degrees of freedom, and what few residuals tell: 99.9 % are below
        assert away @ np.linalg.solve(one.covariance, away) < 22.5


def test_four_markers_at_rest_look_alike_in_all_frames() -> None:
    assert "ok" not in Counter(one.status for one in told(turn_deg=0.0, noise=0.2))


@pytest.mark.parametrize("depths", [(30.0, -20.0, 15.0, 0.0), (0.0, 25.0, -30.0, 20.0)])
def test_another_thing_that_looks_alike_from_one_side_is_not_the_body(
    depths: tuple[float, ...],
) -> None:
    T, seen = pose(0, 0.0), transform(pose(0, 0.0), POINTS)
    # along the rays of the first frame, in which it is the very same image
    other = transform(inverse(T), seen * (1 + np.array(depths)[:, None] / seen[:, 2:]))
    estimates = told(turn_deg=2.0, points=other)
    assert estimates[0].status == "ambiguous"
    assert "ok" not in {one.status for one in estimates}
