"""What the records refuse, since what passes here goes through every stage."""

from __future__ import annotations

import numpy as np
import pytest

import mixpose
from mixpose.body import Body, PointFeature
from mixpose.records import Estimate, PointPattern, SensorReport
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


def test_estimates_that_took_another_time_are_the_same() -> None:
    def lost(latency_ms: float, score: float = 0.1) -> Estimate:
        sensors = {"left": SensorReport(True, 0.1)}
        return Estimate(3, 0.12, "wand", "lost", None, None, score, sensors, latency_ms=latency_ms)

    assert lost(1.0) == lost(2.0)
    assert lost(1.0) != lost(1.0, score=0.2)
