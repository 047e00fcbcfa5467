"""Single ranges of few anchors: several maxima, of which further frames tell the right one."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest
from detections import followed
from numpy.typing import NDArray
from scipy.special import chdtri

from mixpose.body import Body, PointFeature
from mixpose.density import Observation
from mixpose.fit import EstimatorOptions
from mixpose.judgement import ahead
from mixpose.objective import View
from mixpose.records import PointPattern
from mixpose.rigid import from_rotation_vector, perturb, transform, twist_between
from mixpose.search.poses import spread_poses
from mixpose.search.problem import SearchProblem, sensor_detections
from mixpose.sensors import PinholeCamera, RangeSensor
from mixpose.tracking import Tracker
from mixpose.tracking.frame import Frame, Start
from mixpose.tracking.proposers import predicted, within
from mixpose.tracking.ranges import AssociationLikelihood, sum_associations
from mixpose.tracking.rivals import log_odds_against

Floats = NDArray[np.float64]
SIGMA = 0.02


class Seen(NamedTuple):
    """A frame of three anchors around a body of five tags, 1.2 m wide."""

    body: Body
    T_world_object: Floats
    views: list[View]


def moving(seed: int, count: int, missing: float = 0.05) -> Iterator[Seen]:
    """Frames in which some ranges are missing, 5 % are false, and none is labelled."""
    rng = np.random.default_rng(seed)
    body = Body("tags", tuple(PointFeature(p) for p in rng.uniform(-0.6, 0.6, (5, 3))))
    around, heights = rng.uniform(0, 6) + 2.1 * np.arange(3), rng.uniform(0.2, 2.8, 3)
    anchors = [
        RangeSensor(np.array([4 * np.cos(a), 4 * np.sin(a), z]))
        for a, z in zip(around, heights, strict=True)
    ]
    turn, place = rng.uniform(-2, 2, 3), rng.uniform(-0.5, 0.5, 3)
    T = from_rotation_vector(turn, place + np.array([0.0, 0.0, 1.2]))
    step = rng.normal(size=6) * [0.04, 0.04, 0.02, 0.05, 0.05, 0.05]
    for _ in range(count):
        T, views = perturb(T, step), []
        for k, anchor in enumerate(anchors):
            found = anchor.project(transform(T, body.means))[0][:, 0] + rng.normal(0, SIGMA, 5)
            found = found[rng.random(5) > missing]
            found = np.append(found, rng.uniform(2, 6, rng.poisson(0.25)))
            pattern = PointPattern(rng.permutation(found)[:, None], np.ones(len(found)))
            views.append(View(f"anchor{k}", anchor, Observation(pattern, SIGMA)))
        yield Seen(body, T, views)


def second_frame(seed: int, missing: float = 0.05) -> tuple[Tracker, Frame]:
    (body, _, views), (_, _, then) = moving(seed, 2, missing)
    tracker = Tracker.create(body, EstimatorOptions())
    track, _ = tracker.advance(tracker.begin(), 0, 0.0, views)
    return tracker, tracker.data(track, 1, 0.1, then)


@pytest.mark.parametrize("seed", [112, 118])
def test_a_pose_is_ok_only_where_no_other_maximum_is_likely(seed: int) -> None:
    # 27.9: one of 10,000 is farther off
    told = followed(moving(seed, 6))
    assert [off for estimate, off in told if estimate.status == "ok" and off > 27.9] == []
    assert sum(estimate.status == "ok" for estimate, _ in told) >= 2


def test_places_are_searched_as_far_aside_as_false_ranges_move_the_middle() -> None:
    off = []
    for seed in range(20):
        ((body, T, views),) = moving(seed, 1)
        detections = sensor_detections(views, body)
        problem = SearchProblem(detections, body, np.ones(6, dtype=np.bool_), np.eye(4))
        middle = body.means.mean(axis=0)[None]
        places = transform(spread_poses(problem)[0], middle)
        off.append(np.linalg.norm(places - transform(T, middle), axis=2).min())
    # the middle of all ranges is 0.34 m off, in the median
    assert np.median(off) < 0.25


def test_maxima_that_are_unlikely_are_followed_as_frames_to_come_may_tell() -> None:
    _, data = second_frame(101)
    beliefs = [one.weight for one in data.predictions]
    assert min(beliefs) < 1e-3  # none of these is told
    assert min(beliefs) > 1e-9 * (1 - 1e-6)


def test_a_wide_prediction_gives_many_starts_and_a_narrow_one_none() -> None:
    _, data = second_frame(101)
    first = data.predictions[0]
    assert len(list(within(data, []))) > 5
    narrow = replace(first, uncertainty=np.full(6, 0.1 * SIGMA))
    assert list(within(replace(data, predictions=[narrow]), [])) == []
    # what a step or two show is no prior
    assert list(within(replace(data, predictions=[replace(first, spread=None)]), [])) == []


def test_what_frames_tell_of_two_maxima_adds_up() -> None:
    tracker, data = second_frame(101)
    best, *rivals = tracker.explain(data)
    assert len(data.predictions) > 1
    assert len(rivals) > 1
    for one in rivals:
        assert log_odds_against(data, one, best) == ahead(one, best)


def test_starts_that_lead_to_one_maximum_are_one_and_far_behind_ones_none() -> None:
    tracker, data = second_frame(101)
    T = tracker.explain(data)[0].T_world_object
    likelihood = AssociationLikelihood(data)
    starts = [Start(perturb(T, step)) for step in 0.005 * np.eye(6)]
    ((_, fit),) = likelihood.fits(starts)
    assert np.linalg.norm(twist_between(T, fit.T_world_object)) < 1e-2
    far = Start(perturb(T, np.array([3.0, 0, 0, 0, 0, 0])))
    assert [start for start, _ in likelihood.fits([far, starts[0]])] == [starts[0]]
    assert list(likelihood.fits([])) == []


def test_that_frames_fit_ill_adds_up_to_odds_of_a_pose_elsewhere() -> None:
    tracker, data = second_frame(101)
    best = tracker.explain(data)[0]
    start = Start(best.T_world_object)
    odds = list[float]()
    for before in (-np.inf, -60.0, 20.0, 30.0):
        known = replace(data, track=replace(data.track, elsewhere=before))
        likelihood = AssociationLikelihood(known)
        odds.append(likelihood.judge(likelihood.fit(start), start).elsewhere or 0.0)
    new, little, much, more = odds
    # of a surprise in this frame, where those before leave no room
    assert little == pytest.approx(new, abs=1e-6)
    # and what they tell adds to what it tells
    assert more - much == pytest.approx(10.0, abs=1e-6)


def test_an_ellipsoid_holds_where_a_pose_is_if_one_detection_is_false() -> None:
    tracker, data = second_frame(52, missing=0.3)
    T, likelihood = tracker.explain(data)[0].T_world_object, AssociationLikelihood(data)
    detection, rules = data.rules.judgement.detection, data.rules.acceptance
    found = sum_associations(data.views, data.body, T[None], likelihood._noise, detection)
    curved = likelihood._posterior(likelihood._noise, second=True).linearise(T[None])
    information = likelihood._definite(curved) + np.diag(1 / data.flat_prior[1] ** 2)
    twists, likely = likelihood._alternatives(T, found, information)
    some = twists[likely > 1 - rules.confidence]
    limit = chdtri(6, 1 - rules.confidence)
    # if it is right they are far outside
    assert np.vecdot(some @ information, some).max() > 4 * limit
    C, _ = likelihood._covariance(T, found)
    assert np.vecdot(some @ np.linalg.inv(C), some).max() < limit * (1 + 1e-6)


def test_frames_that_are_kept_apart_leave_nothing_to_the_next() -> None:
    ((body, _, views),) = moving(101, 1)
    tracker = Tracker.create(body, EstimatorOptions(fuse=False))
    track, _ = tracker.advance(tracker.begin(), 0, 0.0, views)
    assert min(one.weight for one in track.branches) >= 1e-3 * (1 - 1e-6)
    assert track.elsewhere == -np.inf


def test_a_pose_is_expected_as_much_as_the_prediction_is_believed() -> None:
    _, data = second_frame(101)
    first = data.predictions[0]
    T = first.T_world_object[None]
    whole, little = (
        replace(data, predictions=[replace(first, weight=weight)]).log_densities(T)[0]
        for weight in (1.0, 1e-2)
    )
    # of the rest, that it is anywhere, there is next to nothing so near
    assert whole - little == pytest.approx(np.log(100), abs=0.01)


def test_beside_a_camera_poses_that_are_hardly_likely_are_no_starts() -> None:
    _, data = second_frame(101)
    K = np.array([[600.0, 0, 320], [0, 600, 240], [0, 0, 1]])
    camera = PinholeCamera(K, np.zeros(5), (640, 480), np.eye(4))
    seen = View("camera", camera, Observation(PointPattern(np.zeros((1, 2)), np.ones(1)), 1.0))
    assert len(predicted(data, [])) == len(data.predictions)
    beside = data.changed(views=[*data.views, seen])
    assert 0 < len(predicted(beside, [])) < len(data.predictions)
    assert list(within(beside, [])) == []


def test_fewer_ranges_than_directions_tell_nothing_of_a_pose_elsewhere() -> None:
    ((body, T, views),) = moving(101, 1)
    some = []
    for view in views:
        pattern = view.observation.pattern
        assert isinstance(pattern, PointPattern)
        one = Observation(PointPattern(pattern.points[:1], np.ones(1)), SIGMA)
        some.append(replace(view, observation=one))
    tracker = Tracker.create(body, EstimatorOptions())
    data = tracker.data(tracker.begin(), 0, 0.0, some)
    likelihood = AssociationLikelihood(data)
    judged = likelihood.judge(likelihood.fit(Start(T)), Start(T))
    # three are met exactly, which no other pose does better; several tags may have one range
    assert judged.elsewhere is not None
    assert judged.elsewhere < 0
