"""What is known between frames: predictions and how wide they are, velocities, surprises."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from bodies_in_view import TOOL, at, body, views_of
from detections import ALL_FREE, EIGHT, TRUTH, detect, view_of
from numpy.typing import NDArray
from rounding import rounding
from scipy.stats import multivariate_t as student

from mixpose.body import Body, PointFeature
from mixpose.fit import EstimatorOptions
from mixpose.judgement import (
    DetectionModel,
    flat_prior,
    is_possible,
    judge,
)
from mixpose.objective import matched_objective
from mixpose.rigid import from_rotation_vector, inverse, perturb, transform, twist_between
from mixpose.search import SearchState
from mixpose.sensors import PinholeCamera
from mixpose.tracking import Track, Tracker, predict
from mixpose.tracking.following import follow
from mixpose.tracking.motion import MotionFilter, MotionRules, RandomWalk
from mixpose.tracking.track import Branch

Floats = NDArray[np.float64]

RULES = MotionRules()
MODEL = DetectionModel()
NARROW = np.repeat([0.5, np.radians(1.0)], 3)
VELOCITY = np.array([10.0, -20.0, 5.0, 0.1, -0.2, 0.3])


def branch(T: Floats = TRUTH, velocity: Floats | None = None) -> Branch:
    return Branch(T, 1.0, NARROW, velocity)


def moved(frame: float) -> Floats:
    return perturb(np.eye(4), frame * np.array([5.0, 0, 0, 0, 0, 0]))


def followed(track: Track, places: list[Floats], frame: int, time_s: float) -> Track:
    data = Tracker.create(EIGHT, EstimatorOptions()).data(track, frame, time_s, [])
    return follow(data, [(Branch(T, 1.0 / len(places)), ()) for T in places])


def prior_near(T: Floats, misses: int = 0, body: Body = EIGHT) -> tuple[float, Floats]:
    track = Track((branch(),), frame=0, misses=misses)
    data = Tracker.create(body, EstimatorOptions()).data(track, 1, None, [])
    return replace(data, predictions=[Branch(TRUTH, 1.0, NARROW)]).prior(T)


def test_a_body_that_moves_is_predicted_where_its_velocity_takes_it() -> None:
    track = Track((branch(velocity=VELOCITY),), frame=7, time_s=2.0)
    (prediction,) = predict(track, EIGHT, 8, 2.1)
    assert twist_between(TRUTH, prediction.T_world_object) == pytest.approx(0.1 * VELOCITY)


@pytest.mark.parametrize(("misses", "frames"), [(5, 6), (6, 0)])
def test_a_velocity_is_believed_for_five_frames_without_a_pose(misses: int, frames: int) -> None:
    track = Track((branch(velocity=VELOCITY / 100),), frame=7, misses=misses)
    (prediction,) = predict(track, EIGHT, 13, None)
    expected = frames * VELOCITY / 100
    assert twist_between(TRUTH, prediction.T_world_object) == pytest.approx(
        expected, abs=rounding(TRUTH)
    )


@pytest.mark.parametrize(("misses", "wider"), [(0, 1.0), (2, 2.25), (20, 12.0)])
def test_a_prediction_widens_with_every_frame_without_a_pose(misses: int, wider: float) -> None:
    track = Track((branch(),), frame=0)
    for _ in range(misses):
        track = track.missed(SearchState(), track.clutter)
    # by half each, then to four times and a tenth of that more for each
    (prediction,) = predict(track, EIGHT, 1, None)
    assert prediction.uncertainty == pytest.approx(wider * NARROW)


def test_a_pose_far_from_every_prediction_is_a_surprise_that_grows_with_the_wait() -> None:
    elsewhere = perturb(TRUTH, np.repeat([80.0, 0.7], 3))
    flat = flat_prior(EIGHT, ALL_FREE, MODEL)
    for misses, surprise in ((0, 0.02), (4, 0.1)):
        log_density, spread = prior_near(elsewhere, misses)
        assert log_density == pytest.approx(np.log(surprise) + flat[0])
        np.testing.assert_allclose(spread, flat[1])


def test_at_a_prediction_directions_that_are_open_are_as_uncertain_as_predicted() -> None:
    log_density, spread = prior_near(TRUTH)
    # Student's distributions with 3 degrees of freedom, and next to nothing of anywhere
    by_kind = [student(shape=np.diag(one**2), df=3) for one in np.split(NARROW, 2)]
    peak = np.log(0.98) + sum(one.logpdf(np.zeros(3)) for one in by_kind)
    assert log_density == pytest.approx(peak, abs=1e-3)
    np.testing.assert_allclose(spread, NARROW)


def test_a_sudden_turn_is_unlikely_but_no_surprise() -> None:
    # by 6 of the degrees that it may be off: normal errors would make that 6²/2 = 18 nats
    at, _ = prior_near(TRUTH)
    turned, _ = prior_near(perturb(TRUTH, np.array([0.0, 0.0, 0.0, 0.0, np.radians(6.0), 0.0])))
    assert at - turned == pytest.approx(3 * np.log(1 + 36 / 3), rel=0.02)


def test_what_a_frame_leaves_open_is_as_it_was_predicted() -> None:
    resting = followed(followed(Track(), [TRUTH], 0, 0.0), [TRUTH], 1, 0.1)
    data = Tracker.create(EIGHT, EstimatorOptions()).data(resting, 2, 0.2, [])
    predicted = data.predictions[0].uncertainty
    turned = perturb(TRUTH, np.array([0.0, 0, 0, 0.5, 0, 0]))

    def after(left_open: Floats) -> Branch:
        return follow(data, [(Branch(turned, left_open=left_open), ())]).branches[0]

    # a turn that is open a hundred times as far as it was predicted is predicted still
    unsure = after(np.diag((predicted * [0.0, 0.0, 0.0, 100.0, 100.0, 100.0]) ** 2))
    assert twist_between(TRUTH, unsure.T_world_object)[3:] == pytest.approx(
        [0.5 / (1 + 100**2), 0.0, 0.0], abs=1e-9
    )
    assert (unsure.uncertainty[3:] < 1.01 * predicted[3:]).all()
    # a pose that is sure stands where it is seen
    seen = after(np.zeros((6, 6))).T_world_object
    assert twist_between(TRUTH, seen)[3:] == pytest.approx([0.5, 0.0, 0.0], abs=1e-9)
    # one that is open along a line of sight alone goes on across it
    line, shift = np.array([0.6, 0.0, 0.8]), np.array([8.0, 3.0, -6.0])  # at right angles
    along = np.zeros((6, 6))
    along[:3, :3] = 1e12 * np.outer(line, line)
    away = Branch(perturb(TRUTH, np.array([*(shift + 500.0 * line), 0, 0, 0])), left_open=along)
    (across,) = follow(data, [(away, ())]).branches
    assert twist_between(TRUTH, across.T_world_object)[:3] == pytest.approx(shift, abs=1e-3)


def test_a_turn_that_a_frame_leaves_open_is_open_in_the_next_one() -> None:
    bar = body("bar", np.array([[-50.0, 0, 0], [0, 0, 0], [60, 0, 0]]))  # turns about itself
    solid = body("solid", TOOL)
    for tracked, is_open in ((bar, True), (solid, False)):
        tracker = Tracker.create(tracked, EstimatorOptions())
        track = tracker.begin()
        for frame in range(2):
            views = views_of([tracked], [at(0.0)], frame)
            track, found = tracker.advance(track, frame, None, views)
        assert (found.status == "ok") != is_open
        turns = track.branches[0].uncertainty[3:]
        assert (np.degrees(turns.max()) > 15.0) == is_open


def test_a_first_pose_that_is_open_is_no_surer_in_the_next_frame() -> None:
    data = Tracker.create(EIGHT, EstimatorOptions()).data(Track(), 0, 0.0, [])
    open_turn = np.repeat([0.0, np.radians(40.0)], 3)
    (branch,) = follow(data, [(Branch(TRUTH, left_open=np.diag(open_turn**2)), ())]).branches
    assert branch.uncertainty[3:] == pytest.approx(open_turn[3:])
    # never as unsure as a pose of which nothing is known
    (branch,) = follow(data, [(Branch(TRUTH, left_open=1e18 * np.eye(6)), ())]).branches
    assert np.array_equal(branch.uncertainty, data.flat_prior[1])


def test_how_far_a_prediction_erred_over_several_frames_counts_per_frame() -> None:
    track = followed(followed(Track(), [moved(0)], 0, 0.0), [moved(1)], 1, 0.1)
    for _ in range(3):
        track = track.missed(SearchState(), track.clutter)
    # in four steps it moved by 40 more than the 4 × 5 that were expected
    track = followed(track, [moved(5 + 8)], 5, 0.5)
    assert track.branches[0].uncertainty[:3] == pytest.approx([10.0] * 3)


def test_one_detection_where_a_feature_is_predicted_is_no_pose(
    pinhole_cameras: list[PinholeCamera],
) -> None:
    y = pinhole_cameras[0].project(transform(TRUTH, EIGHT.means))[0]
    views = [view_of("0", pinhole_cameras[0], y[:1])]
    prior = prior_near(TRUTH)
    judged = judge(matched_objective(views, EIGHT, [1.5]), TRUTH, ALL_FREE, prior=prior)
    # one is met, for at most ln(P_D σ_crowd⁻¹), and seven are missed, each for ln(1/4)
    assert judged.log_evidence < 7 * np.log(0.25) + 10
    assert not is_possible(judged, ALL_FREE)


def test_a_symmetric_body_is_where_it_was_predicted_whichever_way_it_is_turned() -> None:
    corners = ((50.0, 50.0, 0.0), (-50.0, 50.0, 0.0), (-50.0, -50.0, 0.0), (50.0, -50.0, 0.0))
    square = Body("square", tuple(PointFeature(np.array(corner)) for corner in corners))
    assert len(square.symmetries) > 3
    expected, _ = prior_near(TRUTH, body=square)
    for symmetry in square.symmetries:
        assert prior_near(TRUTH @ symmetry, body=square)[0] == pytest.approx(expected)


def test_a_velocity_is_per_second() -> None:
    track = followed(Track(), [moved(0)], 0, 0.0)
    assert track.branches[0].velocity is None
    track = followed(track, [moved(1)], 1, 0.1)
    assert track.branches[0].velocity == pytest.approx([50.0, 0, 0, 0, 0, 0])
    track = followed(track, [moved(3)], 2, 0.2)
    assert track.branches[0].velocity == pytest.approx([100.0, 0, 0, 0, 0, 0])
    # it moved by 5 more than expected: as much may happen again, in any direction
    assert track.branches[0].uncertainty[:3] == pytest.approx([5.0] * 3)
    least = RULES.steady[0] * EIGHT.radius
    steady = followed(track, [moved(5)], 3, 0.3)
    assert steady.branches[0].uncertainty[:3] == pytest.approx([least] * 3)


@pytest.mark.parametrize(("before", "after"), [(2.0, None), (None, 2.1)])
def test_no_velocity_holds_where_only_one_of_two_frames_has_a_time(
    before: float | None, after: float | None
) -> None:
    # it may be per second or per frame
    track = Track((branch(velocity=VELOCITY),), frame=7, time_s=before)
    (prediction,) = predict(track, EIGHT, 8, after)
    np.testing.assert_array_equal(prediction.T_world_object, TRUTH)
    data = Tracker.create(EIGHT, EstimatorOptions()).data(track, 8, after, [])
    assert follow(data, [(Branch(moved(1)), ())]).branches[0].velocity is None


def test_a_clock_that_goes_back_tells_no_time() -> None:
    track = Track((branch(velocity=VELOCITY),), frame=7, time_s=2.0)
    assert track.elapsed(8, 1.3) == 0.0
    data = Tracker.create(EIGHT, EstimatorOptions()).data(track, 8, 1.3, [])
    after = follow(data, [(Branch(moved(1), spread=NARROW), ())])
    assert np.isfinite(after.branches[0].uncertainty).all()


def test_of_two_places_where_a_body_may_be_each_goes_on_by_itself() -> None:
    there = perturb(np.eye(4), np.array([0.0, 300.0, 0.0, 0.0, 0.0, 0.0]))
    track = followed(Track(), [moved(0), there], 0, 0.0)
    track = followed(track, [there, moved(1)], 1, 0.1)
    assert track.branches[0].velocity == pytest.approx(np.zeros(6), abs=1e-9)
    assert track.branches[1].velocity == pytest.approx([50.0, 0, 0, 0, 0, 0])


def test_a_walk_grows_with_time_and_turns_although_only_shifts_were_seen() -> None:
    walk = RandomWalk(np.zeros(6), 0.0, RULES)
    walk = walk.joined(np.array([4.0, 0, 0, 0, 0, 0]), radius=100.0, elapsed=0.5)
    # 4 in half a second: 32 per second, 1.5 times as much as errors of prediction add up; turns
    # move the rim by a quarter of that
    assert walk.variance(1.0)[:3] == pytest.approx([48.0] * 3)
    assert walk.variance(1.0)[3:] == pytest.approx([0.25 * 48.0 / 100**2] * 3)
    assert walk.variance(0.25) == pytest.approx(walk.variance(1.0) / 4)


def test_the_noise_of_an_ambiguous_frame_is_not_remembered(
    pinhole_cameras: list[PinholeCamera],
) -> None:
    places = ((0.0, 0.0, 0.0), (50.0, 0.0, 0.0), (90.0, 0.0, 0.0))
    wand = Body("wand", tuple(PointFeature(np.array(place)) for place in places))
    tracker = Tracker.create(wand, EstimatorOptions(), TRUTH)
    views = detect(pinhole_cameras, wand, TRUTH, noise=0.2)
    track, estimate = tracker.advance(tracker.begin(), 0, 0.0, views)
    assert estimate.status == "ambiguous"
    assert track.residuals.names == ()
    assert not track.residuals.biases
    assert not track.residuals.moments.any()


def test_a_sure_frame_has_no_rivals_and_its_noise_is_remembered(
    pinhole_cameras: list[PinholeCamera],
) -> None:
    tracker = Tracker.create(EIGHT, EstimatorOptions(), TRUTH)
    views = detect(pinhole_cameras, EIGHT, TRUTH, noise=0.2)
    track, estimate = tracker.advance(tracker.begin(), 0, 0.0, views)
    assert estimate.status == "ok"
    assert estimate.hypotheses == ()
    # 2 · 8 · 2 coordinates, six of which the pose has used up, counted by how near they are met
    assert track.residuals.sums[1].sum() == pytest.approx(26, rel=0.01)


def test_a_start_may_be_as_far_off_as_is_said() -> None:
    said = Tracker.create(EIGHT, EstimatorOptions(), TRUTH, distance=7.0, rotation_deg=20.0)
    assert said.start_uncertainty == pytest.approx(np.repeat([7.0, np.radians(20.0)], 3))
    unsaid = Tracker.create(EIGHT, EstimatorOptions(), TRUTH)
    expected = np.repeat([0.1 * EIGHT.radius, np.radians(5.0)], 3)
    assert unsaid.start_uncertainty == pytest.approx(expected)


def test_a_course_goes_on_by_its_derivatives_and_spreads_by_what_jerk_may_do() -> None:
    """Place, velocity, acceleration and jerk by Taylor; a random walk of the jerk, integrated."""
    course, seconds = MotionFilter.begun(np.ones(6), EIGHT.radius, RULES), 0.3
    state = np.array([1.0, 2.0, 3.0, 4.0])
    course = replace(
        course, means=course.means + state, covariances=np.zeros_like(course.covariances)
    )
    means, covariances = course._predicted(seconds)
    t = seconds
    taylor = [
        1 + 2 * t + 3 * t**2 / 2 + 4 * t**3 / 6,
        2 + 3 * t + 4 * t**2 / 2,
        3 + 4 * t,
        4.0,
    ]
    np.testing.assert_allclose(means, np.broadcast_to(taylor, means.shape), rtol=1e-12)
    # shocks at s move a place at t by (t - s)^3 / 6, a velocity by (t - s)^2 / 2, and so on
    s = (np.arange(20000) + 0.5) * t / 20000
    moved = np.stack([(t - s) ** 3 / 6, (t - s) ** 2 / 2, t - s, np.ones_like(s)])
    walked = moved @ moved.T * t / 20000
    per_jerk = covariances / covariances[..., 3:, 3:] * t
    np.testing.assert_allclose(per_jerk, np.broadcast_to(walked, per_jerk.shape), rtol=1e-6)


def test_the_velocity_of_steady_motion_is_known_better_than_by_two_poses() -> None:
    deviation, seconds = np.repeat([0.1, 0.002], 3), 0.1
    velocity = np.array([100.0, -50.0, 20.0, 0.3, -0.2, 0.1])
    squared = []
    for seed in range(10):
        off = deviation * np.random.default_rng(seed).standard_normal((80, 6))
        course = MotionFilter.begun(deviation, EIGHT.radius, RULES)
        for step in velocity * seconds + np.diff(off, axis=0):
            course = course.followed(step, deviation, seconds)
        told = course.expected(None, 0.0)
        # half of what the last two tell
        assert (told.deviation < 0.5 * np.sqrt(2) * deviation / seconds).all()
        squared.append(((told.velocity - velocity) / told.deviation) ** 2)
    # 60 squares have a mean within 0.37 of 1 in 95 of 100 cases
    assert 0.6 < np.mean(squared) < 1.6


def test_a_pose_that_looks_like_the_one_before_is_no_turn_by_what_lies_between() -> None:
    """A square that seems to have turned by a quarter was followed at the wrong quarter before."""
    quarter = from_rotation_vector([0.0, 0.0, np.pi / 2], [0.0, 0.0, 0.0])
    track = followed(Track(), [np.eye(4)], 0, 0.0)
    data = Tracker.create(EIGHT, EstimatorOptions()).data(track, 1, 0.1, [])
    T = perturb(quarter, np.array([2.0, 0, 0, 0, 0, 0.01]))
    as_told = follow(data, [(Branch(T), ())]).branches[0]
    alike = follow(data, [(Branch(T), (inverse(quarter), quarter @ quarter))]).branches[0]
    assert as_told.velocity is not None
    assert alike.velocity is not None
    np.testing.assert_allclose(as_told.velocity[3:], [0, 0, 10 * (np.pi / 2 + 0.01)], atol=1e-9)
    np.testing.assert_allclose(alike.velocity, [20.0, 0, 0, 0, 0, 0.1], atol=1e-9)
    assert (alike.uncertainty[3:] < as_told.uncertainty[3:]).all()


def test_directions_that_are_held_tell_no_motion_from_another() -> None:
    """Held ones never move, so that the steadiest filter foretells them best."""
    free, held = np.repeat([0.1, 0.002], 3), np.array([0.1, 0.1, 0.1, 0.0, 0.0, 0.0])
    step = np.array([5.0, -3.0, 2.0, 0.0, 0.0, 0.0])
    courses = [MotionFilter.begun(each, EIGHT.radius, RULES) for each in (free, held)]
    for k in range(12):
        moved = step * np.cos(k)
        courses = [
            course.followed(moved, each, 0.1)
            for course, each in zip(courses, (free, held), strict=True)
        ]
    one, other = courses
    assert not other.log_likelihoods[:, 1].any()
    np.testing.assert_array_equal(one.log_likelihoods[:, 0], other.log_likelihoods[:, 0])
