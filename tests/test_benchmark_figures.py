"""The measuring tools: what they compare is the same thing, and figures are what they say."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tools"))

from benchmarks import frames_case, objective_case, pose_case, search_rows
from benchmarks.literal import LiteralObjective, samples_of
from benchmarks.search_cases import Row, absent, rows_named, trial
from benchmarks.search_rows import Outcome
from benchmarks.timing import medians, slope
from paper.systems import POINTS, pose

import mixpose
from mixpose.density import Observation
from mixpose.frames import images
from mixpose.objective import View
from mixpose.objective.paper import PaperObjective
from mixpose.rigid import transform
from mixpose.tracking import Track, Tracker, predict


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
    # mirrored pairs hit the means, Latin hypercube samples deviations far better than chance
    assert drawn.mean(axis=1) == pytest.approx(POINTS, abs=1e-9)
    assert drawn.std(axis=1) == pytest.approx(np.full((6, 3), 5.0), rel=0.01)
    # the same for all features, so that the body keeps its shape
    assert drawn - POINTS[:, None] == pytest.approx(np.tile(drawn[0] - POINTS[0], (6, 1, 1)))


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


@pytest.mark.parametrize("cameras", [1, 2])
def test_a_tracked_frame_is_predicted_a_few_pixels_off_and_estimated_anew_in_every_call(
    cameras: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    one = pose_case.trial(0)
    _, track = pose_case.warmed(one, cameras)
    times = (pose_case.WARM_FRAMES, pose_case.WARM_FRAMES * pose_case.PERIOD_S)
    predicted = predict(track, pose_case.BODY, *times)[0].T_world_object
    for sensor, y in zip(one.sensors[:cameras], one.detections):
        expected, _ = sensor.project(transform(predicted, POINTS))
        off = np.linalg.norm(expected[:, None] - y, axis=2).min(axis=1)
        # the start is off by 2.5 px on average, noise of the frames before adds a few tenths
        assert 0.5 < off.mean() < 5
    seen: list[Observation] = []
    advanced = Tracker.advance

    def noting(self: Tracker, track: Track, frame: int, time_s: float, views: list[View]) -> Any:
        seen.extend(view.observation for view in views)
        return advanced(self, track, frame, time_s, views)

    task = pose_case.advance(one, cameras)
    monkeypatch.setattr(Tracker, "advance", noting)
    assert task().status == task().status == "ok"
    assert len({id(each) for each in seen}) == 2 * cameras


def test_a_slope_is_the_power_by_which_time_grows() -> None:
    sizes = [1.0, 2.0, 4.0, 8.0]
    assert slope(sizes, [3.0 * size**1.5 for size in sizes]) == pytest.approx(1.5)


def test_tasks_take_turns_and_those_that_warm_up_do_not_count() -> None:
    turns: list[str] = []
    now = [0.0]

    def slow_at_first() -> None:
        now[0] += 0.001 if turns else 0.2
        turns.append("a")

    tasks = {"a": slow_at_first, "b": lambda: turns.append("b")}
    seconds = medians(tasks, rounds=1, calls=2, warm_up=1, clock=lambda: now[0])
    assert "".join(turns) == "aabb" * 2
    assert seconds == pytest.approx({"a": 0.001, "b": 0.0})


def outcome(status: str, *, first: bool, listed: bool, squared: float | None) -> Outcome:
    return Outcome(status, first, listed, squared, 1.0, 2.0)


def test_an_ambiguous_frame_whose_first_pose_is_wrong_is_no_success_of_the_search() -> None:
    seen = [
        outcome("ok", first=True, listed=True, squared=6.0),
        outcome("ok", first=False, listed=False, squared=60.0),
        outcome("ambiguous", first=False, listed=True, squared=None),
        outcome("ambiguous", first=True, listed=True, squared=None),
    ]
    empty = [outcome("lost", first=False, listed=False, squared=None)]
    row = search_rows.figures(rows_named([])[0], seen, empty)
    assert row["success"] == row["first"] == 0.5
    assert (row["listed"], row["ok"], row["wrong_ok"]) == (0.75, 0.5, 1)
    # the wrong pose counts for the covariance: 6 is inside chi2(0.95, 6) = 12.6, 60 is not
    assert (row["inside_95"], row["squared_per_dimension"]) == (0.5, 5.5)


def test_of_no_ok_frame_nothing_is_said_about_the_covariance() -> None:
    assert search_rows.consistency([]) == (None, None)


def test_the_squared_error_of_a_frame_counts_only_where_it_is_ok() -> None:
    frame = trial(Row("2 pinhole", 6, 0, 0, 0.99), 1)
    found = search_rows.outcome(frame)
    assert found.status == "ok"
    assert found.first
    assert found.squared is not None
    # six degrees of freedom: one in a million is above 40
    assert 0 < found.squared < 40
    assert search_rows.outcome(absent(Row("2 pinhole", 6, 0, 0, 0.99), 1)).squared is None


def test_a_frame_is_measured_beside_its_decoding(monkeypatch: pytest.MonkeyPatch) -> None:
    folder = Path(__file__).resolve().parents[1] / "data" / "synthetic" / "two_cameras"
    session, decoded, in_run = mixpose.load_session(folder / "session.toml"), list[str](), False
    read, by_frame = images.read_image, frames_case.by_frame

    def noting(path: Path) -> Any:
        decoded.append(path.name)
        assert not in_run, "frames are decoded before anything is timed"
        return read(path)

    def running(*arguments: Any) -> Any:
        nonlocal in_run
        in_run = True
        return by_frame(*arguments)

    monkeypatch.setattr(images, "read_image", noting)
    monkeypatch.setattr(frames_case, "by_frame", running)
    figures = frames_case.measured(session, frames=3)
    assert len(decoded) == 2 * 3
    assert figures["share_ok"] == 1
    assert 0 < figures["extract_ms"] < figures["slowest_tracked_ms"]
    # rooms share what a tracked frame takes; those below three per cent are left out
    assert 0.7 < sum(figures["rooms_ms"].values()) / figures["tracked_ms"] <= 1 + 1e-9
