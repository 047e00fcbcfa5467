"""Calibrations of simulated rigs whose truth is known.

Where cameras are adjusted, what each knows alone is given 1 degree and 5 mm off, as searching for
it takes most of the time and has tests of its own.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from simulated_rigs import (
    ALL,
    BODY,
    FPS,
    NO_FRAME_HELD_BACK,
    PLACES,
    POINTS,
    alone,
    bumped,
    cameras,
    motion,
    recording,
    task_of,
)

from mixpose.calibration import CalibrationRules, Residual, Rig, SeenFrame, calibrate
from mixpose.calibration.adjust import _take_step, _weighted_pairs
from mixpose.calibration.bundle import Bundle, solve_step
from mixpose.calibration.gauge import gauge_rows
from mixpose.calibration.matching import clock_of, interpolate, match
from mixpose.calibration.recorded import folds_of
from mixpose.calibration.result import displacements
from mixpose.calibration.rig import State, blocks_of
from mixpose.calibration.searching import Saved
from mixpose.calibration.task import Hypotheses
from mixpose.calibration.telling import doubts_of, lines_of
from mixpose.errors import RecordingError
from mixpose.rigid import (
    from_rotation_vector,
    inverse,
    perturb,
    rotation_angle_deg,
    transform,
    twist_between,
)
from mixpose.sensors import RangeSensor

Floats = np.ndarray


def test_a_camera_off_by_2_degrees_and_20_mm_that_is_7_ms_late_is_put_right() -> None:
    sensors = cameras(2)
    frames = recording(sensors, 40, 0.02, late=0.007)
    task = bumped(task_of(sensors, frames, free={1: ("pose", "delay")}), 1, 2.0, 20.0)
    found = calibrate(task, found=alone(sensors, frames))
    T = found.after.sensors[1].T_sensor_world  # type: ignore[attr-defined]
    truth = sensors[1].T_sensor_world
    # the standard deviations that are told: 0.003 degrees, 0.04 mm, 0.02 ms
    assert rotation_angle_deg(T, truth) < 0.02
    assert np.linalg.norm(inverse(T)[:3, 3] - inverse(truth)[:3, 3]) < 0.1
    assert abs(found.after.delays[1] - 0.007) < 0.3e-3
    assert (found.deviations > 0).all()
    assert found.deviations[6] < 0.1e-3
    assert found.noise == pytest.approx(0.02, rel=0.2)
    assert found.residuals[1].held < 0.05 < found.residuals[1].before
    assert len(found.used) == 40


@pytest.mark.parametrize("deg", [0.0, 0.3, 4.0])
def test_cameras_that_stand_about_where_they_are_told_are_not_searched_alone(
    deg: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Another body like it beside it, which each camera alone takes for it as well."""
    monkeypatch.setattr("mixpose.calibration.searching._hypotheses", searched_in_vain)
    sensors = cameras(3)
    other = transform(from_rotation_vector([0.4, -0.3, 0.9], [150.0, 60, 90]), POINTS * 1.02)
    frames = recording(sensors, 20, 0.02)
    beside = recording(sensors, 20, 0.02, points=other, seed=2)
    both = tuple(
        replace(a, points={k: np.concatenate([y, b.points[k]]) for k, y in a.points.items()})
        for a, b in zip(frames, beside, strict=True)
    )
    task = bumped(task_of(sensors, both), 2, deg, 5 * deg)
    found = calibrate(task, NO_FRAME_HELD_BACK)
    assert len(found.used) == 20
    T = found.after.sensors[2].T_sensor_world  # type: ignore[attr-defined]
    assert rotation_angle_deg(T, sensors[2].T_sensor_world) < 0.02


@pytest.mark.parametrize("held", [0, 2])
def test_a_camera_that_is_held_stays_where_it_is_told_however_far_off(held: int) -> None:
    sensors = cameras(3)
    frames = recording(sensors, 12, 0.02)
    free = {s: ("pose",) for s in range(3) if s != held}
    task = bumped(task_of(sensors, frames, free=free), held, 4.0, 60.0)
    found = calibrate(task, NO_FRAME_HELD_BACK, found=alone(sensors, frames))
    assert found.after.sensors[held] is task.rig.sensors[held]


