"""Ranges that are not labelled, of tags that lie as close together as ranges err."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.special import chdtri

from mixpose.body import Body, PointFeature
from mixpose.density import Observation
from mixpose.fit import EstimatorOptions, Fit
from mixpose.judgement import JudgementRules, NoiseModel, RememberedNoise
from mixpose.objective import View
from mixpose.records import Estimate, PointPattern
from mixpose.rigid import (
    from_rotation_vector,
    perturb,
    rotation_angle_deg,
    transform,
    twist_between,
)
from mixpose.sensors import RangeSensor
from mixpose.tracking import Rules, Tracker
from mixpose.tracking.frame import Start
from mixpose.tracking.likelihood import likelihood_of
from mixpose.tracking.ranges import (
    AssociationTerm,
    _sum_and_shares,
    are_associated,
    noise_ratio,
    sum_associations,
)
from mixpose.tracking.rules import RangeRules

Floats = NDArray[np.float64]

SIGMA = 0.08
FREE = (0, 1, 5)
TAGS = 1.6 * np.array([[-0.07, -0.14, 0.0], [-0.075, 0.14, 0.0], [0.2, 0.145, 0.0]])
TROLLEY = Body("trolley", tuple(PointFeature(tag) for tag in TAGS))
SMALL = Body("small trolley", tuple(PointFeature(tag / 1.6) for tag in TAGS))
ANCHORS = [
    RangeSensor(np.array([x, y, 0.1]))
    for x, y in [(-3.5, 3), (0, 3), (3.5, 3), (3.5, 0), (3.5, -3), (0, -3), (-3.5, -3), (-3.5, 0)]
]


def views_at(
    T: Floats, rng: np.random.Generator, body: Body = TROLLEY, sigma: float = SIGMA
) -> list[View]:
    """Shuffled ranges of all tags to all anchors."""
    views = []
    for k, anchor in enumerate(ANCHORS):
        ranges = anchor.project(transform(T, body.means))[0][:, 0] + rng.normal(0, sigma, len(TAGS))
        pattern = PointPattern(rng.permutation(ranges)[:, None], np.ones(len(TAGS)))
        views.append(View(f"anchor{k}", anchor, Observation(pattern, sigma)))
    return views


def drive(count: int) -> Iterator[tuple[float, Floats]]:
    """Times and poses of a trolley on a circle: 0.4 m/s, 16 degrees a second, 10 Hz."""
    for k in range(count):
        turn = 0.028 * k
        place = [1.4 * np.sin(turn), -1.4 * np.cos(turn), 0.0]
        yield 0.1 * k, from_rotation_vector([0.0, 0.0, turn], place)


def followed(tracker: Tracker, count: int, seed: int) -> list[tuple[Estimate, Floats]]:
    rng, track, found = np.random.default_rng(seed), tracker.begin(), []
    for k, (time_s, T) in enumerate(drive(count)):
        track, estimate = tracker.advance(track, k, time_s, views_at(T, rng))
        found.append((estimate, T))
    return found


def error(estimate: Estimate, T_true: Floats) -> Floats:
    """Twist from estimate to truth in the free directions (3,)."""
    assert estimate.T_world_object is not None
    return twist_between(estimate.T_world_object, T_true)[list(FREE)]


def is_wrong(estimate: Estimate, T_true: Floats) -> bool:
    x, y, turn = error(estimate, T_true)
    return bool(np.hypot(x, y) > 0.15 or abs(turn) > np.radians(15))


def sum_by_hand(odds: Floats, used: frozenset[int] = frozenset()) -> float:
    if odds.shape[1] == 0:
        return 1.0
    rest = odds[:, 1:]
    met = sum(
        float(odds[i, 0]) * sum_by_hand(rest, used | {i}) for i in range(len(odds)) if i not in used
    )
    return sum_by_hand(rest, used) + met


def test_the_sum_over_associations_is_that_of_all_of_them() -> None:
    odds = 5 * np.random.default_rng(0).random((2, 3, 4))
    total, shares = _sum_and_shares(odds)
    assert total == pytest.approx([sum_by_hand(one) for one in odds], rel=1e-12)
    # how probable a pair is: the derivative of the logarithm by that of its odds
    more = odds.copy()
    more[:, 1, 2] *= 1 + 1e-6
    slope = np.log(_sum_and_shares(more)[0] / total) / 1e-6
    assert shares[:, 1, 2] == pytest.approx(slope, rel=1e-4)


def test_the_odds_of_one_tag_in_false_ranges_are_those_of_the_formula() -> None:
    tag = Body("tag", (PointFeature(np.array([0.2, 0.0, 0.0])), PointFeature(np.zeros(3))))
    normals = np.array([[0, 0, 1.0], [0, 0, -1.0]])
    tag = Body("tag", tag.features, normals)  # the second faces away from the anchor
    anchor = RangeSensor(np.array([0.0, 0.0, 3.0]))
    true = float(np.hypot(0.2, 3.0))
    found = np.array([true + SIGMA, true - 2 * SIGMA, 5.0])
    view = View("a", anchor, Observation(PointPattern(found[:, None], np.ones(3)), SIGMA))
    clutter, room = 3 - 0.75, max(20 * tag.radius, 20 * SIGMA)
    # L = Σ_λ Π_met P_D N Π_missed (1 − P_D) Π_rest c/W of Poisson clutter, over c = 3 alone
    bells = np.exp(-0.5 * np.array([1.0, 4.0, ((5 - true) / SIGMA) ** 2]))
    bells /= np.sqrt(2 * np.pi) * SIGMA
    expected = 3 * np.log(clutter / 3) + 3 - clutter
    expected += np.log(0.25 + 0.75 * bells.sum() * room / clutter)
    odds = sum_associations([view], tag, np.eye(4)[None]).log_odds[0]
    assert odds == pytest.approx(expected)


def test_ranges_err_by_more_than_said_where_residuals_say_so() -> None:
    # twenty degrees of freedom at 1 and twenty at 4
    assert noise_ratio(np.array([80.0, 20.0]), RangeRules()) == pytest.approx(np.sqrt(2.5))
    assert noise_ratio(np.array([1.0, 20.0]), RangeRules()) == 1.0


def test_a_frame_of_ranges_alone_forgets_nothing_of_cameras() -> None:
    before = RememberedNoise(("cam",), np.array([[3.0], [100.0]]), np.ones((4, 5)), fields=0.4)
    tracker = Tracker.create(TROLLEY, EstimatorOptions(free=("x", "y", "rz")), np.eye(4))
    track = replace(tracker.begin(), residuals=before)
    data = tracker.data(track, 0, None, views_at(np.eye(4), np.random.default_rng(3)))
    after = likelihood_of(data).judge(Fit(np.eye(4)), Start(np.eye(4))).noise
    np.testing.assert_array_equal(after.of(("cam",)), before.sums)
    np.testing.assert_array_equal(after.moments, before.moments)
    assert after.fields == before.fields
    # theirs are not taken for those of ranges, of which one frame has no more than it detects
    assert 0 < after.of(("",))[1, 0] <= 8 * len(TROLLEY) - 3


def test_a_turn_that_ranges_leave_open_is_as_uncertain_as_anywhere() -> None:
    # one tag at the origin of the body; the other faces away from all anchors
    tags = PointFeature(np.zeros(3)), PointFeature(np.array([0.2, 0.0, 0.0]))
    body = Body("tags", tags, np.array([[0, 0, 1.0], [0, 0, -1.0]]))
    rng = np.random.default_rng(7)
    views = []
    for k, anchor in enumerate(ANCHORS):
        found = anchor.project(np.zeros((1, 3)))[0] + rng.normal(0, SIGMA)
        views.append(
            View(f"anchor{k}", anchor, Observation(PointPattern(found, np.ones(1)), SIGMA))
        )
    variances = []
    for fewest in (1e12, 3.0):
        rules = Rules(judgement=JudgementRules(noise=NoiseModel(fewest_degrees=fewest)))
        options = EstimatorOptions(free=("x", "y", "rz"))
        tracker = Tracker.create(body, options, np.eye(4), rules=rules)
        data = tracker.data(tracker.begin(), 0, None, views)
        judged = likelihood_of(data).judge(Fit(np.eye(4)), Start(np.eye(4)))
        variances.append(np.diag(judged.covariance)[list(FREE)])
    assert np.sqrt(variances[0][2]) == pytest.approx(np.pi, rel=1e-6)
    # eight anchors all around: σ / √4 along each axis where all are detections of the tag
    assert (np.sqrt(variances[0][:2]) < 2 * SIGMA / 2).all()
    # σ_ε counts as known from 20 residuals: 20 / 18 by Student's distribution
    assert variances[1] / variances[0] == pytest.approx([20 / 18] * 3, rel=1e-6)


def test_the_gradient_of_the_likelihood_is_its_slope() -> None:
    T = from_rotation_vector([0.1, 0.2, 0.3], [0.3, -0.2, 0.05])
    views = views_at(T, np.random.default_rng(1))
    steps = 1e-5 * np.eye(6)
    ahead, behind = (
        sum_associations(views, TROLLEY, perturb(T, s)).log_odds for s in (steps, -steps)
    )
    gradient = sum_associations(views, TROLLEY, T[None]).gradient[0]
    assert gradient == pytest.approx((ahead - behind) / 2e-5, rel=1e-5, abs=1e-5)


def test_bodies_of_many_features_and_images_keep_the_matched_objective() -> None:
    views = views_at(np.eye(4), np.random.default_rng(2))
    assert are_associated(views, TROLLEY)
    many = Body("many", tuple(PointFeature(x) for x in np.random.default_rng(0).random((9, 3))))
    assert not are_associated(views, many)


def test_one_frame_leaves_the_turn_open_and_says_so() -> None:
    options = EstimatorOptions(free=("x", "y", "rz"))
    tracker = Tracker.create(SMALL, options, next(drive(1))[1])
    views = views_at(next(drive(1))[1], np.random.default_rng(3), SMALL)
    _, estimate = tracker.advance(tracker.begin(), 0, 0.0, views)
    assert estimate.status == "ambiguous"
    assert estimate.covariance is not None
    # associations known, ranges of 8 cm give 5.0 degrees; not known, never less
    assert np.sqrt(estimate.covariance[5, 5]) > np.radians(5.0)


def test_a_drive_is_followed_with_an_honest_covariance() -> None:
    options = EstimatorOptions(free=("x", "y", "rz"))
    found = followed(Tracker.create(TROLLEY, options, next(drive(1))[1]), 30, seed=4)
    sure = [(e, T) for e, T in found if e.status == "ok"]
    assert len(sure) > 15
    assert not any(is_wrong(e, T) for e, T in sure)
    errors = np.array([error(e, T) for e, T in found])
    # one frame alone gives a median of 4 degrees at best
    assert np.median(np.abs(errors[:, 2])) < np.radians(4.0)
    assert np.median(np.hypot(errors[:, 0], errors[:, 1])) < 0.035
    inside = 0
    for estimate, T_true in sure:
        assert estimate.covariance is not None
        e, C = error(estimate, T_true), estimate.covariance[np.ix_(FREE, FREE)]
        inside += bool(e @ np.linalg.solve(C, e) < chdtri(3, 0.05))
    assert inside > 0.88 * len(sure)


def test_frames_are_kept_apart_on_request() -> None:
    T_start = next(drive(1))[1]
    options = EstimatorOptions(free=("x", "y", "rz"), fuse=False)
    tracker = Tracker.create(TROLLEY, options, T_start)
    track, _ = tracker.advance(tracker.begin(), 0, 0.0, views_at(T_start, np.random.default_rng(5)))
    assert [branch.spread for branch in track.branches] == [None] * len(track.branches)


def test_precise_ranges_need_no_help_of_earlier_frames() -> None:
    options = EstimatorOptions(free=("x", "y", "rz"))
    T_start = next(drive(1))[1]
    tracker = Tracker.create(TROLLEY, options, T_start)
    track, rng = tracker.begin(), np.random.default_rng(6)
    for k, (time_s, T) in enumerate(drive(8)):
        track, estimate = tracker.advance(track, k, time_s, views_at(T, rng, sigma=0.002))
        assert estimate.status == "ok"
        assert estimate.T_world_object is not None
        # steps of 4 cm are twenty times the error of a range
        assert np.linalg.norm((estimate.T_world_object - T)[:3, 3]) < 0.004
        assert float(rotation_angle_deg(estimate.T_world_object, T)) < 1.0


def test_places_that_have_nothing_to_do_with_each_other_are_found_with_the_right_turn() -> None:
    """The sum over associations has maxima at wrong turns, 60 nats behind the right one."""
    options, rng = EstimatorOptions(free=("x", "y", "rz"), fuse=False), np.random.default_rng(7)
    tracker = Tracker.create(SMALL, options, np.eye(4), rotation_deg=180.0, distance=3.0)
    track = tracker.begin()
    for k in range(12):
        place, turn = rng.uniform(-2.2, 2.2, 2), rng.uniform(-np.pi, np.pi)
        T = from_rotation_vector([0.0, 0.0, turn], [*place, 0.0])
        views = views_at(T, rng, SMALL, sigma=0.02)
        track, estimate = tracker.advance(track, k, None, views)
        assert estimate.status == "ok"
        assert not is_wrong(estimate, T)


def test_ranges_are_searched_only_where_a_pose_elsewhere_may_be_as_likely() -> None:
    options, rng = EstimatorOptions(free=("x", "y", "rz")), np.random.default_rng(8)
    tracker = Tracker.create(TROLLEY, options, next(drive(1))[1])
    track, searched = tracker.begin(), 0
    for k, (time_s, T) in enumerate(drive(20)):
        track, estimate = tracker.advance(track, k, time_s, views_at(T, rng, sigma=0.02))
        searched += estimate.guesses is not None
    assert searched <= 5
    T[:2, 3] *= -1.0  # at the other end of the circle, where nothing lets expect it
    track, estimate = tracker.advance(track, 20, 2.0, views_at(T, rng, sigma=0.02))
    assert estimate.guesses is not None
    assert not is_wrong(estimate, T)


def test_exact_ranges_have_the_odds_of_all_features_met_exactly() -> None:
    T = from_rotation_vector([0.1, 0.2, 0.3], [0.3, -0.2, 0.05])
    views = views_at(T, np.random.default_rng(1), sigma=1e-6)
    found = sum_associations(views, TROLLEY, T[None])
    # offsets of the range that they err by take half of each
    assert found.reached[0] == len(ANCHORS) * len(TAGS)
    assert 0 < found.most[0] - found.log_odds[0] < found.reached[0]


def test_second_derivatives_are_differences_of_gradients_at_every_pose_of_a_batch() -> None:
    T = from_rotation_vector([0.1, 0.2, 0.3], [0.3, -0.2, 0.05])
    views = views_at(T, np.random.default_rng(1))
    tracker = Tracker.create(TROLLEY, EstimatorOptions())
    term = AssociationTerm(tracker.data(tracker.begin(), 0, None, views), 1.0, second=True)
    poses = perturb(T, 0.02 * np.random.default_rng(2).standard_normal((3, 6)))
    batch = term.linearise(poses)
    assert batch.hessian is not None
    for k, pose in enumerate(poses):
        steps = 1e-5 * np.eye(6)
        ahead, behind = (
            sum_associations(views, TROLLEY, perturb(pose, s)).gradient for s in (steps, -steps)
        )
        expected = (behind - ahead) / 2e-5
        largest = np.abs(expected).max()
        # differences over steps of 0.01 σ_ε leave (1/100)²/6 of fourth derivatives, and turns
        # that do not commute the part of the gradient over the second derivative
        np.testing.assert_allclose(
            batch.hessian[k], (expected + expected.T) / 2, atol=1e-3 * largest
        )
