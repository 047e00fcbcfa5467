"""Poses smoothed where recordings pause, and where their numbers are out of the ordinary."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from pose_lines import covariance_of, lines_of, measured, rms_errors, squared_errors, swinging

from mixpose import rigid
from mixpose.errors import RecordingError
from mixpose.poses.poseline import PoseLine
from mixpose.records import Estimate, Floats
from mixpose.trajectories.intensity import SmoothingRules
from mixpose.trajectories.smoothing import smooth_body

QUICK = SmoothingRules(frames=40, block=40)  # enough to tell how the bodies of these tests move


def poses_of(estimates: tuple[Estimate, ...]) -> Floats:
    return np.stack([one.T_world_object for one in estimates if one.T_world_object is not None])


def at_times(lines: list[PoseLine], times: Floats) -> list[PoseLine]:
    return [replace(one, time_s=float(t)) for one, t in zip(lines, times, strict=True)]


@pytest.fixture(scope="module")
def without_pause() -> Floats:
    """By how much a recording without a pause errs, smoothed."""
    truth, covariance = swinging(40), covariance_of(0.1, 0.001)
    whole = smooth_body(lines_of(measured(truth, covariance), covariance), rules=QUICK)
    assert whole.model is not None
    return np.asarray(rms_errors(truth, poses_of(whole.estimates)))


@pytest.mark.parametrize("pause_s", [60.0, 3600.0, 36000.0, 1e9])
def test_a_pause_of_the_recording_does_not_tell_how_the_body_moves(
    pause_s: float, without_pause: Floats
) -> None:
    truth, covariance = swinging(40), covariance_of(0.1, 0.001)
    poses = measured(truth, covariance)
    lines, times = lines_of(poses, covariance), 0.04 * np.arange(40)
    parted = smooth_body(at_times(lines, times + pause_s * (np.arange(40) >= 20)), rules=QUICK)
    assert parted.model is not None
    assert parted.smoothed == 40
    # each side alone has two ends more, where a pose is told by one side only
    errors = rms_errors(truth, poses_of(parted.estimates))
    assert (np.asarray(errors) < 1.3 * without_pause).all()


def test_parts_that_are_all_too_short_to_tell_a_motion_stay_as_they_were() -> None:
    truth, covariance = swinging(20), covariance_of(0.1, 0.001)
    k = np.arange(20, dtype=np.float64)
    times = 0.04 * k + 60.0 * (k // 5)
    lines = at_times(lines_of(truth, covariance), times)
    found = smooth_body(lines, rules=QUICK)
    assert found.model is None
    assert found.smoothed == 0
    np.testing.assert_array_equal(poses_of(found.estimates), truth)


@pytest.mark.parametrize("scale", [1e-300, 1e300])
@pytest.mark.parametrize("which", ["covariances", "times"])
def test_numbers_that_are_out_of_all_proportion_are_refused(scale: float, which: str) -> None:
    truth, covariance = swinging(20), covariance_of(0.1, 0.001)
    lines = lines_of(measured(truth, covariance), covariance)
    if which == "times":
        lines = at_times(lines, np.array([0.04 * scale * k for k in range(20)]))
    else:
        lines = [replace(one, covariance=scale * np.eye(6)) for one in lines]
    with pytest.raises(RecordingError, match="'tool' cannot be smoothed: covariances or times"):
        smooth_body(lines, rules=QUICK)


def stamped(lines: list[PoseLine], jitter_ns: int) -> list[PoseLine]:
    """Lines numbered by stamps in nanoseconds, 25 a second, off the even rate by chance."""
    off = np.random.default_rng(1).integers(-jitter_ns, jitter_ns + 1, len(lines)).tolist()
    stamps = [10**18 + 40_000_000 * k + off[k] for k in range(len(lines))]
    return [
        replace(one, frame=n, time_s=(n - 10**18) * 1e-9)
        for one, n in zip(lines, stamps, strict=True)
    ]


def test_stamps_that_jitter_leave_no_gap_to_fill() -> None:
    truth, covariance = swinging(40), covariance_of(0.1, 0.001)
    lines = stamped(lines_of(measured(truth, covariance), covariance), 20_000)
    found = smooth_body(lines, rules=QUICK, fill_s=1.0)
    assert found.filled == 0
    assert [one.frame for one in found.estimates] == [one.frame for one in lines]


def test_gaps_among_stamps_are_filled_evenly_and_lost_frames_keep_their_stamps() -> None:
    truth, covariance = swinging(40), covariance_of(0.1, 0.001)
    lines = stamped(lines_of(measured(truth, covariance), covariance), 20_000)
    lines[10] = replace(lines[10], status="lost", T_world_object=None, covariance=None)
    lost, before, after = lines[10], lines[20], lines[24]
    del lines[21:24]
    found = smooth_body(lines, rules=QUICK, fill_s=1.0)
    marked = [one for one in found.estimates if one.filled]
    assert len(found.estimates) == 40
    span = after.frame - before.frame
    evenly = [before.frame + span * k // 4 for k in (1, 2, 3)]
    assert [one.frame for one in marked] == [lost.frame, *evenly]
    assert [one.time_s for one in marked] == pytest.approx([0.4, 0.84, 0.88, 0.92], abs=1e-4)


def test_frames_that_are_filled_in_have_the_tip_of_the_body() -> None:
    truth, covariance = swinging(40), covariance_of(0.1, 0.001)
    tip = np.array([0.0, 0.0, -100.0])
    lines = [replace(one, tip_object=tip) for one in lines_of(truth, covariance)]
    del lines[20:22]
    found = smooth_body(lines, rules=QUICK, fill_s=1.0)
    for one in found.estimates[20:22]:
        assert one.filled
        assert one.tip is not None
        assert one.tip_covariance is not None
        assert np.abs(one.tip - (truth[one.frame] @ [*tip, 1.0])[:3]).max() < 2.0


def test_a_body_that_rests_and_is_put_elsewhere_is_smoothed_on_both_sides() -> None:
    truth = np.broadcast_to(np.eye(4), (60, 4, 4)).copy()
    truth[30:] = rigid.perturb(truth[30:], np.array([20, -10, 5, 0.1, 0.2, -0.1]))
    covariance = covariance_of(0.1, 0.001)
    poses = measured(truth, covariance)
    smooth = smooth_body(lines_of(poses, covariance))
    # the pose before the jump was taken for a wrong one, and half of the way put into its place
    assert smooth.refused == ()
    before, after = rms_errors(truth, poses), rms_errors(truth, poses_of(smooth.estimates))
    assert max(np.divide(after, before)) < 0.5  # of 30 poses at rest: 1/sqrt(30), and 3 that move
    assert squared_errors(truth, smooth.estimates).max() < 3.7  # of 6 numbers 99.9 %


def test_frames_filled_in_behind_a_first_pose_that_is_wrong_are_where_later_ones_lead() -> None:
    truth, covariance = swinging(60), covariance_of(0.1, 0.001)
    lines = lines_of(measured(truth, covariance), covariance)
    far = np.array([300.0, 200.0, 0.0, 0.5, 0.5, 0.0])
    lines[0] = replace(lines[0], T_world_object=rigid.perturb(truth[0], far))
    result = smooth_body([lines[0], *lines[4:]], fill_s=1.0, rules=QUICK)
    assert (result.filled, result.refused) == (3, (0,))
    poses = poses_of(result.estimates)[:5]
    away = np.linalg.norm(poses[:, :3, 3] - truth[:5, :3, 3], axis=1)
    assert away.max() < 3.0  # of 360 mm that the first pose is off


def test_lost_frames_are_filled_at_their_own_times() -> None:
    truth, covariance = swinging(40), covariance_of(0.1, 0.001)
    lines = lines_of(measured(truth, covariance), covariance)
    # of four frames that nobody sees the third is late, as where a camera drops frames
    for k in range(20, 24):
        moved = 0.03 if k == 22 else 0.0
        lost = replace(lines[k], status="lost", T_world_object=None, covariance=None)
        lines[k] = replace(lost, time_s=0.04 * k + moved)
    found = smooth_body(lines, rules=QUICK, fill_s=1.0)
    assert [one.time_s for one in found.estimates] == [one.time_s for one in lines]
    late = swinging(4000, interval_s=0.0004)[2275]  # at 0.91 s
    T = found.estimates[22].T_world_object
    assert T is not None
    assert np.abs(rigid.twist_between(late, T)[:3]).max() < 0.5  # it goes by 2 in 0.03 s


@pytest.mark.parametrize("begun", [0.0, 1.7e9])
def test_gaps_of_the_longest_that_is_filled_are(begun: float) -> None:
    covariance = covariance_of(0.1, 0.001)
    times = np.linspace(begun, begun + 3.9, 40)
    lines = at_times(lines_of(swinging(40), covariance), times)
    kept = [line for line in lines if line.frame % 5 != 4]
    found = smooth_body(kept, rules=QUICK, fill_s=0.2)
    # but the last, after which there is none
    assert [one.frame for one in found.estimates if one.filled] == [4, 9, 14, 19, 24, 29, 34]
