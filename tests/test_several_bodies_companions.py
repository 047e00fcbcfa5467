"""Where a body is beside another one that is sure, it is expected though its own track lost it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from bodies_in_view import CAMERAS, OTHER, TOOL, at, body, off, scene_of, views_of

from mixpose.density import Observation
from mixpose.records import Floats, PointPattern
from mixpose.rigid import from_rotation_vector, transform
from mixpose.tracking import Companion, Rules, Scene, Track
from mixpose.tracking.track import mixed_prior

RECORDING = Path(__file__).parents[1] / "data" / "synthetic" / "several_bodies"


def beside_each_other(frame: int) -> tuple[Floats, Floats]:
    """Two bodies that jump about together, the one within 5 mm and 0.1 rad where it was beside."""
    rng = np.random.default_rng(frame)
    first = from_rotation_vector(rng.uniform(-0.6, 0.6, 3), rng.uniform(-150, 150, 3))
    swung = from_rotation_vector(rng.normal([0.5, 0, 0], 0.1), rng.normal(0, 5, 3))
    swung[0, 3] += 150
    return first, first @ swung


@pytest.fixture(scope="module")
def acquainted() -> tuple[Scene, tuple[Track, ...]]:
    """A scene whose two bodies were beside each other for eleven frames."""
    tool, other = body("tool", TOOL), body("other", OTHER)
    scene = scene_of(tool, other)
    tracks = scene.begin()
    for k in range(11):
        views = views_of([tool, other], beside_each_other(k), k)
        tracks, _ = scene.advance(tracks, k, k / 10, views)
    return scene, tracks


def strangers(tracks: Sequence[Track]) -> list[Track]:
    return [replace(track, companions={}) for track in tracks]


@pytest.mark.parametrize("seed", [11, 311])
def test_three_markers_where_the_body_was_beside_another_one_are_the_body(
    acquainted: tuple[Scene, tuple[Track, ...]], seed: int
) -> None:
    scene, tracks = acquainted
    poses = beside_each_other(seed)
    views = views_of([body("tool", TOOL), body("other", OTHER[:3])], poses, 11)
    _, estimates = scene.advance(tracks, 11, 1.1, views)
    assert [one.status for one in estimates] == ["ok", "ok"]
    assert off(estimates[1], poses[1])[0] < 1.0
    # it jumped by half of the view, where its own track did not expect it
    _, alone = scene.advance(strangers(tracks), 11, 1.1, views)
    assert alone[1].status != "ok"


def test_a_body_that_parts_from_another_one_is_found_where_it_is(
    acquainted: tuple[Scene, tuple[Track, ...]],
) -> None:
    scene, tracks = acquainted
    first = beside_each_other(11)[0]
    parted = from_rotation_vector([1.0, -2.0, 0.5], -first[:3, 3] / 2 + [0, 120, 40])
    views = views_of([body("tool", TOOL), body("other", OTHER)], [first, parted], 11)
    _, estimates = scene.advance(tracks, 11, 1.1, views)
    assert [one.status for one in estimates] == ["ok", "ok"]
    assert off(estimates[1], parted)[0] < 1.0
    # and where only three of its markers are seen, that it was elsewhere before makes nothing sure
    views = views_of([body("tool", TOOL), body("other", OTHER[:3])], [first, parted], 11)
    _, estimates = scene.advance(tracks, 11, 1.1, views)
    assert estimates[1].status != "ok"


def test_what_was_beside_is_a_mean_and_a_spread_that_narrows_with_the_frames() -> None:
    other = body("other", OTHER)
    known = None
    rng = np.random.default_rng(0)
    for _ in range(400):
        first, _ = beside_each_other(int(rng.integers(1 << 30)))
        away = from_rotation_vector(rng.normal(0, 0.2, 3), rng.normal(0, [5, 20, 40]))
        known = Companion.joined(known, first @ away, first, other)
    assert known is not None
    rules = Rules().motion
    assert np.abs(known.T_other_object[:3, 3]).max() < 6  # 40 mm of 400 frames, three times
    # what is guessed counts as three frames: a radius, and 30 degrees
    wide = known.expected(np.eye(4), other, rules).uncertainty
    guess = 3 / 403 * np.array([other.radius] * 3 + [np.pi / 6] * 3) ** 2
    true = np.sqrt(np.array([5, 20, 40, 0.2, 0.2, 0.2]) ** 2 + guess)
    assert np.allclose(wide, true, rtol=0.12)  # three standard deviations of a spread of 400
    # a quarter turn of the other body turns what is known with it
    quarter = from_rotation_vector([0, 0, np.pi / 2], [0, 0, 0])
    turned = known.expected(quarter, other, rules).uncertainty
    assert turned[[1, 0, 2]] == pytest.approx(wide[:3])


def test_what_lets_expect_a_pose_is_shared_between_its_own_track_and_another_body() -> None:
    own, near = (-20.0, np.ones(6)), (-8.0, np.full(6, 0.1))
    fresh = mixed_prior(own, near, 0, Rules().motion)
    assert fresh[0] == pytest.approx(-8.0 + np.log(0.5), abs=1e-4)
    assert (fresh[1] == 0.1).all()
    # after a hundred frames without the body half of what was left is left of 0.98^100
    faded = mixed_prior(own, near, 100, Rules().motion)
    assert faded[0] == pytest.approx(-8.0 + np.log(0.5 * 0.98**100), abs=1e-4)
    gone = mixed_prior(own, near, 2000, Rules().motion)
    assert gone[0] == pytest.approx(-20.0, abs=1e-6)


def test_a_pose_that_is_sure_for_doubtful_ones_before_it_alone_is_in_doubt() -> None:
    other = body("other", OTHER[:4])
    scene = scene_of(body("tool", TOOL), other)
    poses = at(-200), at(150, turn=1.0)
    tracks = scene.begin()
    statuses = []
    # two of its four markers, and a spot of one camera where a third may be, all standing still
    for k in range(12):
        views = views_of([body("tool", TOOL), body("some", OTHER[[0, 1]])], poses, k)
        third = CAMERAS["left"].project(transform(poses[1], OTHER[2:3]))[0] + [0.5, 0.3]
        seen = views[0].observation.pattern
        assert isinstance(seen, PointPattern)
        spots = PointPattern(np.concatenate([seen.points, third]), np.append(seen.weights, 1.0))
        views[0] = replace(views[0], observation=Observation(spots, 1.5))
        tracks, estimates = scene.advance(tracks, k, k / 10, views)
        statuses.append(estimates[1].status)
    assert "ok" not in statuses, statuses


def test_what_is_known_of_a_companion_is_mean_and_variance_of_where_it_was() -> None:
    tool = body("tool", TOOL)
    places = np.random.default_rng(7).normal([150.0, 0, 0], 5.0, (12, 3))
    known = None
    for place in places:
        beside = from_rotation_vector([0.5, 0, 0], place)
        known = Companion.joined(known, at(40, turn=0.3) @ beside, at(40, turn=0.3), tool)
    assert known is not None
    assert known.count == 12
    np.testing.assert_allclose(known.T_other_object[:3, 3], places.mean(axis=0), atol=1e-9)
    np.testing.assert_allclose(known.squares[:3], places.var(axis=0), rtol=1e-9)
    np.testing.assert_allclose(known.squares[3:], 0.0, atol=1e-18)
