"""A detection that is not one feature's own: two that ran into each other, a false one nearby."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from mixpose.body import Body, PointFeature
from mixpose.density import Observation
from mixpose.fit import EstimatorOptions, fit_near
from mixpose.judgement import ScoredPose, judge
from mixpose.matching import ErrorRules
from mixpose.objective import View, matched_objective
from mixpose.records import Estimate, PointPattern
from mixpose.rigid import from_parts, perturb, rotation_angle_deg, transform
from mixpose.sensors import PinholeCamera
from mixpose.tracking import Tracker

Floats = NDArray[np.float64]

SIGMA = 1.5
POINTS = np.array(
    [[0, 0, 0], [80, 6, 10], [-55, 48, -12], [-30, -66, 25], [36, 40, 62], [22, -35, -48]], float
)
BODY = Body("wand", tuple(PointFeature(point) for point in POINTS))
K = np.array([[700.0, 0, 320], [0, 700, 240], [0, 0, 1]])
CAMERA = PinholeCamera(K, np.zeros(4), (640, 480), np.eye(4))


def in_line(first: int, second: int, apart_px: float) -> Floats:
    """A pose that puts one feature behind another, but for some pixels."""
    along = POINTS[second] - POINTS[first]
    R, _ = Rotation.align_vectors([[0.0, 0.0, 1.0]], [along])
    turn = Rotation.from_euler("y", apart_px / 700 * 460 / np.linalg.norm(along))
    R_world_object = (turn * R).as_matrix()
    shift = np.array([0.0, 0.0, 460.0]) - R_world_object @ POINTS[first]
    return from_parts(R_world_object, shift)


def seen(T_world_object: Floats) -> Floats:
    return CAMERA.project(transform(T_world_object, POINTS))[0]


def view_of(points: Floats) -> View:
    return View("camera", CAMERA, Observation(PointPattern(points, np.ones(len(points))), SIGMA))


def judged_at(T_world_object: Floats, views: list[View]) -> ScoredPose:
    objective = matched_objective(views, BODY, [SIGMA] * len(views))
    return judge(objective, T_world_object, np.ones(6, dtype=np.bool_))


def estimated(points: Floats, T_start: Floats) -> Estimate:
    tracker = Tracker.create(BODY, EstimatorOptions(), T_start)
    return tracker.advance(tracker.begin(), 0, 0.0, [view_of(points)])[1]


@pytest.mark.parametrize("apart_px", [2.0, 3.0, 4.0])
def test_two_features_seen_as_one_leave_the_pose_where_it_is(apart_px: float) -> None:
    T = in_line(1, 2, apart_px)
    y = seen(T)
    assert np.linalg.norm(y[1] - y[2]) == pytest.approx(apart_px, rel=0.3)
    merged = np.vstack([np.delete(y, [1, 2], axis=0), y[1:3].mean(axis=0)])
    start = perturb(T, np.array([1.0, -1.0, 2.0, 0.01, -0.01, 0.01]))
    estimate = estimated(merged, start)
    assert estimate.T_world_object is not None
    # without noise: the middle of two images is the image of both to far less than a pixel
    assert rotation_angle_deg(estimate.T_world_object, T) < 0.02
    assert np.linalg.norm(estimate.T_world_object[:3, 3] - T[:3, 3]) < 0.05


def test_a_pair_counts_as_one_feature_and_its_middle_is_met() -> None:
    T = in_line(1, 2, 3.0)
    y = seen(T)
    merged = np.vstack([np.delete(y, [1, 2], axis=0), y[1:3].mean(axis=0)])
    matches = judged_at(T, [view_of(merged)]).matches
    assert matches.merged.tolist() == [1]
    assert matches.met == pytest.approx([5.0])
    assert matches.squared.max() < 1e-6


def test_a_hidden_feature_beside_a_seen_one_is_no_pair() -> None:
    T = in_line(1, 2, 3.0)
    matches = judged_at(T, [view_of(np.delete(seen(T), 1, axis=0))]).matches
    assert matches.merged.tolist() == [0]
    assert matches.met == pytest.approx([5.0])


def test_a_false_detection_beside_a_hidden_feature_does_not_pull(
    pinhole_cameras: list[PinholeCamera],
) -> None:
    T = from_parts(Rotation.from_rotvec([0.3, -0.4, 0.2]).as_matrix(), np.array([50.0, 40.0, 5.0]))
    views = []
    for k, camera in enumerate(pinhole_cameras):
        points = camera.project(transform(T, POINTS))[0]
        points[2] += [2.0, 1.0] if k == 0 else [0.0, 0.0]
        pattern = PointPattern(points, np.ones(len(points)))
        views.append(View(str(k), camera, Observation(pattern, SIGMA)))
    tracker = Tracker.create(BODY, EstimatorOptions(), T)
    u, samples = tracker.start_uncertainty, tracker.samples

    def angle(errors: ErrorRules) -> float:
        fit = fit_near(views, BODY, T, u, tracker.options, samples, errors=errors)
        return float(rotation_angle_deg(fit.T_world_object, T))

    # at sigma the twelfth, 2.2 px off, pulls with more than half of its weight; the other eleven
    # are exact, and the last blur is too narrow for it to pull at all
    assert angle(ErrorRules(narrowest=1.0)) > 0.25
    assert angle(ErrorRules()) < 1e-3
