"""The measuring tools: what they compare is the same thing, and figures are what they say."""

from __future__ import annotations

import sys
import time
from pathlib import Path

import cv2
import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tools"))

from benchmarks import objective_case, pose_case
from benchmarks.literal import LiteralObjective, samples_of
from benchmarks.timing import medians, slope
from paper.systems import POINTS, pose

from mixpose.objective.paper import PaperObjective


def test_the_literal_objective_has_the_values_of_ours() -> None:
    beta, seen, measurements, samples = objective_case.scene()
    flat = samples.reshape(-1, 3)
    cameras = objective_case.cameras(measurements)
    for off in (np.zeros(6), np.array([0.01, -0.02, 0.01, 2.0, -3.0, 1.0])):
        T = pose(beta + off)
        ours = PaperObjective(objective_case.value_terms(seen, samples, T), samples)
        expected = float(ours.value(T))
        # single precision of the densities; both interpolate bilinearly between the same pixels
        assert LiteralObjective(cameras, flat)(beta + off) == pytest.approx(expected, rel=1e-5)
    slow = LiteralObjective(cameras, flat, "RegularGridInterpolator")
    assert slow(beta + off) == pytest.approx(expected, rel=1e-5)


def test_samples_are_spread_about_every_feature_as_stated() -> None:
    drawn = samples_of(POINTS, 5.0, 1000, seed=0).reshape(6, 1000, 3)
    # Latin hypercube samples hit means and deviations far better than chance
    assert drawn.mean(axis=1) == pytest.approx(POINTS, abs=0.02)
    assert drawn.std(axis=1) == pytest.approx(np.full((6, 3), 5.0), rel=0.01)


def test_the_look_ups_compared_with_are_those_of_the_evaluation() -> None:
    beta, seen, _, samples = objective_case.scene()
    T = pose(beta)
    objective = PaperObjective(objective_case.value_terms(seen, samples, T), samples)
    calls = objective_case.remap_calls(lambda: objective.value(T))
    images = [arguments[0] for arguments, _ in calls]
    assert [image.ndim for image in images] == [2, 2]  # a value needs no gradients
    g_1, g_2 = (cv2.remap(*arguments, **named) for arguments, named in calls)
    assert g_1.size == samples.shape[0] * samples.shape[1]
    assert float((g_1 * g_2).mean(dtype=np.float64)) == pytest.approx(float(objective.value(T)))
    with pytest.raises(RuntimeError, match="nothing to compare"):
        objective_case.remap_calls(lambda: None)


def test_estimates_of_the_pose_case_end_nearer_than_they_start() -> None:
    trials = [pose_case.trial(seed) for seed in range(3)]
    start = pose_case.errors([pose(t.start) for t in trials], trials, "")
    found = [pose_case.warm(t)() for t in trials]
    ours = pose_case.errors(found, trials, "")
    # 0.2 px in two cameras, 0.9 px per mm and about 1 px per degree at 60 mm from the middle
    assert ours["error_mm"] < 0.4 < start["error_mm"]
    assert ours["error_deg"] < 0.3 < start["error_deg"]
    solved, *_ = pose_case.solve_pnp(trials[0])()
    assert solved


def test_a_slope_is_the_power_by_which_time_grows() -> None:
    sizes = [1.0, 2.0, 4.0, 8.0]
    assert slope(sizes, [3.0 * size**1.5 for size in sizes]) == pytest.approx(1.5)


def test_tasks_take_turns_and_those_that_warm_up_do_not_count() -> None:
    turns: list[str] = []

    def slow_at_first() -> None:
        if not turns:
            time.sleep(0.2)
        turns.append("a")

    tasks = {"a": slow_at_first, "b": lambda: turns.append("b")}
    seconds = medians(tasks, rounds=1, calls=2, warm_up=1)
    assert "".join(turns) == "aabb" * 2
    assert seconds["a"] < 0.1
