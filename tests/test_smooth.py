"""Poses smoothed over a recording: least squares where it is linear, consistent elsewhere."""

from __future__ import annotations

import json
from dataclasses import replace
from math import factorial
from pathlib import Path

import numpy as np
import pytest
from command_line import command
from pose_lines import (
    covariance_of,
    lines_of,
    measured,
    pose_line,
    rms_errors,
    squared_errors,
    swinging,
    write_poses,
)

import mixpose as package
from mixpose import rigid
from mixpose.errors import RecordingError
from mixpose.poses.evaluate import evaluate_files
from mixpose.poses.jsonl import read_poses
from mixpose.records import Estimate, Floats
from mixpose.trajectories.choices import unwrapped
from mixpose.trajectories.intensity import SmoothingRules
from mixpose.trajectories.motion import States, predicted
from mixpose.trajectories.smoothing import smooth_body
from mixpose.trajectories.track import MotionModel, smooth_track, track_of

ROOT = Path(__file__).parents[1]
QUICK = SmoothingRules(frames=40, block=40)  # enough to tell how the bodies of these tests move


def poses_of(estimates: tuple[Estimate, ...]) -> Floats:
    return np.stack([one.T_world_object for one in estimates if one.T_world_object is not None])


def test_positions_are_those_of_least_squares_over_the_whole_recording() -> None:
    # white noise on acceleration, no turns: the smoother is linear, and the poses with the largest
    # probability are the solution of one sparse system of equations, written out here
    n, step, q = 12, 0.1, 50.0
    rng = np.random.default_rng(3)
    poses = rigid.from_parts(np.eye(3), rng.normal(size=(n, 3)).cumsum(axis=0))
    covariance = covariance_of(0.5, 0.01)
    covariance[:3, 3:] = covariance[3:, :3] = 0
    track = track_of(
        np.linspace(0, (n - 1) * step, n),
        poses,
        np.repeat(covariance[None], n, axis=0),
        np.ones(n, bool),
    )
    found = smooth_track(track, MotionModel(2, np.array([q, 1e-9])))

    F = np.kron([[1, step], [0, 1]], np.eye(3))
    Q = q * np.kron([[step**3 / 3, step**2 / 2], [step**2 / 2, step]], np.eye(3))
    information, right = np.zeros((6 * n, 6 * n)), np.zeros(6 * n)
    for k in range(n):
        at = slice(6 * k, 6 * k + 3)
        information[at, at] += np.linalg.inv(track.covariances[k, :3, :3])
        right[at] += np.linalg.solve(track.covariances[k, :3, :3], poses[k, :3, 3])
    for k in range(n - 1):
        both = slice(6 * k, 6 * k + 12)
        row = np.concatenate([-F, np.eye(6)], axis=1)
        information[both, both] += row.T @ np.linalg.solve(Q, row)
    solution = np.linalg.solve(information, right).reshape(n, 6)
    inverse = np.linalg.inv(information)

    deviations = np.sqrt(np.diagonal(inverse)).reshape(n, 6)[:, :3]
    # of the first velocity a prior is known, ten times as wide as the motion: 1e-3 of a deviation
    assert np.abs(found.poses[:, :3, 3] - solution[:, :3]).max() < 5e-3 * deviations.min()
    smoothed = np.sqrt(np.diagonal(found.covariances, axis1=1, axis2=2))[:, :3]
    np.testing.assert_allclose(smoothed, deviations, rtol=5e-3)


