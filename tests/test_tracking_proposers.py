"""Where poses come from: each proposer finds what the others miss, and can be left out."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np
import pytest
from detections import EIGHT, TRUTH, detect, random_start, view_of
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from mixpose.body import Body, PointFeature
from mixpose.density import Observation
from mixpose.fit import EstimatorOptions, near
from mixpose.judgement import RememberedNoise, ScoredPose
from mixpose.matching import AssociationRules, ErrorRules, associate
from mixpose.objective import MatchedObjective, View, matched_objective
from mixpose.records import Estimate, PointPattern
from mixpose.rigid import (
    from_parts,
    from_rotation_vector,
    inverse,
    perturb,
    rotation_angle_deg,
    transform,
)
from mixpose.sensors import PinholeCamera
from mixpose.tracking import Rules, Tracker
from mixpose.tracking.frame import Frame, Start
from mixpose.tracking.likelihood import likelihood_of
from mixpose.tracking.proposers import (
    PROPOSERS,
    REFINEMENTS,
    _carry,
    _paired,
    agreed,
    look_alikes,
    merged_pair,
)
from mixpose.tracking.track import Track

Floats = NDArray[np.float64]


def without(tracker: Tracker, name: str) -> Tracker:
    """A tracker that does not have one of the proposers or refinements."""
    names = [one.__name__ for one in tracker.proposers]
    assert name in [*names, *(one.__name__ for one in tracker.refinements)]
    return replace(
        tracker,
        proposers=tuple(one for one in tracker.proposers if one.__name__ != name),
        refinements=tuple(one for one in tracker.refinements if one.__name__ != name),
    )


def only(tracker: Tracker, name: str) -> Tracker:
    """A tracker that has one proposer."""
    proposers = tuple(one for one in tracker.proposers if one.__name__ == name)
    assert len(proposers) == 1
    return replace(tracker, proposers=proposers)


def first_frame(tracker: Tracker, views: list[View]) -> Estimate:
    return tracker.advance(tracker.begin(), 0, None, views)[1]


def is_right(estimate: Estimate, T: Floats) -> bool:
    """Within a degree and 2 mm, tens of times what 0.1 px leave."""
    if estimate.T_world_object is None:
        return False
    near = np.linalg.norm((estimate.T_world_object - T)[:3, 3]) < 2
    return bool(near and rotation_angle_deg(estimate.T_world_object, T) < 1)


def test_all_are_on_as_a_rule_and_any_is_an_argument() -> None:
    tracker = Tracker.create(EIGHT, EstimatorOptions(), TRUTH)
    assert tracker.proposers == PROPOSERS
    assert tracker.refinements == REFINEMENTS
    none = replace(tracker, proposers=())
    assert none.proposers == ()


def test_without_any_proposer_every_frame_is_lost(pinhole_cameras: list[PinholeCamera]) -> None:
    tracker = replace(Tracker.create(EIGHT, EstimatorOptions(), TRUTH), proposers=())
    estimate = first_frame(tracker, detect(pinhole_cameras, EIGHT, TRUTH))
    assert estimate.status == "lost"
    assert estimate.T_world_object is None


def test_a_proposer_of_ones_own_is_a_function_that_yields_starts(
    pinhole_cameras: list[PinholeCamera],
) -> None:
    elsewhere = from_rotation_vector([1.4, -2.0, 0.7], [80.0, 20.0, -30.0])
    views = detect(pinhole_cameras, EIGHT, elsewhere, noise=0.1, false=3, hidden=1)

    def told(frame: Frame, ranked: list[ScoredPose]) -> Iterable[Start]:
        return [] if ranked else [Start(perturb(elsewhere, np.full(6, 0.01)), frame.close)]

    tracker = replace(Tracker.create(EIGHT, EstimatorOptions()), proposers=(told,))
    estimate = first_frame(tracker, views)
    assert is_right(estimate, elsewhere)
    assert (estimate.status, estimate.proposer) == ("ok", "told")


def test_a_right_prediction_finds_a_pose_in_clutter_where_poses_around_it_do_not(
    pinhole_cameras: list[PinholeCamera],
) -> None:
    # 340 false detections beside 7 true ones; the start is right, and said to be off by 80 mm and
    # 40 degrees: poses drawn from that are all somewhere in the clutter
    views = detect(pinhole_cameras[:1], EIGHT, TRUTH, noise=0.1, false=340, hidden=1, seed=1)
    tracker = Tracker.create(EIGHT, EstimatorOptions(), TRUTH, rotation_deg=40, distance=80)
    assert is_right(first_frame(tracker, views), TRUTH)
    assert is_right(first_frame(only(tracker, "predicted"), views), TRUTH)
    assert not is_right(first_frame(without(tracker, "predicted"), views), TRUTH)


def test_several_starts_find_a_pose_off_its_prediction_in_clutter(
    pinhole_cameras: list[PinholeCamera],
) -> None:
    # up to 15 mm and 7.5 degrees off, some 20 px, in 120 false detections: one descent goes astray,
    # and the search has too many triples that fit by chance
    views = detect(pinhole_cameras[:1], EIGHT, TRUTH, noise=0.1, false=120, hidden=1, seed=2)
    start = random_start(2, 15.0, 7.5)
    tracker = Tracker.create(EIGHT, EstimatorOptions(), start, rotation_deg=7.5, distance=15)
    assert is_right(first_frame(tracker, views), TRUTH)
    assert is_right(first_frame(only(tracker, "multistart"), views), TRUTH)
    assert not is_right(first_frame(without(tracker, "multistart"), views), TRUTH)


def test_the_search_finds_a_pose_that_was_not_predicted(
    pinhole_cameras: list[PinholeCamera],
) -> None:
    elsewhere = from_rotation_vector([1.4, -2.0, 0.7], [80.0, 20.0, -30.0])
    views = detect(pinhole_cameras, EIGHT, elsewhere, noise=0.1, false=3, hidden=1)
    tracker = Tracker.create(EIGHT, EstimatorOptions(), TRUTH)
    assert is_right(first_frame(tracker, views), elsewhere)
    assert is_right(first_frame(only(tracker, "searched"), views), elsewhere)
    assert not is_right(first_frame(without(tracker, "searched"), views), elsewhere)


def test_the_search_finds_a_body_among_many_times_as_many_false_detections(
    pinhole_cameras: list[PinholeCamera],
) -> None:
    # 7 of 67 detections: of triples drawn at random one in 60,000 is right, of those near each
    # other one in some thousand
    views = detect(pinhole_cameras[:1], EIGHT, TRUTH, noise=0.1, false=60, hidden=1, seed=0)
    estimate = first_frame(only(Tracker.create(EIGHT, EstimatorOptions()), "searched"), views)
    assert estimate.status == "ok"
    assert is_right(estimate, TRUTH)


PLATE = Body(
    "plate",
    tuple(
        PointFeature(np.array([x, y, 0.0]))
        for x, y in [(-50, -40), (50, -40), (40, 45), (-30, 35), (10, -10), (-45, 5)]
    ),
)


def test_a_flat_body_followed_at_the_wrong_tilt_is_turned_over() -> None:
    K = np.array([[900.0, 0, 640], [0, 900.0, 512], [0, 0, 1]])
    camera = PinholeCamera(K, resolution=(1280, 1024))
    T = from_rotation_vector([0.35, 0.25, 0.3], [10.0, -20.0, 600.0])
    towards = -T[:3, 3] / np.linalg.norm(T[:3, 3])
    mirrors = np.eye(3) - 2 * np.outer(towards, towards), np.diag([1.0, 1.0, -1.0])
    T_wrong = from_parts(mirrors[0] @ T[:3, :3] @ mirrors[1], T[:3, 3])
    tracker, turned = Tracker.create(PLATE, EstimatorOptions(), T_wrong), []
    for seed in range(3):
        views = detect([camera], PLATE, T, noise=0.1, seed=seed)
        assert is_right(first_frame(tracker, views), T)
        estimate = first_frame(without(tracker, "look_alikes"), views)
        assert estimate.T_world_object is not None
        turned.append(float(rotation_angle_deg(estimate.T_world_object, T)))
    # the wrong tilt meets all features, within a pixel or two: now and then nothing else is asked
    assert max(turned) > 40


def test_a_tilt_that_is_far_less_likely_at_first_is_not_followed_to_narrow_blurs(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    K = np.array([[900.0, 0, 640], [0, 900.0, 512], [0, 0, 1]])
    camera = PinholeCamera(K, resolution=(1280, 1024))
    T = from_rotation_vector([0.35, 0.25, 0.3], [10.0, -20.0, 600.0])
    dots = 40.0 * np.stack(np.divmod(np.arange(12), 4), axis=1) - [40.0, 60.0]
    dots += np.random.default_rng(0).uniform(-9.0, 9.0, dots.shape)
    plate = Body("plate", tuple(PointFeature(np.array([*dot, 0.0])) for dot in dots))
    drawn: list[Sequence[float]] = []

    def recorded(views: Sequence[View], body: Body, sigmas: Sequence[float]) -> MatchedObjective:
        drawn.append(sigmas)
        return matched_objective(views, body, sigmas)

    monkeypatch.setattr(near, "matched_objective", recorded)

    def tilted(behind: float) -> tuple[int, float]:
        """Blurs narrower than σ_ε, and how much less likely than the body the other tilt is."""
        alike = replace(Rules().look_alikes, behind=behind)
        tracker = Tracker.create(
            plate, EstimatorOptions(), T, rules=replace(Rules(), look_alikes=alike)
        )
        data = tracker.data(tracker.begin(), 0, None, detect([camera], plate, T, noise=0.02))
        likelihood, at = likelihood_of(data), Start(T)
        best = likelihood.judge(likelihood.fit(at), at)
        (start,) = look_alikes(data, [best])
        drawn.clear()
        tilt = likelihood.judge(likelihood.fit(start), start)
        return len(drawn), best.log_evidence - tilt.log_evidence

    # perspective tells so near by: with narrow blurs the tilt is as much less likely
    blurs, less = tilted(np.inf)
    assert blurs > 1
    assert less > 100
    assert tilted(50.0) == (0, less)


def test_of_several_cameras_the_tilt_is_that_of_the_one_that_meets_a_flat_body() -> None:
    K = np.array([[900.0, 0, 640], [0, 900.0, 512], [0, 0, 1]])
    camera = PinholeCamera(K, resolution=(1280, 1024))
    aside = from_rotation_vector([0.0, np.pi / 2, 0.0], [-600.0, 0.0, 600.0])
    other = PinholeCamera(K, resolution=(1280, 1024), T_sensor_world=aside)
    T = from_rotation_vector([0.35, 0.25, 0.3], [10.0, -20.0, 600.0])
    clutter = view_of("other", other, np.array([[100.0, 900.0], [1100.0, 80.0], [1200.0, 950.0]]))
    both = detect([camera, other], PLATE, T, noise=0.1)
    tracker = Tracker.create(PLATE, EstimatorOptions(), T)

    def tilts(views: list[View]) -> list[Start]:
        data = tracker.data(tracker.begin(), 0, None, views)
        start = Start(T)
        likelihood = likelihood_of(data)
        return list(look_alikes(data, [likelihood.judge(likelihood.fit(start), start)]))

    (tilt,) = tilts([both[0], clutter])
    (alone,) = tilts(both[:1])
    # turned as by that camera alone, where the body's middle stays
    np.testing.assert_allclose(tilt.T_world_object, alone.T_world_object, atol=1e-9)
    assert rotation_angle_deg(tilt.T_world_object, T) > 40
    assert tilts(both) == []  # two that meet it fix the tilt
    # a camera by itself is asked whatever it meets: a wrong tilt may be why it meets little
    few = view_of("camera", camera, camera.project(transform(T, PLATE.means[:2]))[0])
    assert len(tilts([few])) == 1


def test_of_what_is_surely_clutter_no_look_alikes_are_asked_for() -> None:
    K = np.array([[900.0, 0, 640], [0, 900.0, 512], [0, 0, 1]])
    aside = from_rotation_vector([0.0, 0.5, 0.0], [-300.0, 0.0, 80.0])
    one = PinholeCamera(K, resolution=(1280, 1024))
    other = PinholeCamera(K, resolution=(1280, 1024), T_sensor_world=aside)
    places = 30 * np.array([[x, y, 0.0] for x, y in np.ndindex(6, 6)])
    grid = Body("grid", tuple(PointFeature(place) for place in places))
    T = from_rotation_vector([0.2, 0.1, 0.3], [-70.0, -70.0, 600.0])
    dots = one.project(transform(T, grid.means[7:16]))[0]
    tracker = Tracker.create(grid, EstimatorOptions(), T)
    rng = np.random.default_rng(0)
    seen = [np.vstack([dots, rng.uniform(0, 900, (20, 2))]), rng.uniform(0, 900, (20, 2))]
    views = [view_of("one", one, seen[0]), view_of("other", other, seen[1])]
    data = tracker.data(tracker.begin(), 0, None, views)
    start, likelihood = Start(T), likelihood_of(data)
    best = likelihood.judge(likelihood.fit(start), start)
    # nine dots of the grid lie like nine others, a step off: these may be met where those are less
    # likely than clutter by what motion and misses tell, but not by any odds
    for evidence, is_asked in ((best.log_evidence, True), (-20.0, True), (-30.0, False)):
        some = list(look_alikes(data, [replace(best, log_evidence=evidence)]))
        assert bool(some) == is_asked
    assert best.log_evidence > 0


SIX = np.array(
    [[0, 0, 0], [80, 6, 10], [-55, 48, -12], [-30, -66, 25], [36, 40, 62], [22, -35, -48]], float
)
WAND = Body("wand", tuple(PointFeature(point) for point in SIX))


def two_in_one() -> tuple[PinholeCamera, Floats, Floats]:
    """A camera, a pose, and six places: those of two features 4 px apart are their middle."""
    camera = PinholeCamera(
        np.array([[700.0, 0, 320], [0, 700, 240], [0, 0, 1]]), np.zeros(4), (640, 480)
    )
    along = SIX[2] - SIX[1]
    R, _ = Rotation.align_vectors([[0.0, 0.0, 1.0]], [along])
    apart = Rotation.from_euler("y", 4.0 / 700 * 460 / np.linalg.norm(along))
    turned = (apart * R).as_matrix()
    T = from_parts(turned, np.array([0.0, 0.0, 460.0]) - turned @ SIX[1])
    y = camera.project(transform(T, SIX))[0]
    y[1:3] = y[1:3].mean(axis=0)
    return camera, T, y


def test_a_detection_taken_for_one_of_two_features_may_be_both_of_them() -> None:
    camera, T, y = two_in_one()
    views = [view_of("camera", camera, np.delete(y, 2, axis=0))]
    # as narrow blurs may have it: the first of the two is met exactly
    weights = np.array([1.0, 10.0, 0.0, 1.0, 1.0, 1.0])[:, None]

    def away(twist: Floats) -> Floats:
        there = camera.project(transform(perturb(T, twist), SIX))[0]
        return np.asarray((weights * (there - y)).ravel())

    bent = perturb(T, least_squares(away, np.zeros(6), x_scale=np.repeat([100.0, 1.0], 3)).x)
    tracker = Tracker.create(WAND, EstimatorOptions(), bent)
    data = tracker.data(tracker.begin(), 1, None, views)
    likelihood, here = likelihood_of(data), Start(bent)
    judged = likelihood.judge(likelihood.fit(here), here)
    assert judged.matches.shares[0, 2] == 0.0
    rivals = [start.T_world_object for start in merged_pair(data, likelihood, judged)]
    assert min(float(rotation_angle_deg(rival, T)) for rival in rivals) < 0.02
    assert rotation_angle_deg(bent, T) > 0.1


def test_two_features_may_share_a_spot_as_far_apart_as_disks_of_its_area_touch() -> None:
    """Detections without a size are looked for within 2.2 σ_ε = 3.3 px; 5 px are √2 times 3.5."""
    camera = PinholeCamera(np.eye(3), np.zeros(4), (100, 100), np.eye(4))
    places = np.array([[40.0, 40.0, 1.0], [45.0, 40.0, 1.0], [80.0, 80.0, 1.0]])
    body, rules = Body("three", tuple(map(PointFeature, places))), AssociationRules()
    for radius, is_paired in ((0.0, False), (3.4, False), (3.7, True)):
        pattern = PointPattern(places[[0, 2], :2], np.ones(2), radii=np.full(2, radius))
        view = View("camera", camera, Observation(pattern, 1.5))
        objective = matched_objective([view], body, [1.5])
        seen = associate(objective, np.eye(4), rules, ErrorRules().narrowest)
        paired, is_far = _paired(seen, rules.reach_squared, rules.middle, 1)
        assert (paired.merged.tolist() == [1], is_far) == (is_paired, is_paired)


def test_two_detections_of_one_image_may_both_be_of_two_features() -> None:
    camera, T, _ = two_in_one()
    # one more before the fifth, 1 px aside
    behind = transform(T, SIX)[4:5]
    before = transform(inverse(T), 0.8 * (behind + np.array([-1.0 / 700 * behind[0, 2], 0.0, 0.0])))
    points = np.concatenate([SIX, before])
    body = Body("wand", tuple(PointFeature(point) for point in points))
    y = camera.project(transform(T, points))[0]
    for pair in ([1, 2], [4, 6]):
        y[pair] = y[pair].mean(axis=0)
    weights = np.array([1.0, 10.0, 0.0, 1.0, 10.0, 1.0, 0.0])[:, None]

    def away(twist: Floats) -> Floats:
        there = camera.project(transform(perturb(T, twist), points))[0]
        return np.asarray((weights * (there - y)).ravel())

    bent = perturb(T, least_squares(away, np.zeros(6), x_scale=np.repeat([100.0, 1.0], 3)).x)
    views = [view_of("camera", camera, y[[0, 1, 3, 4, 5]])]
    tracker = Tracker.create(body, EstimatorOptions(), bent)
    data = tracker.data(tracker.begin(), 1, None, views)
    likelihood, here = likelihood_of(data), Start(bent)
    judged = likelihood.judge(likelihood.fit(here), here)
    assert judged.matches.missed.tolist() == [2.0]
    rivals = [start.T_world_object for start in merged_pair(data, likelihood, judged)]
    off = [float(rotation_angle_deg(rival, T)) for rival in rivals]
    # the nearest pair alone, and both
    assert len(off) == 2
    assert off[1] < 0.02 < off[0]


def test_two_features_seen_as_one_are_put_where_their_middle_is() -> None:
    camera, T, y = two_in_one()
    merged = np.delete(y, 2, axis=0)
    views = [view_of("camera", camera, merged)]
    start = perturb(T, np.array([1.0, -1.0, 2.0, 0.01, -0.01, 0.01]))
    tracker = Tracker.create(WAND, EstimatorOptions(), start)
    estimate = first_frame(tracker, views)
    bent = first_frame(without(tracker, "merged_pair"), views)
    assert estimate.T_world_object is not None
    assert bent.T_world_object is not None
    # without noise the middle of two images is the image of both to far less than a pixel
    assert rotation_angle_deg(estimate.T_world_object, T) < 0.02
    assert rotation_angle_deg(bent.T_world_object, T) > 0.05


def test_a_spot_of_two_features_that_is_cut_does_not_bend_the_pose() -> None:
    camera, T, y = two_in_one()
    y[1] += [1.0, 0.0]
    views = [view_of("camera", camera, np.delete(y, 2, axis=0))]
    tracker = Tracker.create(WAND, EstimatorOptions(), T)
    # spots were found to 0.03 px so far
    residuals = RememberedNoise(("camera",), np.array([[200 * 0.02**2], [200.0]]))
    data = tracker.data(replace(tracker.begin(), residuals=residuals), 1, None, views)
    likelihood, here = likelihood_of(data), Start(T)
    (rival,) = merged_pair(data, likelihood, likelihood.judge(likelihood.fit(here), here))
    # least squares would turn it by 0.1°
    assert rotation_angle_deg(rival.T_world_object, T) < 0.01


def followed_to_cut_spots(
    cameras: list[PinholeCamera], tracker: Tracker
) -> tuple[Estimate, Floats]:
    """A frame in which one of four spots in each camera is 1 px off, after six that are fine."""
    step, track = np.array([0.3, -0.2, 0.1, 0.002, -0.001, 0.003]), tracker.begin()
    for k in range(6):
        T = perturb(TRUTH, k * step)
        seen = detect(cameras, EIGHT, T, noise=0.03, seed=100 + k)
        track, _ = tracker.advance(track, k, k / 30, seen)
    T, rng, views = perturb(TRUTH, 6 * step), np.random.default_rng(1), []
    for k, camera in enumerate(cameras):
        y = camera.project(transform(T, EIGHT.means))[0] + rng.normal(0, 0.03, (8, 2))
        y, off = y[:4] if k == 0 else y[2:6], rng.normal(size=2)
        y[3 - k] += off / np.linalg.norm(off)
        views.append(view_of(str(k), camera, y))
    return tracker.advance(track, 6, 6 / 30, views)[1], T


def test_cut_spots_are_left_behind_where_the_noise_is_known(
    pinhole_cameras: list[PinholeCamera],
) -> None:
    tracker = Tracker.create(EIGHT, EstimatorOptions(), TRUTH)
    estimate, T = followed_to_cut_spots(pinhole_cameras, tracker)
    bent, _ = followed_to_cut_spots(pinhole_cameras, without(tracker, "agreed"))
    assert estimate.T_world_object is not None
    assert bent.T_world_object is not None
    assert estimate.proposer == "agreed"
    # six spots of 0.03 px leave 0.03 degrees; two that are 1 px off bend it by half a degree
    assert rotation_angle_deg(estimate.T_world_object, T) < 0.1
    assert rotation_angle_deg(bent.T_world_object, T) > 0.3


def followed(cameras: list[PinholeCamera], body: Body) -> tuple[Tracker, Track]:
    """For six frames, of which spots were found to 0.03 px."""
    tracker = Tracker.create(body, EstimatorOptions(), TRUTH)
    track = tracker.begin()
    for k in range(6):
        seen = detect(cameras, body, TRUTH, noise=0.03, seed=k)
        track, _ = tracker.advance(track, k, k / 30, seen)
    return tracker, track


def test_agreement_does_not_choose_among_sensors_that_disagree(
    pinhole_cameras: list[PinholeCamera],
) -> None:
    # all spots of one camera are 1 px lower, which no pose makes up for, as where it is out of
    # step: what the other sees alone is no better for it
    tracker, track = followed(pinhole_cameras, EIGHT)
    views = []
    for k, camera in enumerate(pinhole_cameras):
        y = camera.project(transform(TRUTH, EIGHT.means))[0]
        views.append(view_of(str(k), camera, y + np.array([0.0, 1.0 * k])))
    data = tracker.data(track, 6, 6 / 30, views)
    likelihood, start = likelihood_of(data), Start(TRUTH, tracker.start_uncertainty)
    judged = likelihood.judge(likelihood.fit(start), start)
    assert judged.residual_ratio > 1
    judged = replace(judged, proposer="predicted")
    assert list(agreed(data, likelihood, judged)) == []


def test_three_spots_that_agree_by_chance_are_no_better_than_five_that_do(
    pinhole_cameras: list[PinholeCamera],
) -> None:
    # three spots fix a pose, wherever they are: of one camera they show the body turned by 1.5°,
    # where the other five are up to 4 px off; those agree with one another
    T_other = perturb(TRUTH, np.array([0.5, 0.2, -0.4, 0.02, 0.01, -0.015]))
    tracker, track = followed(pinhole_cameras, EIGHT)
    views = []
    for k, (camera, count) in enumerate(zip(pinhole_cameras, (2, 6), strict=True)):
        y = camera.project(transform(TRUTH, EIGHT.means[:count]))[0]
        if k == 1:
            y[:3] = camera.project(transform(T_other, EIGHT.means[:3]))[0]
        views.append(view_of(str(k), camera, y))
    data = tracker.data(track, 6, 6 / 30, views)
    likelihood, there = likelihood_of(data), Start(T_other)
    judged = replace(likelihood.judge(likelihood.fit(there), there), proposer="predicted")
    found = [likelihood.fit(one).T_world_object for one in agreed(data, likelihood, judged)]
    assert min(rotation_angle_deg(T, TRUTH) for T in found) < 0.01
    assert len(found) <= data.rules.proposals.kept
    there = Start(TRUTH)
    judged = replace(likelihood.judge(likelihood.fit(there), there), proposer="predicted")
    found = [likelihood.fit(one).T_world_object for one in agreed(data, likelihood, judged)]
    assert all(rotation_angle_deg(T, T_other) > 0.5 for T in found)


def test_others_are_asked_where_spots_that_are_off_can_carry_them(
    pinhole_cameras: list[PinholeCamera],
) -> None:
    # one spot is 8 standard deviations off: of eight features, whose pose is a third of what each
    # tells, it moves some by more than the noise; of 200 itself, the most, by a sixth of it
    many = np.random.default_rng(3).uniform(-80, 80, (200, 3))
    for body in (EIGHT, Body("many", tuple(PointFeature(point) for point in many))):
        tracker, track = followed(pinhole_cameras, body)
        views = []
        for k, camera in enumerate(pinhole_cameras):
            y = camera.project(transform(TRUTH, body.means))[0]
            y += np.random.default_rng(k).normal(0, 0.02, y.shape)
            y[2] += [0.24 * (k == 0), 0.0]
            views.append(view_of(str(k), camera, y))
        data = tracker.data(track, 6, 6 / 30, views)
        likelihood, start = likelihood_of(data), Start(TRUTH, tracker.start_uncertainty)
        used = likelihood.judge(likelihood.fit(start), start).used
        off = data.rules.judgement.noise.errors.are_off(used, data.variances[:, None])
        assert off[0, 2]
        assert _carry(off, used, np.sqrt(data.variances), data) == (body is EIGHT)
