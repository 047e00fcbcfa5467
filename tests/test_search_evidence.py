"""Very many poses are judged at once as each is judged in the end."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from detections import ALL_FREE, EIGHT, TRUTH, detect, view_of
from numpy.typing import NDArray

from mixpose.body import Body, PointFeature
from mixpose.fit import EstimatorOptions
from mixpose.judgement import DetectionModel, JudgementRules, NoiseModel, judge
from mixpose.matching import AssociationRules, ErrorRules
from mixpose.objective import View, matched_objective
from mixpose.rigid import from_rotation_vector, perturb, transform
from mixpose.search import search_frame
from mixpose.search.poses import evidence
from mixpose.search.problem import SearchProblem, sensor_detections
from mixpose.sensors import PinholeCamera
from mixpose.tracking import Tracker
from mixpose.tracking.proposers import candidates_of

Floats = NDArray[np.float64]


def seen(camera: PinholeCamera, count: int = 8) -> Floats:
    """Where the first features are seen."""
    return camera.project(transform(TRUTH, EIGHT.means[:count]))[0]


def evidence_of(camera: PinholeCamera, points: Floats, body: Body = EIGHT) -> float:
    return evidence_in([view_of("0", camera, points)], body)


def evidence_in(views: list[View], body: Body = EIGHT) -> float:
    return float(evidence(problem(views, body), TRUTH[None])[0][0])


def problem(
    views: list[View], body: Body = EIGHT, rules: JudgementRules = JudgementRules()
) -> SearchProblem:
    detections = sensor_detections(views, body)
    return SearchProblem(detections, body, ALL_FREE, np.eye(4), rules)


def spread_out(camera: PinholeCamera, count: int, away_from: Floats) -> Floats:
    """Places all over the image, none near some others."""
    u, v = np.meshgrid(np.arange(40.0, 1280, 80), np.arange(40.0, 1024, 80))
    places = np.stack([u.ravel(), v.ravel()], axis=1)
    near = np.linalg.norm(places[:, None] - away_from, axis=2).min(axis=1)
    return np.asarray(places[near > 60][:count])


def test_the_evidence_of_the_search_is_that_of_the_judgement(
    pinhole_cameras: list[PinholeCamera],
) -> None:
    never = (-1e9, np.ones(6))  # by volume: so that by count is cheaper
    in_one_place = pinhole_cameras[:1] * 2  # only the body's size says how far away features are
    for cameras, hidden, false in (
        (pinhole_cameras, 0, 0),
        (pinhole_cameras, 2, 6),
        (in_one_place, 0, 0),
    ):
        views = detect(cameras, EIGHT, TRUTH, noise=0.3, hidden=hidden, false=false)
        poses = perturb(TRUTH, np.array([np.zeros(6), [0.3, -0.2, 0.2, 0.002, 0.0, -0.003]]))
        found, _ = evidence(problem(views), poses)
        objective = matched_objective(views, EIGHT, [1.5] * len(views))
        for pose, log_odds in zip(poses, found, strict=True):
            judged = judge(objective, pose, ALL_FREE, prior=never)
            # either draws the noise of a sensor to another mean: a nat at most
            assert log_odds == pytest.approx(judged.log_evidence, abs=1.0)


def test_what_one_camera_meets_by_chance_is_no_noise_of_the_others(
    pinhole_cameras: list[PinholeCamera],
) -> None:
    first, second = pinhole_cameras[:2]
    y = second.project(transform(TRUTH, EIGHT.means))[0]
    by_chance = y + np.where(np.arange(8)[:, None] < 3, 2.0, 60.0)  # three, each 1.9 σ_ε off

    def both(places: Floats) -> float:
        return evidence_in([view_of("0", first, seen(first)), view_of("1", second, places)])

    # as noise of both, squares of 10.7 σ² would make the eight exact ones worth 30 nats less
    assert both(by_chance) > both(y + 60.0)


def test_clutter_makes_each_detection_that_is_met_less_telling(
    pinhole_cameras: list[PinholeCamera],
) -> None:
    camera = pinhole_cameras[0]
    y = seen(camera)
    clutter = spread_out(camera, 56, y)
    lost = evidence_of(camera, y) - evidence_of(camera, np.concatenate([y, clutter]))
    # none of them is around the body: three of 64 and not of 8 fix the pose
    # (up to four of the eight lie on the rim of their box)
    assert lost == pytest.approx(np.log(64 * 63 * 62 / (8 * 7 * 6)), abs=5 * np.log(8 / 4))


def test_a_crowd_around_the_body_makes_chance_matches_likelier(
    pinhole_cameras: list[PinholeCamera],
) -> None:
    camera = pinhole_cameras[0]
    y = seen(camera)
    middle = (y.min(axis=0) + y.max(axis=0)) / 2
    crowd = middle + 12.0 * np.array([[1.0, 0], [0, 1], [-1, 0], [0, -1]])
    scattered = spread_out(camera, len(crowd), y)
    crowded, sparse = (
        evidence_of(camera, np.concatenate([y, each])) for each in (crowd, scattered)
    )
    # 12 and not 8 around the body: ln 1.5 for each of 8, 10 of whose 16 coordinates are spare
    # (up to four of the eight lie on the rim of their box: at most 12 and not 4)
    assert 5 * np.log(1.5) - 1e-6 < sparse - crowded < 5 * np.log(3.0)


def test_a_feature_in_view_without_a_detection_costs_as_much_as_its_chance(
    pinhole_cameras: list[PinholeCamera],
) -> None:
    camera = pinhole_cameras[0]
    inner = 0.5 * EIGHT.means.mean(axis=0) + 0.5 * EIGHT.means[0]
    nine = Body("nine", (*EIGHT.features, PointFeature(inner)))
    y = seen(camera)
    lost = evidence_of(camera, y) - evidence_of(camera, y, nine)
    # a quarter; and three pins are chosen among nine features
    assert lost == pytest.approx(np.log(4) + np.log(9 * 8 * 7 / (8 * 7 * 6)))


def test_detections_met_to_a_tenth_of_a_pixel_are_better_evidence_than_to_a_pixel(
    pinhole_cameras: list[PinholeCamera],
) -> None:
    camera = pinhole_cameras[0]
    y = seen(camera)
    off = np.where(np.arange(16).reshape(8, 2) % 2, 1.5, -1.5) / np.sqrt(2)
    gained = evidence_of(camera, y + 0.1 * off) - evidence_of(camera, y + off)
    # squared errors of 8 and 0.08 σ², joined with 4 degrees of freedom of 0.2²; 10 of 16
    # coordinates are spare
    tight, loose = ((4 * 0.04 + squares) / 14 for squares in (0.08, 8.0))
    by_each = np.log(loose / tight) - 0.5 * (0.01 / tight - 1 / loose)
    assert gained == pytest.approx(8 * 10 / 16 * by_each, rel=0.01)


STRICT = JudgementRules(detection=DetectionModel(probability=0.9999))
EXACT = JudgementRules(noise=NoiseModel(ErrorRules(typical=1e-3, typical_degrees=1e3)))
SCATTERED = JudgementRules(association=AssociationRules(crowded=False))


def test_poses_are_ranked_by_the_rules_that_the_search_is_given(
    pinhole_cameras: list[PinholeCamera],
) -> None:
    camera = pinhole_cameras[0]
    aside = perturb(TRUTH, np.array([150.0, 0.0, 0.0, 0.0, 0.0, 0.0]))
    six = camera.project(transform(TRUTH, EIGHT.means[:6]))[0]
    eight = camera.project(transform(aside, EIGHT.means))[0]
    off = np.where(np.arange(16).reshape(8, 2) % 2, 1.5, -1.5)  # by √2 σ_ε each
    views = [view_of("0", camera, np.concatenate([six, eight + off]))]

    def ahead(rules: JudgementRules) -> float:
        first, second = evidence(problem(views, rules=rules), np.array([TRUTH, aside]))[0]
        return float(first - second)

    # six met exactly and two missed, against eight met loosely: ln 4 for a miss, or ln 10,000
    assert ahead(JudgementRules()) > 0 > ahead(STRICT)
    # where errors are known to be a thousandth of σ_ε, eight at 1.4 σ_ε are no longer worth a look
    assert ahead(EXACT) > ahead(JudgementRules()) + 10


@pytest.mark.parametrize("rules", [STRICT, EXACT, SCATTERED])
def test_the_rules_of_a_tracker_reach_the_evidence_of_its_search(
    rules: JudgementRules, pinhole_cameras: list[PinholeCamera]
) -> None:
    views = detect(pinhole_cameras[:2], EIGHT, TRUTH, noise=0.3, hidden=2, false=4)
    tracker = Tracker.create(EIGHT, EstimatorOptions())
    tracker = replace(tracker, rules=replace(tracker.rules, judgement=rules))
    (first, *_) = candidates_of(tracker.data(tracker.begin(), 0, None, views))
    found, _ = evidence(problem(views, rules=rules), first.T_world_object[None])
    assert first.evidence == pytest.approx(found[0])
    usual = search_frame(views, EIGHT, free=ALL_FREE, T_reference=None).candidates[0]
    assert abs(first.evidence - usual.evidence) > 0.5


def test_a_pose_that_meets_half_of_the_body_less_closely_than_spots_err_is_not_enough() -> None:
    """Nine markers within 29 px before cameras side by side: turned over, five of them are met.

    A third of the detections is left; the right pose meets 23 of 24 eight times as closely.
    """
    points = [[-5.4, -81.8, -34.2], [-24.2, -75.4, -108.7], [26.1, 12.6, 13.6]]
    points += [[106.7, 78.9, -136.0], [-67.7, -77.6, -51.2], [139.5, -135.9, -71.4]]
    points += [[-125.7, 23.6, 78.0], [-119.1, -10.7, 44.4], [97.2, 40.6, 154.4]]
    body = Body("nine", tuple(PointFeature(np.array(one)) for one in points))
    K = np.array([[1386.5, 0, 400.0], [0, 1386.5, 300.0], [0, 0, 1]])
    left = [[257.17, 394.56], [268.61, 394.72], [245.69, 403.27], [260.66, 413.52]]
    left += [[258.71, 400.47], [249.26, 401.68], [247.93, 406.89], [745.47, 441.55]]
    left += [[171.54, 196.78]]
    middle = [[247.63, 439.09], [262.72, 463.99], [270.66, 445.02], [249.90, 457.67]]
    middle += [[251.35, 452.37], [260.64, 450.98], [247.69, 454.16], [258.71, 445.65]]
    middle += [[511.89, 203.81], [579.25, 8.45], [266.78, 97.37]]
    right = [[249.79, 334.17], [260.89, 358.20], [252.12, 352.76], [249.81, 348.88]]
    right += [[253.46, 347.37], [262.82, 346.20], [272.87, 340.94], [264.92, 359.46]]
    right += [[767.74, 345.80], [179.97, 493.44], [458.59, 320.69], [118.84, 345.55]]
    right += [[314.60, 499.50], [464.85, 258.56]]
    seen = (
        (left, -0.021197, [319.695, 123.625, 6.778]),
        (middle, 0.0, [0.0, 710.988, 0.0]),
        (right, 0.021197, [-319.695, -499.574, 6.778]),
    )
    views = []
    for k, (points, turn, place) in enumerate(seen):
        T = from_rotation_vector([0.0, turn, 0.0], place)
        camera = PinholeCamera(K, resolution=(800, 600), T_sensor_world=T)
        views.append(view_of(str(k), camera, np.array(points)))
    found = search_frame(views, body, free=ALL_FREE, T_reference=None).candidates
    assert found[0].evidence > 50