@pytest.mark.parametrize("order", [2, 3, 4, 5])
def test_a_body_without_noise_goes_on_as_its_rates_say(order: int) -> None:
    # in a thousand small steps of a turn each, which need no series
    rng = np.random.default_rng(order)
    rates = rng.normal(size=(1, order - 1, 6)) * 0.5
    states = States(np.eye(4)[None], rates, np.eye(6 * order)[None] * 1e-6)
    elapsed, steps = 0.2, 1000
    found, F = predicted(states, elapsed, np.zeros((1, 6)))
    T, dt = np.eye(4), elapsed / steps
    for k in range(steps):
        s = (k + 0.5) * dt
        now = sum(rates[0, j] * s**j / factorial(j) for j in range(order - 1))
        T = rigid.perturb(T, np.asarray(now) * dt)
    # what Magnus' series leaves out is of the fifth order in 0.2 s: 3e-4 times a few percent
    np.testing.assert_allclose(found.poses[0], T, atol=2e-5)
    # an error of a rate leads to one of the pose, to first order in the turn of about 0.2 rad
    for i in range(6, 6 * order):
        moved = rates.copy().reshape(-1)
        moved[i - 6] += 1e-4
        shifted = states._replace(rates=moved.reshape(rates.shape))
        other, _ = predicted(shifted, elapsed, np.zeros((1, 6)))
        slope = other.minus(found)[0] / 1e-4
        np.testing.assert_allclose(F[0, :, i], slope, atol=0.2**2 / 2 * elapsed)


def test_errors_shrink_and_covariances_hold_where_errors_are_independent() -> None:
    truth, covariance = swinging(60), covariance_of(0.1, 0.001)
    squared = []
    for seed in range(5):
        poses = measured(truth, covariance, seed)
        smooth = smooth_body(lines_of(poses, covariance), rules=QUICK)
        before, after = rms_errors(truth, poses), rms_errors(truth, poses_of(smooth.estimates))
        assert after[0] < 0.6 * before[0]
        assert after[1] < 0.6 * before[1]
        squared.append(squared_errors(truth, smooth.estimates).mean())
        assert smooth.model is not None
        assert smooth.model.white == 1.0
    # 60 frames of about 5 that count together: 70 numbers, whose mean square is 1 ± 0.17, of five
    # recordings 1 ± 0.08
    assert 0.6 < min(squared) <= max(squared) < 1.5
    assert 0.8 < np.mean(squared) < 1.2


@pytest.mark.parametrize(("scale", "held"), [(0.5, True), (1.7, False)])
def test_what_lasts_stays_in_the_covariance_and_what_scatters_more_enlarges_it(
    scale: float, held: bool
) -> None:
    truth, covariance = swinging(100), covariance_of(0.1, 0.001)
    lasting = np.linalg.cholesky(covariance) @ np.array([0.8, -0.9, 0.7, 1.0, -0.8, 0.9])
    moved = rigid.perturb(truth, np.repeat(lasting[None] * held, len(truth), 0))
    poses = measured(moved, covariance, seed=2, scale=scale)
    smooth = smooth_body(lines_of(poses, covariance), rules=QUICK)
    assert smooth.model is not None
    # of the variances a quarter, or 2.9 times as much, scatters; known to 15 % from 40 frames
    assert smooth.model.white == pytest.approx(scale**2, rel=0.45)
    # what lasts is three quarters of a variance, in one draw for the whole recording
    assert 0.5 < squared_errors(truth, smooth.estimates).mean() < 1.25


def zigzag(frames: int, every: int) -> tuple[Floats, list[int]]:
    """A body that turns back at once, and the frames in which it does."""
    k = np.arange(frames) % (2 * every)
    way = np.where(k < every, k, 2 * every - k).astype(float)
    zero = np.zeros(frames)
    poses = rigid.from_rotation_vector(
        np.stack([0.01 * way, zero, -0.004 * way], 1), np.stack([way, zero, 0.3 * way], 1)
    )
    return poses, list(range(every, frames - 1, every))


