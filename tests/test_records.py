"""What the records refuse, since what passes here goes through every stage."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest

import mixpose
from mixpose.body import Body, PointFeature
from mixpose.records import Estimate, PointPattern, SensorReport, replace
from mixpose.rigid import from_rotation_vector
from mixpose.sensors import PinholeCamera

POINTS = np.array([[10.0, 20.0], [30.0, 40.0]])


@pytest.mark.parametrize(
    ("points", "weights", "said"),
    [
        (POINTS[:, None], np.ones(2), r"points: found the shape \(2, 1, 2\)"),
        (POINTS[0], np.ones(2), r"points: found the shape \(2,\)"),
        (POINTS, np.ones(3), r"weights: found the shape \(3,\); allowed: \(2,\)"),
        (POINTS * [[1.0], [np.nan]], np.ones(2), "NaN or infinity"),
        (POINTS, np.array([1.0, np.inf]), "NaN or infinity"),
        (POINTS, np.array([1.0, -2.0]), "weights: found -2; allowed: 0 or more"),
    ],
)
def test_points_that_cannot_be_meant_are_refused(
    points: np.ndarray, weights: np.ndarray, said: str
) -> None:
    with pytest.raises(ValueError, match=said):
        PointPattern(points, weights)


def test_a_record_with_other_fields_keeps_the_rest_and_nothing_computed_from_them() -> None:
    estimate = Estimate(3, None, "wand", "ok", np.eye(4), np.eye(6), 0.9, {})
    assert estimate.offsets == {}
    changed = replace(estimate, status="lost", covariance=None)
    assert vars(changed) == vars(dataclasses.replace(estimate, status="lost", covariance=None))
    pattern = replace(PointPattern(POINTS, np.ones(2)), points=[[1, 2], [3, 4]])  # type: ignore[arg-type]
    assert pattern.points.dtype == np.float64  # checked as if it were new
    with pytest.raises(TypeError, match=r"found \['state'\]; allowed: \['frame',"):
        replace(estimate, state="ok")  # type: ignore[call-arg]


def test_lists_and_other_types_become_float64() -> None:
    pattern = PointPattern([[1, 2], [3, 4]], [1, 1])  # type: ignore[arg-type]
    assert pattern.points.dtype == pattern.weights.dtype == np.float64
    assert pattern.points.tolist() == [[1.0, 2.0], [3.0, 4.0]]


def test_a_single_estimate_refuses_a_start_views_and_a_width_that_cannot_be_meant() -> None:
    body = Body("wand", tuple(PointFeature(point) for point in 100.0 * np.eye(3)))
    camera = PinholeCamera(np.array([[700.0, 0, 320], [0, 700, 240], [0, 0, 1]]))
    pattern = PointPattern(POINTS, np.ones(2))
    view = mixpose.View("camera", camera, mixpose.Observation(pattern, sigma=1.5))
    with pytest.raises(ValueError, match="start: not a rotation"):
        mixpose.estimate_pose([view], body, np.full((4, 4), np.nan))
    ranges = mixpose.Observation(PointPattern(POINTS[:, :1], np.ones(2)), sigma=1.5)
    with pytest.raises(ValueError, match="features of 1 coordinates; its sensor has 2"):
        mixpose.estimate_pose([mixpose.View("camera", camera, ranges)], body)
    with pytest.raises(ValueError, match="sigma: found 0"):
        mixpose.Observation(pattern, sigma=0)


K = np.array([[700.0, 0, 320], [0, 700, 240], [0, 0, 1]])


@pytest.mark.parametrize(
    ("features", "camera", "said"),
    [
        (np.eye(3), {}, "feature 1 of 'wand': found ndarray; allowed: a PointFeature"),
        ([[0.0, np.nan, 0.0]], {}, "feature 1 of 'wand', its position: found NaN or infinity"),
        ([[0.0, 1.0]], {}, r"its position: found shape \(2,\); allowed: finite numbers"),
        (None, {"camera_matrix": np.eye(2)}, r"camera_matrix of its sensor: found shape \(2, 2\)"),
        (None, {"camera_matrix": K * np.nan}, "camera_matrix of its sensor: found NaN"),
        (None, {"T_sensor_world": np.diag([1, 1, -1, 1.0])}, "T_sensor_world of its sensor: not a"),
        ([[1.0, 2.0, 3.0]] * 3, {}, "body 'wand': all features are at one place"),
        (None, {"distortion": np.full(5, np.nan)}, "distortion of its sensor: found NaN"),
        (None, {"resolution": (640, 0)}, "resolution of its sensor: allowed: pixels, 1 or more"),
    ],
    ids=[
        "no features",
        "NaN",
        "two numbers",
        "2x2",
        "NaN in a matrix",
        "mirrored",
        "one place",
        "NaN in a lens",
        "no pixels",
    ],
)
def test_a_single_estimate_refuses_bodies_and_cameras_that_cannot_be_meant(
    features: Any, camera: dict[str, Any], said: str
) -> None:
    points = 100.0 * np.eye(3) if features is None else features
    made = points if isinstance(features, np.ndarray) else [PointFeature(one) for one in points]
    body = Body("wand", tuple(made))
    sensor = PinholeCamera(**{"camera_matrix": K, **camera})
    view = mixpose.View(
        "camera", sensor, mixpose.Observation(PointPattern(POINTS, np.ones(2)), sigma=1.5)
    )
    with pytest.raises(ValueError, match=said):
        mixpose.estimate_pose([view], body)


def test_a_single_estimate_refuses_a_view_that_is_given_twice_and_a_variance_below_zero() -> None:
    view = mixpose.View(
        "camera", PinholeCamera(K), mixpose.Observation(PointPattern(POINTS, np.ones(2)), sigma=1.5)
    )
    body = Body("wand", tuple(PointFeature(point) for point in 100.0 * np.eye(3)))
    with pytest.raises(ValueError, match="view 'camera': given twice"):
        mixpose.estimate_pose([view, view], body)
    below = Body("wand", (*body.features, PointFeature(np.ones(3), np.diag([1.0, -1.0, 1.0]))))
    with pytest.raises(ValueError, match="feature 4 of 'wand': a covariance with a variance below"):
        mixpose.estimate_pose([view], below)


def test_views_of_a_single_estimate_may_come_one_by_one_but_not_be_missing() -> None:
    rng = np.random.default_rng(3)
    points, eye = rng.uniform(-50, 50, (6, 3)), PinholeCamera(K)
    T = from_rotation_vector(np.array([0.2, -0.1, 0.3]), np.array([5.0, -8.0, 600.0]))
    y, _ = eye.project(points @ T[:3, :3].T + T[:3, 3])
    body = Body("wand", tuple(PointFeature(point) for point in points))
    view = mixpose.View("camera", eye, mixpose.Observation(PointPattern(y, np.ones(6)), sigma=1.5))
    found = mixpose.estimate_pose((each for each in [view]), body, T)
    assert found.status == mixpose.estimate_pose([view], body, T).status == "ok"
    assert found.T_world_object == pytest.approx(T, abs=1e-3)
    with pytest.raises(ValueError, match="views: found none; allowed: one or more"):
        mixpose.estimate_pose([], body)


def test_estimates_that_took_another_time_are_the_same() -> None:
    def lost(latency_ms: float, score: float = 0.1) -> Estimate:
        sensors = {"left": SensorReport(True, 0.1)}
        return Estimate(3, 0.12, "wand", "lost", None, None, score, sensors, latency_ms=latency_ms)

    assert lost(1.0) == lost(2.0)
    assert lost(1.0) != lost(1.0, score=0.2)
