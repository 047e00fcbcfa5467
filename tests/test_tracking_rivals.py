"""Poses that a frame hardly tells apart, and frames that are alike in what they say of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from detections import EIGHT, TRUTH, detect
from matches import Seen, scored
from numpy.typing import NDArray

from mixpose.body import ASIDE, Body, PointFeature
from mixpose.fit import EstimatorOptions
from mixpose.judgement import APART
from mixpose.records import Estimate
from mixpose.rigid import covariance_at, from_parts, from_rotation_vector, inverse
from mixpose.sensors import PinholeCamera
from mixpose.tracking import Track, Tracker
from mixpose.tracking.rivals import log_odds_against
from mixpose.tracking.track import Branch

Floats = NDArray[np.float64]
SEEN = [Seen(np.zeros((8, 2, 6)), name, shares=np.ones(8)) for name in "ab"]


def board(columns: int, rows: int, *more: tuple[float, float, float]) -> Body:
    """A board of corners 30 mm apart, and more points."""
    points = [(30.0 * x, 30.0 * y, 0.0) for y in range(rows) for x in range(columns)]
    return Body("board", tuple(PointFeature(np.array(point)) for point in (*points, *more)))


def moved(k: int, reach: float = 40.0) -> Floats:
    """The k-th pose of a body that sways and turns."""
    turn = from_rotation_vector([0.1 * np.sin(k / 3), 0.08 * np.cos(k / 4), 0.05 * k], np.zeros(3))
    T = TRUTH @ turn
    T[:3, 3] += reach * np.array([np.sin(k / 4), np.cos(k / 5), np.sin(k / 6)])
    return T


def followed(
    cameras: list[PinholeCamera], told: Body, there: Body, frames: int, noise: float = 0.1
) -> list[Estimate]:
    """Estimates of a body that was told, of detections of what is there."""
    tracker = Tracker.create(told, EstimatorOptions())
    track, found = tracker.begin(), []
    for k in range(frames):
        views = detect(cameras, there, moved(k), noise=noise, seed=k)
        track, estimate = tracker.advance(track, k, k / 30, views)
        found.append(estimate)
    return found


def test_where_the_board_has_a_row_more_than_its_session_either_row_may_be_it(
    pinhole_cameras: list[PinholeCamera],
) -> None:
    found = followed(pinhole_cameras, board(5, 4), board(5, 5), 10)
    assert [one.status for one in found] == ["ambiguous"] * 10
    assert {one.doubt for one in found} == {ASIDE}
    # which of the two rows is met more closely by chance tells nothing
    assert max(one.hypotheses[0].weight for one in found) < 0.99
    whole = followed(pinhole_cameras, board(5, 5), board(5, 5), 3)
    assert [one.status for one in whole] == ["ok"] * 3


@pytest.mark.parametrize(
    ("now", "expected"), [(-2.0, -2.0), (-1.0, None), (1.0, -0.386), (3, 1.614)]
)
def test_of_all_frames_that_tell_two_poses_apart_the_one_counts_that_tells_most(
    now: float, expected: float | None
) -> None:
    aside = moved(30)
    before = np.log(0.2 / 0.8)
    track = Track((Branch(TRUTH, 0.8), Branch(aside, 0.2)), frame=0)
    data = Tracker.create(EIGHT, EstimatorOptions()).data(track, 1, None, [])
    # what is expected as well counts in both
    best, rival = (
        replace(scored(T, *SEEN), log_evidence=evidence)
        for T, evidence in ((TRUTH, 50.0), (aside, 50.0 + before + now))
    )
    odds = log_odds_against(data, rival, best)
    assert odds == pytest.approx(before if expected is None else expected, abs=1e-3)


def test_frames_that_tell_nothing_of_two_poses_do_not_together(
    pinhole_cameras: list[PinholeCamera],
) -> None:
    # a point that tells the half-turn of a board, if it were there
    told = board(5, 4, (120.0, 120.0, 0.0))
    found = followed(pinhole_cameras, told, board(5, 4), 25)
    assert [one.status for one in found] == ["ambiguous"] * 25
    there = followed(pinhole_cameras, told, told, 3)
    assert [one.status for one in there] == ["ok"] * 3


def test_rivals_of_a_body_that_looks_the_same_turned_move_as_it_does(
    pinhole_cameras: list[PinholeCamera],
) -> None:
    # as the board looks the same from behind, each of its rivals may be told in two ways
    told = board(4, 3, (45.0, 90.0, 0.0))
    assert len(told.symmetries) == 2
    tracker = Tracker.create(told, EstimatorOptions())
    track = tracker.begin()
    for k in range(10):
        views = detect(pinhole_cameras, board(4, 3), moved(k), noise=0.1, seed=k)
        track, estimate = tracker.advance(track, k, k / 30, views)
        assert estimate.status == "ambiguous"
        velocities = [one.velocity for one in track.branches if one.velocity is not None]
        assert len(velocities) >= 2 or not k
        # it turns by 0.1 rad in a frame at the most, and half a turn is 94 rad in a second
        assert max([np.abs(one[3:]).max() for one in velocities], default=0.0) < 5


def test_what_a_pose_goes_on_from_is_told_by_any_of_the_poses_that_look_the_same() -> None:
    plain = board(4, 3)
    assert len(plain.symmetries) == 4
    near, far = TRUTH, TRUTH.copy()
    far[:3, 3] += [0.0, 0.0, 80.0]
    for turn in plain.symmetries:
        track = Track((Branch(near), Branch(far @ turn)))
        assert track.nearest(far, plain) is track.branches[1]
        assert track.nearest(near @ turn, plain) is track.branches[0]


def side_by_side(camera: PinholeCamera) -> list[PinholeCamera]:
    """Two cameras close enough to each other that one alone knows the pose hardly worse."""
    turn = from_rotation_vector([0.0, 0.0, 0.3], np.zeros(3))
    return [camera, replace(camera, T_sensor_world=camera.T_sensor_world @ turn)]


def test_of_two_cameras_that_each_see_the_body_elsewhere_none_is_believed(
    pinhole_cameras: list[PinholeCamera],
) -> None:
    """As where one of them shows an old frame: the body rested, and the other saw it move."""
    cameras = side_by_side(pinhole_cameras[0])
    body = board(6, 5)
    tracker = Tracker.create(body, EstimatorOptions())
    track = tracker.begin()
    for k, T in enumerate([TRUTH] * 4):
        views = detect(cameras, body, T, noise=0.05, seed=k)
        track, estimate = tracker.advance(track, k, k / 30, views)
        assert estimate.status == "ok"
    old, new = (detect(cameras, body, T, noise=0.05, seed=5) for T in (TRUTH, moved(7, 150.0)))
    _, estimate = tracker.advance(track, 4, 4 / 30, [old[0], new[1]])
    assert (estimate.status, estimate.doubt) == ("ambiguous", APART)
    away = [one.T_world_object[:3, 3] - TRUTH[:3, 3] for one in estimate.hypotheses]
    assert len(away) == 2
    assert np.linalg.norm(away[1]) > 100
    # with nothing beside it, one camera that is covered takes nothing from the other
    blank = replace(new[1], observation=new[1].observation.only(np.zeros(30, dtype=np.bool_)))
    _, estimate = tracker.advance(track, 4, 4 / 30, [old[0], blank])
    assert estimate.status == "ok"


def test_cameras_that_contradicted_each_other_are_believed_once_they_agree(
    pinhole_cameras: list[PinholeCamera],
) -> None:
    body, away = board(6, 5), moved(7, 150.0)
    tracker = Tracker.create(body, EstimatorOptions())
    track, told = tracker.begin(), []
    cameras = side_by_side(pinhole_cameras[0])
    rests, apart, alone = (TRUTH, TRUTH), (TRUTH, away), (TRUTH,)
    for k, poses in enumerate([rests, rests, apart, alone, alone, rests, alone]):
        views = [
            replace(detect([camera], body, T, noise=0.05, seed=10 * k + i)[0], name=str(i))
            for i, (camera, T) in enumerate(zip(cameras, poses, strict=False))
        ]
        track, estimate = tracker.advance(track, k, k / 30, views)
        told.append((estimate.status, estimate.doubt))
    # one alone cannot say which of the two is where its session tells
    assert told == [("ok", "")] * 2 + [("ambiguous", APART)] * 3 + [("ok", "")] * 2


@pytest.mark.parametrize("arm", [300.0, 3000.0])
def test_poses_are_the_same_wherever_somebody_put_the_origin(
    pinhole_cameras: list[PinholeCamera], arm: float
) -> None:
    T_object_other = from_rotation_vector([0.3, -0.8, 0.4], [arm, -0.5 * arm, 0.2 * arm])
    points = (EIGHT.means - T_object_other[:3, 3]) @ T_object_other[:3, :3]
    other = replace(EIGHT, features=tuple(map(PointFeature, points)))
    estimates = []
    for body, T_start in ((EIGHT, TRUTH), (other, TRUTH @ T_object_other)):
        tracker = Tracker.about_centre(body, EstimatorOptions(), T_start, distance=50.0)
        track, found = tracker.begin(), []
        for k in range(6):
            views = detect(pinhole_cameras[:1], EIGHT, moved(k), noise=0.2, hidden=k % 3, seed=k)
            track, estimate = tracker.advance(track, k, k / 30, views)
            found.append(estimate)
        estimates.append(found)
    for one, another in zip(*estimates, strict=True):
        assert one.T_world_object is not None
        assert another.T_world_object is not None
        assert one.status == another.status == "ok"
        assert one.confidence == pytest.approx(another.confidence, rel=1e-6)
        back = another.T_world_object @ inverse(T_object_other)
        # features to 1e-7 of their distance; where the arm is ten times the body, rounding as well
        assert np.abs(back - one.T_world_object).max() < 1e-4
        arm_in_world = one.T_world_object[:3, :3] @ T_object_other[:3, 3]
        there = covariance_at(one.covariance, arm_in_world)
        assert np.abs(there - another.covariance).max() < 1e-3 * np.abs(there).max()


def test_directions_that_are_held_are_those_of_the_origin_where_turns_would_move_it() -> None:
    beside = replace(EIGHT, features=tuple(one.shifted(np.ones(3)) for one in EIGHT.features))
    middle = beside.means.mean(axis=0)
    for free, is_centred in (
        (("x", "y", "z", "rx", "ry", "rz"), True),
        (("x", "y", "rz"), True),  # z stays where it is
        (("x", "y", "z"), True),
        (("x", "rz"), False),
        (("rx", "ry", "rz"), False),
    ):
        options = EstimatorOptions(free=free)
        tracker = Tracker.about_centre(beside, options, from_parts(np.eye(3), [1.0, 2.0, 3.0]))
        np.testing.assert_array_equal(tracker.origin, -middle if is_centred else np.zeros(3))