def test_a_body_that_is_put_elsewhere_at_times_shows_what_its_poses_err_by() -> None:
    """Jumps make steady motion so wild that poses seem to scatter by nothing else."""
    rng, covariance = np.random.default_rng(0), covariance_of(0.1, 0.001)
    shifts, turns = rng.uniform(-80, 80, (4, 3)), rng.uniform(-0.5, 0.5, (4, 3))
    truth = rigid.from_rotation_vector(turns, shifts)[np.arange(80) // 20]
    poses = measured(truth, covariance, 1, scale=2.0)
    smooth = smooth_body(lines_of(poses, covariance), motion="acceleration", rules=QUICK)
    assert smooth.model is not None
    # known to 15 % from 40 frames; by steady motion alone it is 1
    assert smooth.model.white == pytest.approx(4.0, rel=0.35)
    assert 0.5 < squared_errors(truth, smooth.estimates).mean() < 1.3


def test_corners_of_a_path_are_not_overshot() -> None:
    truth, turns = zigzag(100, 25)
    covariance = covariance_of(0.1, 0.001)
    worst, squared = [], []
    for seed in range(2):
        poses = measured(truth, covariance, seed)
        smooth = smooth_body(lines_of(poses, covariance), motion="acceleration", rules=QUICK)
        for turn in turns:
            for frame in (turn - 1, turn, turn + 1):
                T, C = (
                    getattr(smooth.estimates[frame], k) for k in ("T_world_object", "covariance")
                )
                error = rigid.twist_between(truth[frame], T) / np.sqrt(C.diagonal())
                # the way on is that of x and z, and the turn about x and z
                worst.append(np.abs(error[[0, 2, 3, 5]]).max())
                squared.append((error**2).mean())
    # noise alone takes one of 72 numbers beyond 3 in a fifth of all tests; a smoother with one
    # intensity throughout overshoots by 6.6
    assert np.mean(np.array(worst) > 3) <= 0.1
    assert max(worst) < 4
    assert np.mean(squared) < 1.6


def reaching(frames: int, seed: int) -> Floats:
    """A hand that reaches for a place within 1.2 s, rests there for 2.4 s, sways and shakes."""
    rng = np.random.default_rng(seed)
    places = np.cumsum(rng.uniform(-1, 1, (frames // 90 + 2, 6)), axis=0) * np.repeat([80, 0.4], 3)
    k, way = np.divmod(np.arange(frames), 90)
    s = np.minimum(way / 30, 1)[:, None]
    at = places[k] + np.diff(places, axis=0)[k] * (10 * s**3 - 15 * s**4 + 6 * s**5)  # least jerk
    for slowest_hz, fastest_hz, width in ((0.2, 0.6, 2.0), (2.0, 3.0, 0.2)):
        turns = np.outer(0.04 * np.arange(frames), rng.uniform(slowest_hz, fastest_hz, 6))
        at += np.repeat([width, width / 100], 3) * np.sin(2 * np.pi * (turns + rng.random(6)))
    return rigid.from_rotation_vector(at[:, 3:], at[:, :3])


def test_a_hand_that_rests_and_shakes_errs_by_what_covariances_say() -> None:
    covariance, rules, squared = covariance_of(0.3, 0.003), replace(QUICK, frames=120), []
    for seed in range(2):
        truth = reaching(180, seed)
        smooth = smooth_body(lines_of(measured(truth, covariance, seed), covariance), rules=rules)
        for one, T in zip(smooth.estimates, truth, strict=True):
            assert one.T_world_object is not None
            assert one.covariance is not None
            error = rigid.twist_between(T, one.T_world_object)
            squared.append(error @ np.linalg.solve(one.covariance, error) / 6)
    # 1.3 where a body that shakes by less than poses err is believed to rest as still as it looks
    assert 0.8 < np.mean(squared) < 1.2


def test_one_wrong_pose_that_was_ok_does_not_bend_the_path() -> None:
    truth, covariance = swinging(60), covariance_of(0.1, 0.001)
    poses = measured(truth, covariance)
    poses[30] = rigid.perturb(poses[30], np.array([0, 12.0, 0, 0.3, 0, 0]))
    smooth = smooth_body(lines_of(poses, covariance), rules=QUICK)
    assert smooth.refused == (30,)
    assert smooth.estimates[30].status == "ambiguous"
    near = np.r_[26:30, 31:35]
    assert squared_errors(truth, smooth.estimates)[near].mean() < 2


def test_gaps_are_filled_on_request_marked_and_covered_by_their_covariance() -> None:
    truth, covariance = swinging(60), covariance_of(0.1, 0.001)
    lines = lines_of(measured(truth, covariance), covariance)
    for k in (12, 13):
        lines[k] = pose_line(k, None, None)  # lost
    lines[30:50] = []  # no line at all
    plain = smooth_body(lines, rules=QUICK)
    assert [one.frame for one in plain.estimates] == [line.frame for line in lines]
    assert [one.status for one in plain.estimates[12:14]] == ["lost", "lost"]
    filled = smooth_body(lines, rules=QUICK, fill_s=0.2)  # the gap of 20 frames is 0.84 s
    marked = [one for one in filled.estimates if one.filled]
    assert [one.frame for one in marked] == [12, 13]
    assert (filled.smoothed, filled.filled, filled.decided) == (38, 2, 0)
    assert {one.status for one in marked} == {"ambiguous"}
    assert [one.time_s for one in marked] == pytest.approx([0.48, 0.52])
    assert squared_errors(truth[12:14], marked).max() < 3
    variance = [np.trace(one.covariance[:3, :3]) for one in filled.estimates[11:14]]  # type: ignore[index]
    assert variance[1] > variance[0]
    whole = smooth_body(lines, rules=QUICK, fill_s=1.0)
    assert [one.frame for one in whole.estimates] == list(range(60))


def test_directions_that_are_held_stay_where_they_are() -> None:
    truth = rigid.from_rotation_vector(
        np.stack([np.zeros(60), np.zeros(60), np.sin(np.arange(60) / 9)], 1),
        np.stack([np.arange(60) * 2.0, np.cos(np.arange(60) / 7) * 30, np.full(60, 5.0)], 1),
    )
    covariance = np.diag([0.04, 0.09, 0, 0, 0, 1e-4])
    errors = np.random.default_rng(0).normal(size=(60, 6)) * np.sqrt(covariance.diagonal())
    smooth = smooth_body(lines_of(rigid.perturb(truth, errors), covariance), rules=QUICK)
    poses = poses_of(smooth.estimates)
    np.testing.assert_allclose(poses[:, 2, 3], 5.0, atol=1e-9)
    np.testing.assert_allclose(poses[:, 2, :3], [[0, 0, 1]] * 60, atol=1e-9)
    covariances = np.array([one.covariance for one in smooth.estimates])
    assert not covariances[:, [2, 3, 4]].any()
    assert rms_errors(truth, poses)[0] < 0.8 * np.sqrt((errors[:, :3] ** 2).mean())


def test_a_symmetric_body_that_is_called_turned_is_followed() -> None:
    # half a turn about an axis beside the origin: the same to look at, another pose
    half = rigid.from_rotation_vector([0, 0, np.pi], [20.0, 10.0, 0])
    truth, covariance = swinging(50), covariance_of(0.1, 0.001)
    poses = measured(truth, covariance)
    there = np.arange(50) % 3 == 1
    C = [rigid.covariance_at(covariance, (T @ half)[:3, 3] - T[:3, 3]) for T in poses]
    lines = [
        pose_line(k, T @ half if there[k] else T, C[k] if there[k] else covariance)
        for k, T in enumerate(poses)
    ]
    smooth = smooth_body(lines, np.stack([np.eye(4), half]), rules=QUICK)
    assert rms_errors(truth, poses_of(smooth.estimates))[0] < 0.08
    assert squared_errors(truth, smooth.estimates).mean() < 1.6


def test_poses_that_look_the_same_are_turned_like_the_last_that_was_ok() -> None:
    half_turn = rigid.from_rotation_vector([0.0, 0.0, np.pi], [6.0, 4.0, 0.0])
    T, covariance = swinging(1)[0], np.diag([1, 2, 3, 0.1, 0.2, 0.3]) ** 2
    turned = T @ rigid.inverse(half_turn)
    lines = [
        pose_line(0, None, None),
        pose_line(1, T, covariance),
        pose_line(2, None, None),
        pose_line(3, turned, covariance, status="ambiguous"),
        pose_line(4, turned, covariance),
        pose_line(5, T, covariance),
    ]
    symmetries = np.array([np.eye(4), half_turn])
    found = unwrapped(lines, symmetries)
    assert [one.T_world_object is None for one in found] == [True, False, True] + 3 * [False]
    for one in found[3:]:
        assert one.T_world_object is not None
        np.testing.assert_allclose(one.T_world_object, T, atol=1e-9)
    # what is known of another point of the body is known by the same turns
    assert found[4].covariance is not None
    np.testing.assert_allclose(found[4].covariance[3:, 3:], covariance[3:, 3:], atol=1e-12)
    assert np.trace(found[4].covariance[:3, :3]) > np.trace(covariance[:3, :3])
    assert unwrapped(lines, symmetries[:1]) == lines


def test_what_cannot_be_smoothed_is_told() -> None:
    truth, covariance = swinging(20), covariance_of(0.1, 0.001)
    lines = lines_of(truth, covariance)
    with pytest.raises(RecordingError, match="frame 3 of 'tool' stands twice"):
        smooth_body([*lines, lines[3]])
    with pytest.raises(RecordingError, match=r"line 7: .* has no covariance"):
        smooth_body([replace(one, covariance=None) if one.frame == 5 else one for one in lines])
    with pytest.raises(RecordingError, match="--fill: found poses without times"):
        smooth_body([replace(one, time_s=None) for one in lines], fill_s=1.0)
    few = smooth_body(lines[:5])
    assert few.model is None
    np.testing.assert_array_equal(poses_of(few.estimates), truth[:5])


@pytest.mark.parametrize("recording", ["two_cameras", "camera_and_ranges"])
def test_poses_of_recordings_err_by_at_most_0_7_of_what_they_did(
    recording: str, tmp_path: Path
) -> None:
    folder = ROOT / "data/synthetic" / recording
    poses, output, truth = (
        tmp_path / "poses.jsonl",
        tmp_path / "smooth.jsonl",
        folder / "truth.jsonl",
    )
    write_poses(poses, list(package.run(package.load_session(folder / "session.toml"))))
    done = command("smooth", poses, "-o", output)
    assert done.returncode == 0, done.stderr
    before, after = evaluate_files(poses, truth), evaluate_files(output, truth)
    assert before.rotation_deg is not None
    assert after.rotation_deg is not None
    assert before.translation is not None
    assert after.translation is not None
    assert after.rotation_deg.rms < 0.7 * before.rotation_deg.rms
    # 0.92 where ranges were off by the same from frame to frame, with a squared error of 1.7
    assert after.translation.rms < 0.7 * before.translation.rms
    assert after.nees is not None
    assert after.nees.mean_per_dimension < 1.25
    (header,) = read_poses(output).header["smoothed"].values()
    assert header["motion"] == "crackle"
    again = command("smooth", output, "-o", tmp_path / "twice.jsonl")
    assert again.returncode == 3
    assert "was smoothed before" in again.stderr


def test_the_recording_that_the_poses_are_of_stays_in_the_header(tmp_path: Path) -> None:
    path, output = tmp_path / "poses.jsonl", tmp_path / "smooth.jsonl"
    write_poses(path, lines_of(swinging(12), covariance_of(0.1, 0.001)))
    header, *lines = path.read_text(encoding="utf-8").splitlines()
    sources = {"left": "tuesday/left*.png"}
    told = json.dumps({**json.loads(header), "sources": sources})
    path.write_text("\n".join([told, *lines, ""]), encoding="utf-8")
    done = command("smooth", path, "--motion", "acceleration", "-o", output)
    assert done.returncode == 0, done.stderr
    assert read_poses(output).sources == sources


def test_the_command_writes_all_bodies_in_the_order_of_frames(tmp_path: Path) -> None:
    covariance, poses = covariance_of(0.1, 0.001), swinging(12)
    lines = [
        replace(line, object=name, tip_object=tip)
        for line in lines_of(poses, covariance)
        for name, tip in (("tool", np.array([0, 0, -100.0])), ("base", None))
    ]
    path = tmp_path / "poses.jsonl"
    write_poses(path, lines)
    done = command("smooth", path, "--motion", "acceleration")
    assert done.returncode == 0, done.stderr
    found = [json.loads(line) for line in done.stdout.splitlines()[1:]]
    assert [(one["frame"], one["object"]) for one in found] == [
        (k, name) for k in range(12) for name in ("tool", "base")
    ]
    # the tip goes with the smoothed pose
    T = np.array(found[4]["T_world_object"])
    np.testing.assert_allclose(found[4]["tip"], T[:3, :3] @ [0, 0, -100] + T[:3, 3], atol=1e-9)
    assert "tip" not in found[5]
