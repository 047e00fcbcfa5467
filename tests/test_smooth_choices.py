"""What frames show that were ambiguous: what the track tells, and what it does not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from pose_lines import covariance_of, lines_of, measured, swinging

from mixpose import rigid
from mixpose.poses.poseline import PoseLine
from mixpose.records import Floats, Hypothesis
from mixpose.trajectories.intensity import SmoothingRules
from mixpose.trajectories.smoothing import smooth_body

FAR = ([80.0, 0, 0, 0.5, 0, 0], [-20.0, 90, 0, 0, 0.9, 0])  # no part of any motion
QUICK = SmoothingRules(frames=40, block=40)  # enough to tell how the bodies of these tests move


def with_rival(line: PoseLine, right: Floats, wrong: Floats, share: float = 0.4) -> PoseLine:
    """An ambiguous frame; the right hypothesis has a share of belief."""
    rivals = (Hypothesis(wrong, 1 - share), Hypothesis(right, share))
    return replace(line, status="ambiguous", T_world_object=wrong, hypotheses=rivals)


def test_the_track_tells_which_hypothesis_of_ambiguous_frames_is_right() -> None:
    truth, covariance = swinging(60), covariance_of(0.1, 0.001)
    poses = measured(truth, covariance)
    lines = lines_of(poses, covariance)
    tilt = rigid.from_rotation_vector([0.4, 0, 0], [1.0, 0, 0])
    doubted = [0, *range(20, 28), 40]
    for k in doubted:
        lines[k] = with_rival(lines[k], poses[k], poses[k] @ tilt)
    smooth = smooth_body(lines, rules=QUICK)
    assert smooth.decided == len(doubted)
    for k in doubted:
        one = smooth.estimates[k]
        assert one.status == "ok"
        assert one.T_world_object is not None
        assert rigid.rotation_angle_deg(one.T_world_object, truth[k]) < 0.5  # the tilt is 23 deg


def test_the_track_tells_nothing_of_a_body_of_another_size() -> None:
    covariance = covariance_of(0.1, 0.001)
    lines = lines_of(measured(swinging(40), covariance), covariance)
    doubt = "the body seems to be of another size"
    # and one in doubt for clutter, which goes along with no track
    for k, why in ((20, doubt), (30, "")):
        T = lines[k].T_world_object
        assert T is not None
        rivals = (Hypothesis(T, 1.0),)
        changed = replace(lines[k], status="ambiguous", confidence=0.4, hypotheses=rivals)
        lines[k] = replace(changed, doubt=why)
    smooth = smooth_body(lines, rules=QUICK)
    one, other = smooth.estimates[20], smooth.estimates[30]
    assert (one.status, one.doubt) == ("ambiguous", doubt)
    assert one.confidence == pytest.approx(0.4, abs=1e-4)
    assert other.status == "ok"


def test_a_pose_that_says_next_to_nothing_moves_no_others() -> None:
    covariance = covariance_of(0.1, 0.001)
    lines = lines_of(measured(swinging(40), covariance), covariance)
    usual = smooth_body(lines, rules=QUICK).estimates
    for power in (6, 12, 20):
        lines[20] = replace(lines[20], covariance=covariance * 10.0**power)
        changed = smooth_body(lines, rules=QUICK).estimates
        for k in (0, 10, 30, 39):
            before, after = usual[k].T_world_object, changed[k].T_world_object
            assert before is not None
            assert after is not None
            assert np.abs(after - before)[:3, 3].max() < 0.01  # a tenth of a deviation


@pytest.mark.parametrize("seed", [4, 11])
def test_no_probability_of_many_paths_is_above_1(seed: int) -> None:
    truth, covariance = swinging(40), covariance_of(0.1, 0.001)
    poses = measured(truth, covariance, seed)
    lines = lines_of(poses, covariance)
    tilt = rigid.from_rotation_vector([0.4, 0, 0], [1.0, 0, 0])
    # sixteen paths whose shares make 1 but for rounding
    rivals = [with_rival(line, T, T @ tilt) for line, T in zip(lines, poses, strict=True)]
    smooth = smooth_body(rivals, rules=QUICK)
    assert smooth.decided > 30
    assert all(one.confidence is not None and one.confidence <= 1 for one in smooth.estimates)


def test_a_frame_that_shows_something_else_stays_as_it_was() -> None:
    truth, covariance = swinging(40), covariance_of(0.1, 0.001)
    lines = lines_of(measured(truth, covariance), covariance)
    away = [truth[15] @ rigid.from_rotation_vector([0, 1.0, 0], [x, 0, 0]) for x in (60.0, -80.0)]
    lines[15] = with_rival(lines[15], away[0], away[1])
    one = smooth_body(lines, rules=QUICK).estimates[15]
    assert one.status == "ambiguous"
    np.testing.assert_array_equal(one.T_world_object, away[1])


def test_two_tracks_that_are_equally_smooth_stay_ambiguous() -> None:
    # a mirror image that moves as the body does, all the time
    truth, covariance = swinging(40), covariance_of(0.1, 0.001)
    poses = measured(truth, covariance)
    shift = rigid.from_rotation_vector([0, 0, 0], [0, 0, 40.0])
    lines = [
        with_rival(line, T, shift @ T, 0.5)
        for line, T in zip(lines_of(poses, covariance), poses, strict=True)
    ]
    smooth = smooth_body(lines, rules=QUICK)
    assert {one.status for one in smooth.estimates} == {"ambiguous"}
    assert smooth.decided == 0
    assert smooth.estimates[20].hypotheses[0].weight < 0.999


@pytest.mark.parametrize("doubted", [[0], [0, 1], [59]])
def test_frames_at_either_end_may_show_nothing_of_the_body(doubted: list[int]) -> None:
    covariance = covariance_of(0.1, 0.001)
    poses = measured(swinging(60), covariance)
    lines = lines_of(poses, covariance)
    for k in doubted:
        one, other = (rigid.perturb(poses[k], np.array(off)) for off in FAR)
        lines[k] = with_rival(lines[k], one, other)
    smooth = smooth_body(lines, rules=QUICK)
    assert {one.frame for one in smooth.estimates if one.status != "ok"} == {*doubted}
    assert smooth.refused == ()


@pytest.mark.parametrize("end", [0, 59])
def test_a_wrong_pose_at_either_end_is_told(end: int) -> None:
    truth, covariance = swinging(60), covariance_of(0.1, 0.001)
    poses = measured(truth, covariance)
    lines = lines_of(poses, covariance)
    lines[end] = replace(lines[end], T_world_object=rigid.perturb(poses[end], np.array(FAR[0])))
    smooth = smooth_body(lines, rules=QUICK)
    assert smooth.refused == (end,)
    one = smooth.estimates[end]
    assert one.status == "ambiguous"
    assert one.T_world_object is not None
    assert np.abs(rigid.twist_between(truth[end], one.T_world_object)[:3]).max() < 1.0


def test_wrong_poses_at_both_ends_are_told() -> None:
    covariance = covariance_of(0.1, 0.001)
    lines = lines_of(measured(swinging(60), covariance), covariance)
    for end, off in zip((0, 59), FAR, strict=True):
        T = lines[end].T_world_object
        assert T is not None
        lines[end] = replace(lines[end], T_world_object=rigid.perturb(T, np.array(off)))
    assert smooth_body(lines, rules=QUICK).refused == (0, 59)
