"""The tip of a tool, from poses while it turns about the tip."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command_line import assert_one_line, command
from pose_lines import covariance_of, lines_of, measured, write_poses
from scipy.signal import lfilter
from scipy.stats import chi2

import mixpose as package
from mixpose import rigid
from mixpose.errors import RecordingError
from mixpose.records import Floats
from mixpose.trajectories.pivot import Pivoting, PivotRules, find_tip, fixed_in, fixed_in_world

TIP, POINT = np.array([3.0, -8.0, -150.0]), np.array([40.0, 20.0, 900.0])
INSIDE_95 = 7.815  # χ² of three


def turning(frames: int, tilt_deg: float = 25, spin_deg: float = 60) -> Floats:
    """Rotations (N, 3, 3) of a tool in a hand."""
    s = np.arange(frames) / frames * 2 * np.pi
    tilt, spin = np.radians([tilt_deg, spin_deg])
    return rigid.rotation_matrix(
        np.stack([tilt * np.sin(3 * s), tilt * np.cos(2 * s), spin * np.sin(s)], axis=1)
    )


def about_its_tip(R: Floats, points: Floats) -> Floats:
    return rigid.from_parts(R, points - R @ TIP)


def run_of(
    seed: int,
    *,
    reference: bool = False,
    tilt_deg: float = 25,
    spin_deg: float = 60,
    turn: float = 0.002,
) -> Pivoting:
    n = 100
    R = turning(n, tilt_deg, spin_deg)
    covariance = covariance_of(0.1, turn, seed)
    covariances = np.repeat(covariance[None], n, axis=0)
    if not reference:
        poses = about_its_tip(R, np.repeat(POINT[None], n, 0))
        return fixed_in_world(measured(poses, covariance, seed), covariances)
    s = np.linspace(0, 5, n)
    held = rigid.from_rotation_vector(
        np.stack([0.2 * np.sin(s), 0.1 * s, 0.3 * np.cos(s)], 1), np.stack([30 * s, 9 * s, s], 1)
    )
    poses = about_its_tip(held[:, :3, :3] @ R, rigid.transform(held, POINT[None])[:, 0])
    pivoting = fixed_in_world(measured(poses, covariance, seed), covariances)
    return fixed_in(pivoting, measured(held, covariance, seed + 1000), covariances)


@pytest.mark.parametrize("reference", [False, True])
def test_the_tip_is_within_its_deviation_in_a_hundred_runs(reference: bool) -> None:
    inside = 0
    for seed in range(100):
        tip = find_tip(run_of(seed, reference=reference))
        error = tip.place - TIP
        inside += error @ np.linalg.solve(tip.covariance, error) < INSIDE_95
    assert 90 <= inside <= 98 + 1  # 95 ± 2.2


@pytest.mark.parametrize("reference", [False, True])
def test_turns_that_err_by_three_degrees_bias_no_tip(reference: bool) -> None:
    tips = [find_tip(run_of(seed, reference=reference, turn=0.05)) for seed in range(40)]
    errors = np.array([tip.place - TIP for tip in tips])
    squared = [e @ np.linalg.solve(tip.covariance, e) for e, tip in zip(errors, tips, strict=True)]
    # errors of turns that are coefficients of least squares make the tip 0.5 mm of 150 short
    assert np.abs(errors.mean(axis=0)).max() < 3 * (errors.std(axis=0) / np.sqrt(40)).max()
    # 1 ± 0.1, and less where parts that err so much, and are not quite linear in what they err by,
    # are taken to disagree; seldom so that people are told of it
    assert 0.65 < np.mean(squared) / 3 < 1.2
    assert sum(tip.held_out_ratio > 4 for tip in tips) <= 4
    assert np.mean([tip.scale for tip in tips]) == pytest.approx(1, abs=0.05)


def test_residuals_are_those_of_the_covariances_seen_and_held_out() -> None:
    tip = find_tip(run_of(5))
    assert tip.residual == pytest.approx(tip.expected, rel=0.1)  # of 300 numbers: 4 %
    assert tip.residual < tip.held_out < 1.1 * tip.residual
    assert tip.left_out == 0


def test_without_noise_the_tip_is_exact() -> None:
    poses = about_its_tip(turning(30), np.repeat(POINT[None], 30, 0))
    tip = find_tip(fixed_in_world(poses, np.repeat(covariance_of(0.1, 0.002)[None], 30, 0)))
    np.testing.assert_allclose(tip.place, TIP, atol=1e-9)
    np.testing.assert_allclose(tip.pivot, POINT, atol=1e-9)


def test_poses_that_are_wrong_are_left_out_and_a_tip_that_slips_is_told() -> None:
    pivoting = run_of(3)
    poses = pivoting.poses.copy()
    poses[[10, 60]] = rigid.perturb(poses[[10, 60]], np.array([0, 30.0, 0, 0.2, 0, 0]))
    tip = find_tip(pivoting._replace(poses=poses))
    assert tip.left_out == 2
    assert np.linalg.norm(tip.place - TIP) < 0.5
    slid = pivoting.poses.copy()
    slid[50:, 0, 3] += 5.0
    tip = find_tip(pivoting._replace(poses=slid))
    assert tip.scale > 4  # by which it is told; of tips that stay it is 1 ± 0.08
    slid[:, :3, 3] += 300 * np.sin(np.arange(len(slid)))[:, None]
    with pytest.raises(RecordingError, match=r"errors make 32, 17\d times what the poses say"):
        find_tip(pivoting._replace(poses=slid))


def test_a_point_that_moves_on_slowly_is_in_the_deviation_of_the_tip() -> None:
    squared = []
    for seed in range(20):
        pivoting = run_of(seed)
        poses = pivoting.poses.copy()
        poses[:, :2, 3] += np.linspace(-1, 1, len(poses))[:, None]  # 2 mm along x and y
        tip = find_tip(pivoting._replace(poses=poses))
        assert tip.held_out_ratio > 4  # by which it is told
        error = tip.place - TIP
        squared.append(error @ np.linalg.solve(tip.covariance, error) / 3)
    # right is 1; by residuals alone, as if those of a hundred frames were independent, 19
    assert np.mean(squared) < 2.5


@pytest.mark.parametrize("frames", [4, 15])
def test_a_tip_that_wanders_in_its_dimple_is_within_its_deviation(frames: int) -> None:
    inside, keeps = 0, np.exp(-1 / frames)
    for seed in range(60):
        pivoting, rng = run_of(seed), np.random.default_rng(seed)
        steps = rng.standard_normal((len(pivoting.poses), 3)) * np.sqrt(1 - keeps**2)
        steps[0] /= np.sqrt(1 - keeps**2)
        wander, poses = lfilter([1.0], [1.0, -keeps], steps, axis=0), pivoting.poses.copy()
        poses[:, :3, 3] += 0.2 * wander  # mm, as much as poses err by
        tip = find_tip(pivoting._replace(poses=poses))
        error = tip.place - TIP
        inside += error @ np.linalg.solve(tip.covariance, error) < INSIDE_95
    # 57 ± 1.7; where parts count as disagreeing by 0.1 % of chance alone, 47 and 51
    assert 54 <= inside <= 59


@pytest.mark.parametrize(("share", "left_out"), [(0.93, 0), (1.07, 1)])
def test_a_pose_is_left_out_from_the_residual_that_rules_say(share: float, left_out: int) -> None:
    n, sigma = 100, 0.1
    poses = about_its_tip(turning(n), np.repeat(POINT[None], n, 0))
    covariance = np.diag([sigma**2] * 3 + [1e-14] * 3)
    # a squared residual of three numbers; one pose of a hundred moves the tip by 2 % of it
    poses[40, 0, 3] += share * sigma * np.sqrt(chi2.isf(PivotRules().foreign, 3))
    tip = find_tip(fixed_in_world(poses, np.repeat(covariance[None], n, axis=0)))
    assert tip.left_out == left_out
    # all others are exact: a covariance is never less than what the poses say of themselves
    more = find_tip(fixed_in_world(poses, np.repeat(4 * covariance[None], n, axis=0)))
    assert more.left_out == 0
    assert np.trace(more.covariance) == pytest.approx(4 * np.trace(tip.covariance), rel=0.05)


@pytest.mark.parametrize(
    ("tilt_deg", "spin_deg", "said"),
    [
        (0.0, 60.0, r"along the direction \(-?0.00, -?0.00, -?1.00\) .* tilt the tool"),
        (0.0, 0.0, "the body hardly turns"),
    ],
)
def test_turns_that_are_missing_are_named(tilt_deg: float, spin_deg: float, said: str) -> None:
    with pytest.raises(RecordingError, match=said):
        find_tip(run_of(1, tilt_deg=tilt_deg, spin_deg=spin_deg))


def test_wrong_poses_make_no_turns_that_are_missing() -> None:
    for seed in range(8):
        pivoting, rng = run_of(seed, tilt_deg=0.0), np.random.default_rng(seed)
        poses, wrong = pivoting.poses.copy(), rng.choice(100, 6, replace=False)
        poses[wrong, :3, :3] = rigid.rotation_matrix(rng.uniform(-3, 3, (6, 3)))
        with pytest.raises(RecordingError, match=r"not determined along .* -?1.00\) of the body"):
            find_tip(pivoting._replace(poses=poses))


def test_a_tip_is_written_into_the_session_and_told_with_each_pose(tmp_path: Path) -> None:
    # a recording of a body that turns about the middle of its markers, which simulation knows and
    # the session does not say: (20, -21, 91) / 7
    shutil.copy(
        Path(__file__).parents[1] / "data/synthetic/two_cameras/session.toml", tmp_path / "s.toml"
    )
    options = ("--frames", "24", "--translation", "0", "--rotation", "30", "--seed", "3")
    assert command("simulate", "s.toml", "-o", "try", *options, cwd=tmp_path).returncode == 0
    session, poses = tmp_path / "try/session.toml", tmp_path / "poses.jsonl"
    write_poses(poses, list(package.run(package.load_session(session))))
    before = session.read_text(encoding="utf-8")
    done = command("pivot", poses, "--into", session)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("tip of tracker: (")
    after = session.read_text(encoding="utf-8")
    (line,) = [each for each in after.splitlines() if each not in before.splitlines()]
    assert line.startswith("tip = [")
    tip = package.load_session(session).body.tip
    assert tip is not None
    np.testing.assert_allclose(tip, np.array([20, -21, 91]) / 7, atol=0.03)  # 0.008 mm deviation
    estimate = next(iter(package.run(package.load_session(session))))
    assert estimate.tip is not None
    assert estimate.tip_covariance is not None
    T = estimate.T_world_object
    assert T is not None
    np.testing.assert_allclose(estimate.tip, T[:3, :3] @ tip + T[:3, 3])
    assert np.linalg.eigvalsh(estimate.tip_covariance)[0] > 0


def test_the_covariance_of_a_tip_is_that_of_drawn_poses() -> None:
    covariance = covariance_of(0.1, 0.002)
    (line,) = lines_of(about_its_tip(turning(3), np.repeat(POINT[None], 3, 0))[1:2], covariance)
    one = replace(line, tip_object=TIP)
    drawn = measured(np.repeat(one.T_world_object[None], 20_000, 0), covariance)  # type: ignore[index]
    tips = rigid.transform(drawn, TIP[None])[:, 0]
    # of 20,000 draws 1 %, and turns of 0.1 degrees are straight to 1e-3
    expected = one.tip_covariance
    assert expected is not None
    np.testing.assert_allclose(np.cov(tips.T), expected, rtol=0.1, atol=3e-3)


def test_frames_whose_pose_is_not_ok_are_counted(tmp_path: Path) -> None:
    pivoting = run_of(1)
    lines = lines_of(pivoting.poses, pivoting.covariances[0])
    told = [replace(line, status="ambiguous") if k < 3 else line for k, line in enumerate(lines)]
    write_poses(tmp_path / "poses.jsonl", told)
    done = command("pivot", tmp_path / "poses.jsonl")
    assert done.returncode == 0
    assert f"{len(lines) - 3} frames, 0 left out, 3 not ok; directions" in done.stdout


def test_options_that_name_nothing_are_refused(tmp_path: Path) -> None:
    pivoting = run_of(1)
    path = tmp_path / "poses.jsonl"
    write_poses(path, lines_of(pivoting.poses, pivoting.covariances[0]))
    done = command("pivot", path, "--reference", "base")
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)
    assert "--reference base" in done.stderr
    assert command("pivot", path, "--reference", "tool").returncode == 2
    assert command("pivot", path, "--into", tmp_path / "none.toml").returncode == 2


def test_a_frame_that_stands_twice_and_poses_without_a_covariance_are_refused(
    tmp_path: Path,
) -> None:
    pivoting = run_of(1)
    path, lines = tmp_path / "poses.jsonl", lines_of(pivoting.poses, pivoting.covariances[0])
    write_poses(path, [*lines, replace(lines[-1], frame=lines[3].frame)])
    assert_one_line(command("pivot", path), 3, f"frame {lines[3].frame} of 'tool' stands twice")
    write_poses(path, [*lines[:5], replace(lines[5], covariance=np.zeros((6, 6))), *lines[6:]])
    assert_one_line(command("pivot", path), 3, "line 7: the pose of 'tool'", "has no covariance")


@pytest.mark.parametrize("mark", [b"", b"\xef\xbb\xbf"])
@pytest.mark.parametrize("ends", [b"\n", b"\r\n"])
@pytest.mark.parametrize("old", ["", "tip = [1, 2, 3] # by eye\n"])
def test_all_but_the_tip_stays_byte_for_byte(
    tmp_path: Path, mark: bytes, ends: bytes, old: str
) -> None:
    head = '# the new tool\n\nunit = "mm"\n[object]\nname = "tool"\n'
    rest = (
        "points = [\n  [0, 0, 0], # π\n  [50, 0, 0],\n  [0, 60, 0],\n]\n"
        '\n[[sensor]]\nname = "left"   # over the door\nmodel = "pinhole"\nsource = "*.png"\n'
        "camera_matrix = [[800, 0, 320], [0, 800, 240], [0, 0, 1]]\n"
    )

    def as_bytes(text: str) -> bytes:
        return mark + text.encode().replace(b"\n", ends)

    session, poses = tmp_path / "s.toml", tmp_path / "poses.jsonl"
    session.write_bytes(as_bytes(head + old + rest))
    pivoting = run_of(1)
    write_poses(poses, lines_of(pivoting.poses, pivoting.covariances[0]))
    done = command("pivot", poses, "--into", session)
    assert done.returncode == 0, done.stderr
    after = session.read_bytes()
    assert after.count(b"\n") == after.count(ends)
    (tip,) = [line for line in after.split(ends) if line.startswith(b"tip = [")]
    assert b"one standard deviation" in tip
    assert after.replace(tip + ends, b"") == as_bytes(head + rest)


def test_a_few_wrong_poses_lead_no_tip_astray() -> None:
    """Least squares of all begin so far off that none of the poses seems to be wrong."""
    for seed in range(20):
        pivoting, rng = run_of(seed), np.random.default_rng(seed)
        poses, wrong = pivoting.poses.copy(), rng.choice(100, 12, replace=False)
        poses[wrong, :3, :3] = rigid.rotation_matrix(rng.uniform(-3, 3, (12, 3)))
        poses[wrong, :3, 3] += rng.uniform(-400, 400, (12, 3))
        tip = find_tip(pivoting._replace(poses=poses))
        assert 12 <= tip.left_out <= 13
        assert np.linalg.norm(tip.place - TIP) < 5 * np.sqrt(np.trace(tip.covariance))


def test_parts_that_err_by_chance_disagree_as_often_as_rules_say() -> None:
    told = [find_tip(run_of(seed)).held_out_ratio > 1 for seed in range(150)]
    # 0.4 ± 0.04
    assert abs(np.mean(told) - PivotRules().accident) < 0.12
