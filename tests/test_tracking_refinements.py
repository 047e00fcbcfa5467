"""Refinements: spots of two features, and detections that agree where others pull a pose along."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from detections import EIGHT, TRUTH, detect, first_frame, view_of, without
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from mixpose.body import Body, PointFeature
from mixpose.density import Observation
from mixpose.fit import EstimatorOptions
from mixpose.judgement import RememberedNoise
from mixpose.matching import AssociationRules, ErrorRules, associate
from mixpose.objective import View, matched_objective
from mixpose.records import Estimate, PointPattern
from mixpose.rigid import (
    from_parts,
    inverse,
    perturb,
    rotation_angle_deg,
    transform,
)
from mixpose.sensors import PinholeCamera
from mixpose.tracking import Tracker
from mixpose.tracking.frame import Start
from mixpose.tracking.likelihood import likelihood_of
from mixpose.tracking.refinements import (
    _has_leverage,
    _paired,
    agreed,
    all_near,
    merged_pair,
    without_sensor,
)
from mixpose.tracking.track import Track

Floats = NDArray[np.float64]


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


def test_spots_that_are_all_farther_off_than_before_are_met_together() -> None:
    camera, T, _ = two_in_one()
    T = perturb(T, np.array([0.0, 0.0, 0.0, 0.4, 0.3, 0.2]))
    y = camera.project(transform(T, SIX))[0]
    y += np.random.default_rng(5).normal(0, 1.6, y.shape)

    def away(twist: Floats) -> Floats:
        return np.asarray((camera.project(transform(perturb(T, twist), SIX))[0] - y).ravel())

    labelled = perturb(T, least_squares(away, np.zeros(6), x_scale=np.repeat([100.0, 1.0], 3)).x)
    tracker = Tracker.create(WAND, EstimatorOptions(), T)
    data = tracker.data(tracker.begin(), 1, None, [view_of("camera", camera, y)])
    likelihood, here = likelihood_of(data), Start(T, tracker.start_uncertainty)
    judged = likelihood.judge(likelihood.fit(here), here)
    # four are met to less than noise
    assert judged.matches.missed.tolist() == [2.0]
    (start,) = all_near(data, likelihood, judged)
    again = likelihood.judge(likelihood.fit(start), start)
    assert again.matches.missed.tolist() == [0.0]
    assert rotation_angle_deg(again.T_world_object, labelled) < 0.01
    assert again.log_density > judged.log_density


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
        noise = np.sqrt(data.variances)[:, None, None]
        J, offsets = used.J / noise[..., None], used.offsets / noise
        met = J[used.shares > 0]
        assert _has_leverage(met, J[off], offsets[off], data.rules.fit) == (body is EIGHT)


def test_a_sensor_that_meets_one_of_eight_beside_others_may_meet_it_by_chance(
    pinhole_cameras: list[PinholeCamera],
) -> None:
    tracker, track = followed(pinhole_cameras, EIGHT)
    aside, seen = (one.project(transform(TRUTH, EIGHT.means))[0] for one in pinhole_cameras)
    # it is turned by two degrees, and a spot is 3 px beside a marker
    spots = np.concatenate([aside + np.array([40.0, 25.0]), aside[:1] + np.array([2.0, 2.0])])
    views = [view_of("0", pinhole_cameras[0], spots), view_of("1", pinhole_cameras[1], seen)]
    data = tracker.data(track, 6, 6 / 30, views)
    likelihood, here = likelihood_of(data), Start(TRUTH, data.close_uncertainty)
    judged = likelihood.judge(likelihood.fit(here), here)
    assert judged.matches.met[0] == 1.0
    (without,) = without_sensor(data, likelihood, judged)
    assert [*without.left_out] == ["0"]
    # where nothing is left beside it, it is covered
    covered = [view_of("0", pinhole_cameras[0], spots[-1:]), views[1]]
    data = tracker.data(track, 6, 6 / 30, covered)
    judged = likelihood_of(data).judge(likelihood_of(data).fit(here), here)
    assert judged.matches.met[0] == 1.0
    assert list(without_sensor(data, likelihood_of(data), judged)) == []


def test_what_a_prediction_meets_as_the_pose_does_shows_no_other_mode(
    pinhole_cameras: list[PinholeCamera],
) -> None:
    # one of sixteen spots is 1 px off, the body 2 mm beside where it is expected, and turned by 1°
    tracker, track = followed(pinhole_cameras, EIGHT)
    moved = perturb(TRUTH, np.array([1.5, -1.0, 0.5, 0.01, -0.01, 0.01]))
    views = []
    for k, camera in enumerate(pinhole_cameras):
        y = camera.project(transform(moved, EIGHT.means))[0]
        y[2] += [1.0 * (k == 0), 0.0]
        views.append(view_of(str(k), camera, y))
    data = tracker.data(track, 6, 6 / 30, views)
    likelihood, here = likelihood_of(data), Start(moved, data.close_uncertainty)
    judged = likelihood.judge(likelihood.fit(here), here)
    noise = data.variances[:, None]
    assert data.rules.judgement.noise.errors.are_off(judged.used, noise)[0, 2]
    assert list(agreed(data, likelihood, replace(judged, proposer="predicted"))) == []


def test_a_fit_that_is_pulled_far_away_is_sought_again_from_where_it_was_expected() -> None:
    # four of seven features, and spots beside the others: by all of these the body is turned by 7°
    flat = np.array(
        [[41, -23, -1], [-50, 61, 0], [79, 86, -2], [10, -76, 1], [-69, -69, -3], [-39, -63, -2]]
    )
    body = Body("flat", tuple(PointFeature(one) for one in [*flat, np.array([-5.0, -58.0, -2.0])]))
    K = np.array([[900.0, 0, 319.5], [0, 900.0, 255.5], [0, 0, 1]])
    T_sensor_world = from_parts(np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]), [0, 0, 953.5])
    camera = PinholeCamera(K, np.zeros(5), (640, 512), T_sensor_world)
    turn = Rotation.from_rotvec([-0.8114, 0.0073, 0.4555]).as_matrix()
    T = from_parts(turn, [-99.6, 111.4, 150.6])
    expected = perturb(T, np.array([-0.3, 3.0, 1.3, 0.003, 0.003, -0.001]))
    tracker = Tracker.create(body, EstimatorOptions(), expected)
    track = tracker.begin()
    for k in range(6):
        seen = detect([camera], body, expected, noise=0.06, seed=k)
        track, _ = tracker.advance(track, k, k / 25, seen)
    y = camera.project(transform(T, body.means))[0]
    spots = np.array([[221.9, 76.8], [276.9, 197.6], [118.5, 353.4], [117.8, 295.3], [22.5, 218.9]])
    views = [view_of("0", camera, np.concatenate([y[[0, 4, 5, 6]], spots]))]
    _, found = tracker.advance(track, 6, 6 / 25, views)
    assert found.T_world_object is not None
    # where the fit ends by itself, it is 5.7° off, and was ok
    assert rotation_angle_deg(found.T_world_object, T) < 0.1