def test_a_bumped_camera_beside_right_ranges_is_put_right() -> None:
    truth = cameras(3)
    sensors: list[Any] = [*truth, *(RangeSensor(place) for place in PLACES)]
    frames = recording(sensors, 12, 0.02)
    task = bumped(task_of(sensors, frames, free={1: ("pose",), 2: ("pose",)}), 2, 4.0, 60.0)
    found = calibrate(task, NO_FRAME_HELD_BACK)
    T = found.after.sensors[2].T_sensor_world  # type: ignore[attr-defined]
    assert rotation_angle_deg(T, truth[2].T_sensor_world) < 0.2


def searched_in_vain(*_: object) -> None:
    raise AssertionError("cameras were searched alone")


def test_a_step_is_as_large_as_the_deviations_of_what_it_moves() -> None:
    sensors = cameras(2)
    frames = recording(sensors, 20, 0.02)
    task = bumped(task_of(sensors, frames, free={1: ("pose",)}), 1, 0.01, 0.1)
    blocks = blocks_of(task.rig, task.free, body=False, length=1.0, interval=1.0)
    poses = np.array([motion(frame.number / FPS) for frame in frames])
    known = np.zeros(6, np.bool_)
    bundle = Bundle(
        frames, blocks, known, lambda _: np.zeros((0, 6)), task.sigmas, CalibrationRules()
    )
    state, noise = State(task.rig, poses), np.full(2, 0.02)
    weighted, _ = _weighted_pairs(bundle, state, 4 * noise, noise, last=True)
    step = solve_step(bundle, state, weighted, 1e-9)
    _, size = _take_step(bundle, state, weighted)
    assert size == pytest.approx(np.abs(step.rig / np.sqrt(np.diag(step.covariance))).max())
    # 0.1 mm and 0.01 degrees, known to some hundredths of a mm: it is not yet where it will stay
    assert size > 1


def test_marker_coordinates_2_mm_off_are_learnt_up_to_the_gauge() -> None:
    sensors = cameras(2)
    rng = np.random.default_rng(3)
    off = rng.normal(size=POINTS.shape)
    true = POINTS + 2 * off / np.linalg.norm(off, axis=1)[:, None]
    frames = recording(sensors, 40, 0.02, points=true)
    task = task_of(sensors, frames, free={}, body_free=True)
    found = calibrate(task, NO_FRAME_HELD_BACK, found=alone(sensors, frames))
    a, b = (p - p.mean(axis=0) for p in (found.after.points, true))
    U, _, Vt = np.linalg.svd(a.T @ b)
    assert np.linalg.norm(a @ (U @ Vt) - b, axis=1).max() < 0.1
    assert found.gauge == ("the body's own frame stays where its features are on average",)


def test_three_range_sensors_30_mm_off_are_found_in_the_papers_gauge() -> None:
    rng = np.random.default_rng(4)
    off = rng.normal(size=(3, 3))
    off *= 30 / np.linalg.norm(off, axis=1)[:, None]
    frames = recording([RangeSensor(p) for p in PLACES], 40, 0.05)
    task = task_of(
        [RangeSensor(p) for p in PLACES + off],
        frames,
        5.0,
        free=dict.fromkeys(range(3), ("position",)),
        T_held=perturb(motion(0.0), np.array([2, -2, 1, 0.03, 0.02, -0.03])),
    )
    found = calibrate(task, NO_FRAME_HELD_BACK)
    places = np.array([s.position for s in found.after.sensors])  # type: ignore[attr-defined]

    def in_gauge(p: Floats) -> list[float]:
        c, a, b = (float(np.linalg.norm(p[i] - p[j])) for i, j in ((0, 1), (0, 2), (1, 2)))
        x = (a * a - b * b + c * c) / (2 * c)
        return [c, x, float(np.sqrt(a * a - x * x))]

    assert np.abs(np.array(in_gauge(places)) - in_gauge(PLACES)).max() < 0.5
    assert np.array_equal(places[0], (PLACES + off)[0])
    assert len(found.gauge) == 3
    # what the gauge holds is not moved by biases that are held; the rest is, by 5 mm and more
    assert "range biases, as exact" in "\n".join(lines_of(found, "mm"))


