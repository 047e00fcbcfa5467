"""A run as arrays: gaps, bands, errors, and which frames are worth looking at."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from report_runs import COVARIANCE, OFFSET, RECORDING, estimate, write, write_run
from scipy.spatial.transform import Rotation

from mixpose import rigid
from mixpose.errors import RecordingError
from mixpose.poses.jsonl import read_poses
from mixpose.records import Status
from mixpose.report import figures
from mixpose.report.figures import TimeAxes, blank, limit
from mixpose.report.overlays import chosen_frames
from mixpose.report.series import (
    errors_of,
    frame_ranges,
    jumps_of_turns,
    rotation_vector_jacobian,
    series_of,
)

STATUSES: dict[int, Status] = {5: "lost", 6: "lost", 7: "lost", 20: "ambiguous"}


@pytest.mark.parametrize("vector", [[0.3, -0.2, 0.5], [1e-6, 0, 0], [0.0, 3.1, 0.0], [0, 0, 0]])
def test_jacobian_of_rotation_vectors_is_their_numerical_derivative(vector: list[float]) -> None:
    h = 1e-6
    turn = Rotation.from_rotvec(vector)
    columns = [
        ((Rotation.from_rotvec(step) * turn).as_rotvec() - turn.as_rotvec()) / h
        for step in h * np.eye(3)
    ]
    # a difference of first order errs by about h
    assert rotation_vector_jacobian(np.array(vector)) == pytest.approx(
        np.stack(columns, axis=1), abs=1e-5
    )


def test_bands_at_the_reference_are_the_covariances_own(tmp_path: Path) -> None:
    series = series_of(read_poses(write_run(tmp_path / "poses.jsonl", {})))
    deviations = np.sqrt(np.diag(COVARIANCE))
    deviations[3:] = np.degrees(deviations[3:])
    assert series.turn_deg[0] == pytest.approx(np.zeros(3), abs=1e-7)
    assert series.half_width[0] == pytest.approx(1.96 * deviations, rel=1e-5)


def test_turned_poses_have_bands_of_the_turned_covariance(tmp_path: Path) -> None:
    start = rigid.from_rotation_vector([0, 0, 0], [0, 0, 0])
    turned = rigid.from_rotation_vector([0, 0, 2.0], [0, 0, 0])
    poses = write(tmp_path / "p.jsonl", [estimate(0, start), estimate(1, turned)], None)
    series = series_of(read_poses(poses))
    assert series.turn_deg[1] == pytest.approx([0, 0, np.degrees(2.0)], abs=1e-6)
    # about the axis of the turn a further turn simply adds
    assert series.half_width[1, 5] == pytest.approx(1.96 * 0.07, rel=1e-5)
    # across it the vector moves by more than the turn: θ/2 / sin(θ/2) = 1.19 for a common σ
    across = np.linalg.norm(series.half_width[1, 3:5]) / np.linalg.norm([0.05, 0.06]) / 1.96
    assert across == pytest.approx(1.0 / np.sin(1.0), rel=1e-4)


def test_lost_frames_are_gaps_in_every_line(tmp_path: Path) -> None:
    series = series_of(read_poses(write_run(tmp_path / "poses.jsonl", STATUSES)))
    _, axes = blank()
    for values in (series.position[:, 0], series.turn_deg[:, 2], series.rms["left"]):
        TimeAxes(axes, series).draw(values)
        drawn = np.asarray(axes.lines[-1].get_ydata())
        assert np.flatnonzero(np.isnan(drawn)).tolist() == [5, 6, 7]
    assert frame_ranges(series, "lost") == [(5, 7)]
    assert frame_ranges(series, "ambiguous") == [(20, 20)]


def test_lost_frames_are_shaded_half_a_frame_to_either_side(tmp_path: Path) -> None:
    series = series_of(read_poses(write_run(tmp_path / "poses.jsonl", STATUSES)))
    _, axes = blank()
    TimeAxes(axes, series)
    lost = np.flatnonzero(series.status == "lost")
    assert lost.tolist() == [5, 6, 7]
    half = 0.5 * (series.x[1] - series.x[0])
    (stretch,) = axes.collections[-1].get_paths()
    assert stretch.get_extents().x0 == pytest.approx(series.x[5] - half)
    assert stretch.get_extents().x1 == pytest.approx(series.x[7] + half)


def test_a_line_breaks_where_frames_are_left_out_and_where_a_turn_wraps(tmp_path: Path) -> None:
    T = np.eye(4)
    frames = [10, 12, 14, 20, 22]
    poses = write(tmp_path / "p.jsonl", [estimate(n, T) for n in frames], None)
    series = series_of(read_poses(poses))
    assert series.breaks.tolist() == [False, False, False, True, False]
    _, axes = blank()
    turns = np.zeros((5, 3))  # the axis is tilted, so that no component alone wraps
    turns[:, 0] = turns[:, 1] = np.array([170.0, 178.0, -178.0, -170.0, -160.0]) / np.sqrt(2)
    jumps = jumps_of_turns(turns)
    assert jumps.tolist() == [False, False, True, False, False]
    TimeAxes(axes, series, jumps).draw(turns[:, 2])
    drawn = np.asarray(axes.lines[-1].get_ydata())
    assert np.flatnonzero(np.isnan(drawn)).tolist() == [2, 4]
    assert frame_ranges(series, "ok") == [(10, 14), (20, 22)]


def test_values_fill_a_figure_and_not_the_widest_of_their_bands() -> None:
    _, axes = blank()
    values, widths = np.linspace(2.0, 4.0, 20), np.full(20, 0.05)
    widths[3] = 50.0
    limit(axes, values, None, widths)
    assert axes.get_ylim() == pytest.approx((1.88, 4.12))  # 6 % of what they span, to either side
    limit(axes, np.append(values, np.nan), np.array([6.0]), 8 * widths)
    assert axes.get_ylim() == pytest.approx((1.52, 6.48))  # 1.2 times a band that is usual
    limit(axes, np.full(20, 5.0), None, 0 * widths)
    assert axes.get_ylim() == pytest.approx((4.995, 5.005))  # held: a thousandth of it
    limit(axes, np.full(20, np.nan), None, widths)
    assert axes.get_ylim() == pytest.approx((4.995, 5.005))  # nothing to fill it


def test_a_single_frame_between_lost_ones_is_a_dot_in_a_long_run(tmp_path: Path) -> None:
    status = ["ok"] * 300
    status[100] = status[102] = "lost"
    estimates = [estimate(n, np.eye(4), s) for n, s in enumerate(status)]  # type: ignore[arg-type]
    series = series_of(read_poses(write(tmp_path / "p.jsonl", estimates, None)))
    _, axes = blank()
    TimeAxes(axes, series).draw(series.position[:, 0])
    assert axes.lines[-1].get_markevery() == [101]


@pytest.mark.parametrize("step_s", [0.04, 0.0])
def test_times_since_1970_and_equal_ones_have_ticks_that_can_be_read(
    tmp_path: Path, step_s: float
) -> None:
    series = series_of(read_poses(write_run(tmp_path / "poses.jsonl", {})))
    figure, axes = blank()
    times = np.array([1.7e9 + step_s * k for k in range(len(series.x))])
    TimeAxes(axes, replace(series, x=times))
    figure.draw_without_rendering()
    labels = [label.get_text() for label in axes.get_xticklabels()]
    # some twelve characters are an inch, and a figure is four inches wide
    assert 5 < sum(map(len, labels)) < 48
    assert axes.xaxis.get_offset_text().get_text().startswith("+1.7")


def test_errors_are_those_of_the_right_answer(tmp_path: Path) -> None:
    poses = read_poses(write_run(tmp_path / "poses.jsonl", STATUSES))
    truth = read_poses(RECORDING / "truth.jsonl")
    series = series_of(poses)
    errors = errors_of(series, poses, truth)
    assert np.flatnonzero(np.isnan(errors.distance)).tolist() == [5, 6, 7]
    assert np.nanmax(np.abs(errors.distance - np.linalg.norm(OFFSET[:3]))) < 1e-9
    assert np.nanmax(np.abs(errors.rotation_deg - 0.1)) < 1e-6
    true_places = np.array([line.T_world_object for line in truth.poses])[:, :3, 3]
    known = np.isfinite(errors.distance)
    assert errors.position[known] == pytest.approx(true_places[known], abs=1e-9)
    # the reference is a pose, and off itself: the true turn there is the error back
    assert errors.turn_deg[0] == pytest.approx([0, -0.1, 0], abs=1e-6)


def test_turns_add_nothing_to_the_distance_of_an_error(tmp_path: Path) -> None:
    truth = read_poses(RECORDING / "truth.jsonl")
    off = np.array([3.0, 0.0, -4.0, 0.3, 0.2, -0.1])
    poses = [(line.frame, line.T_world_object) for line in truth.poses]
    estimates = [estimate(frame, rigid.perturb(T, off)) for frame, T in poses if T is not None]
    found = read_poses(write(tmp_path / "poses.jsonl", estimates, None))
    errors = errors_of(series_of(found), found, truth)
    assert errors.distance == pytest.approx(5.0, abs=1e-9)
    assert errors.rotation_deg == pytest.approx(np.degrees(np.linalg.norm(off[3:])), abs=1e-9)


def test_frames_to_look_at_are_spaced_and_the_extremes(tmp_path: Path) -> None:
    series = series_of(read_poses(write_run(tmp_path / "poses.jsonl", {**STATUSES, 39: "lost"})))
    chosen = chosen_frames(series, None)
    assert list(chosen) == [0, 5, 13, 26, 38, 39]
    assert chosen[0] == "best score"  # scores fall from frame to frame
    assert chosen[38] == "worst score"  # a lost frame's score is not that of a pose
    assert chosen[5] == "first lost frame"
    assert chosen[13] == ""


def test_frame_numbers_longer_than_an_integer_of_the_machine_are_drawn(tmp_path: Path) -> None:
    frames = [10**30, 10**30 + 1]
    poses = write(tmp_path / "p.jsonl", [estimate(n, np.eye(4)) for n in frames], None)
    series = series_of(read_poses(poses))
    assert series.frames == tuple(frames)
    assert not series.breaks.any()


def test_poses_of_two_objects_are_refused_in_one_line(tmp_path: Path) -> None:
    estimates = [estimate(0, np.eye(4), object=name) for name in ("a", "b")]
    poses = read_poses(write(tmp_path / "p.jsonl", estimates, None))
    with pytest.raises(RecordingError, match="'a', 'b'; a series is of one body"):
        series_of(poses)


def test_frames_that_took_equally_long_are_within_their_axis(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write(tmp_path / "p.jsonl", [estimate(0, np.eye(4))], None)
    series = series_of(read_poses(path))
    figure, axes = blank()
    monkeypatch.setattr(figures, "blank", lambda: (figure, axes))
    figures.latency(replace(series, latency_ms=np.full(9, 30.0)))
    low, high = axes.get_xlim()
    assert low < 30 / 1.4 < 30 * 1.4 < high