def test_ranges_of_no_body_are_refused() -> None:
    rng = np.random.default_rng(8)
    sensors = [RangeSensor(p) for p in PLACES]
    frames = tuple(
        replace(frame, points={k: rng.uniform(880, 1120, (6, 1)) for k in range(3)})
        for frame in recording(sensors, 6, 0.1)
    )
    free = dict.fromkeys(range(3), ("position",))
    known = {frame.number: motion(0.0) for frame in frames}
    task = task_of(sensors, frames, 1.0, free=free, known=known)
    with pytest.raises(RecordingError, match="as if by chance"):
        calibrate(task)


def test_a_residual_that_rises_in_frames_held_back_is_told() -> None:
    sensors = cameras(2)
    frames = recording(sensors, 12, 0.05)
    found = calibrate(task_of(sensors, frames), found=alone(sensors, frames))
    assert found.certainty > 0.98  # features are 1 px apart at least, detections good to 0.05 px
    assert doubts_of(found, "mm") == []
    rising = replace(found, residuals={1: Residual(9.0, 0.05, 0.08)}, certainty=0.6)
    assert [text[:8] for text in doubts_of(rising, "mm")] == ["40 % of ", "s1: the "]


@pytest.mark.parametrize("blur", [0.5, 3.0])
def test_of_pairs_that_compete_only_mutual_neighbours_are_nearest(blur: float) -> None:
    sensor = RangeSensor(np.array([0.0, 0.0, -1000.0]))
    rig = Rig.of(("s0",), [sensor], BODY)
    rig = replace(rig, points=np.array([[0, 0, 0], [0, 0, 2.0], [0, 0, 3.5]]))
    frame = SeenFrame(0, None, {0: np.array([[1000.1], [1003.4]])}, {})
    state = State(rig, np.eye(4)[None])
    pairs = match(state, [frame], clock_of([frame], 1, 2.5), 0, blur, 0.02)
    found = zip(pairs.feature[pairs.nearest], pairs.detection[pairs.nearest], strict=True)
    assert [(int(i), int(d)) for i, d in found] == [(0, 0), (2, 1)]


def test_range_biases_come_from_known_poses() -> None:
    sensors = [RangeSensor(p) for p in PLACES]
    true = [replace(s, range_bias=b) for s, b in zip(sensors, (120.0, 180.0, 260.0), strict=True)]
    frames = recording(true, 40, 1.0)
    known = {frame.number: motion(frame.number / FPS) for frame in frames}
    task = task_of(sensors, frames, 5.0, free=dict.fromkeys(range(3), ("range_bias",)), known=known)
    found = calibrate(task, NO_FRAME_HELD_BACK)
    biases = [s.range_bias for s in found.after.sensors]  # type: ignore[attr-defined]
    # 240 ranges of 1 mm noise each: 0.07 mm
    assert biases == pytest.approx([120, 180, 260], abs=0.3)


def test_what_a_body_that_never_moves_does_not_tell_is_refused_by_name() -> None:
    sensors = [RangeSensor(p) for p in PLACES]
    frames = recording(sensors, 12, 4.0)
    still = tuple(replace(frame, points=frames[0].points) for frame in frames)
    known = {frame.number: motion(0.0) for frame in still}
    free = {0: ("position", "range_bias")}
    found = calibrate(task_of(sensors, still, 5.0, free=free, known=known), NO_FRAME_HELD_BACK)
    assert found.refused
    assert all("s0:" in text for text in found.refused)
    assert np.isinf(found.deviations).any()


def test_a_camera_without_a_common_view_is_named_and_stays() -> None:
    sensors = cameras(3)
    frames = recording(sensors, 10, 0.05)
    frames = tuple(replace(f, points={k: y for k, y in f.points.items() if k != 2}) for f in frames)
    found = calibrate(task_of(sensors, frames), NO_FRAME_HELD_BACK, found=alone(sensors, frames))
    assert found.unlinked == (2,)
    assert found.after.sensors[2] is found.before.sensors[2]


def test_a_frame_of_clutter_is_left_out_by_number() -> None:
    sensors = cameras(2)
    frames = list(recording(sensors, 16, 0.05))
    known = alone(sensors, tuple(frames))
    rng = np.random.default_rng(5)
    noise = {k: rng.uniform(50, 450, (6, 2)) for k in (0, 1)}
    frames[5] = replace(frames[5], points=noise)
    task = bumped(task_of(sensors, tuple(frames)), 1, 1.0, 5.0)
    found = calibrate(task, NO_FRAME_HELD_BACK, found=known)
    assert 5 not in found.used
    truth = sensors[1].T_sensor_world
    assert rotation_angle_deg(found.after.sensors[1].T_sensor_world, truth) < 0.03  # type: ignore[attr-defined]


def test_a_check_names_the_one_camera_of_three_that_was_bumped() -> None:
    sensors = cameras(3)
    frames = recording(sensors, 14, 0.05)
    for index, turn_deg in ((0, 0.5), (2, 0.0)):
        found = calibrate(
            bumped(task_of(sensors, frames), index, turn_deg, 4.0),
            NO_FRAME_HELD_BACK,
            found=alone(sensors, frames),
        )
        told = displacements(found, CalibrationRules())
        assert [one.name for one in told if one.moved] == [f"s{index}"]
    found = calibrate(task_of(sensors, frames), NO_FRAME_HELD_BACK, found=alone(sensors, frames))
    assert not any(one.moved for one in displacements(found, CalibrationRules()))


@pytest.mark.parametrize(
    ("free", "body", "count"), [((1,), False, 0), ((0, 1), False, 6), ((0, 1), True, 13)]
)
def test_as_many_conditions_as_freedoms(free: tuple[int, ...], body: bool, count: int) -> None:
    rig = Rig.of(("a", "b"), cameras(2), BODY)
    poses = np.array([motion(time) for time in (0.1, 0.7, 1.6, 2.3)])
    blocks = blocks_of(rig, dict.fromkeys(free, ("pose",)), body=body, length=800.0, interval=1.0)
    rows, _ = gauge_rows(State(rig, poses), blocks, ALL)
    assert len(rows) == count
    known, _ = gauge_rows(State(rig, poses), blocks, ~ALL)
    assert len(known) == 0


def test_motion_between_frames_is_cubic() -> None:
    times = [k / FPS for k in range(8)]
    poses = np.array([motion(t) for t in times])
    clock = clock_of([SeenFrame(k, t, {}, {}) for k, t in enumerate(times)], 1, 2.5)
    there = interpolate(clock, poses, np.arange(8), np.full(8, 0.007))
    for k in range(1, 6):
        error = twist_between(perturb(poses[k], there.twist[k]), motion(times[k] + 0.007))
        # h^4/4! times the fourth derivative, 4.9^4 * 40 mm
        assert np.abs(error[:3]).max() < 2e-3
    assert there.known.all()


def test_every_fifth_frame_is_held_back_together_or_every_fifth_run() -> None:
    rules = CalibrationRules()
    assert np.bincount(folds_of(40, rules, runs=False)).tolist() == [8] * 5
    assert (folds_of(4, rules, runs=False) == -1).all()
    in_runs = np.flatnonzero(folds_of(40, rules, runs=True) == 2)
    assert in_runs.tolist() == [8, 9, 10, 11, 28, 29, 30, 31]


def test_what_was_searched_is_found_again(tmp_path: Path) -> None:
    path = tmp_path / "a.partial"
    with suppress(KeyboardInterrupt), Saved(path, "key") as first:
        first[3, 1] = Hypotheses(np.array([motion(0.3)]), np.array([7.0]))
        raise KeyboardInterrupt
    with suppress(KeyboardInterrupt), Saved(path, "key") as again:
        assert again.resumed == 1
        assert np.array_equal(again[3, 1].poses[0], motion(0.3))
        raise KeyboardInterrupt
    with Saved(path, "another") as other:
        assert other.resumed == 0
    assert not path.exists()
