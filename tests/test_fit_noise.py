"""Fits go on to blurs as narrow as the detections' noise where that moves the pose."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from detections import ALL_FREE, EIGHT, TRUTH, detect, view_of

from mixpose.body import Body, PointFeature
from mixpose.fit import EstimatorOptions, FitRules, fit_near, near
from mixpose.judgement import expected_covariance
from mixpose.matching import AssociationRules, ErrorRules, Matches, associate, errors_seen
from mixpose.objective import MatchedObjective, View, matched_objective
from mixpose.optimise import Ascent, ascend
from mixpose.records import Floats, PointPattern
from mixpose.rigid import inverse, perturb, transform, twist_between
from mixpose.sensors import PinholeCamera

NOISE_PX = 0.2
MANY = Body(
    "many",
    tuple(PointFeature(point) for point in np.random.default_rng(3).uniform(-110, 110, (70, 3))),
)
NEVER = FitRules(moved=np.inf)
ALWAYS = FitRules(moved=0.0)


def fitted(views: Sequence[View], body: Body, rules: FitRules = FitRules()) -> Floats:
    start = perturb(TRUTH, np.array([1.0, -0.8, 0.6, 0.004, -0.005, 0.003]))
    samples, spread = body.means[:, None], np.repeat([2.0, 0.01], 3)
    return fit_near(
        views, body, start, spread, EstimatorOptions(), samples, rules=rules
    ).T_world_object


def apart(views: Sequence[View], body: Body, T_a: Floats, T_b: Floats) -> float:
    """Distance of two poses in standard deviations of the detections' noise."""
    sensors, count = [view.sensor for view in views], len(views)
    covariance, _ = expected_covariance(sensors, [NOISE_PX] * count, body, TRUTH, ALL_FREE)
    twist = twist_between(T_a, T_b)
    return float(np.sqrt(twist @ np.linalg.solve(covariance, twist)))


def at_sigma(views: Sequence[View], body: Body) -> tuple[MatchedObjective, Ascent]:
    objective = matched_objective(views, body, [view.observation.sigma for view in views])
    return objective, ascend(objective, TRUTH[None], perturb, ALL_FREE, FitRules().sharp)


def matched(objective: MatchedObjective, T: Floats) -> Matches:
    return associate(objective, T, AssociationRules(), ErrorRules().narrowest)


def bent(views: list[View], by_px: float) -> list[View]:
    """Views of which the first detects one feature beside its place."""
    pattern = views[0].observation.pattern
    assert isinstance(pattern, PointPattern)
    points = pattern.points.copy()
    points[0] += [by_px, 0.0]
    return [view_of("0", views[0].sensor, points), *views[1:]]


@pytest.mark.parametrize("by_px", [1.5, 2.5])
def test_a_spot_that_is_cut_hardly_bends_the_pose(
    by_px: float, pinhole_cameras: list[PinholeCamera]
) -> None:
    views = detect(pinhole_cameras[:2], EIGHT, TRUTH, noise=NOISE_PX, seed=1)
    whole = fitted(views, EIGHT, NEVER)
    cut = bent(views, by_px)
    assert apart(views, EIGHT, fitted(cut, EIGHT, NEVER), whole) > 1.5
    # what least squares lose by one of sixteen detections, √(2 · 6/32 / (1 - 6/32)) = 0.7, and by
    # Welsch's loss in its place, √(0.05 · 6) = 0.55
    assert apart(views, EIGHT, fitted(cut, EIGHT), whole) < 1.25


def test_an_outlier_among_many_detections_is_left_where_it_moves_nothing(
    pinhole_cameras: list[PinholeCamera], monkeypatch: pytest.MonkeyPatch
) -> None:
    views = bent(detect(pinhole_cameras[:2], MANY, TRUTH, noise=NOISE_PX, seed=2), 1.0)
    drawn: list[Sequence[float]] = []

    def recorded(views: Sequence[View], body: Body, sigmas: Sequence[float]) -> MatchedObjective:
        drawn.append(sigmas)
        return matched_objective(views, body, sigmas)

    monkeypatch.setattr(near, "matched_objective", recorded)
    half = FitRules(moved=0.5)
    T = fitted(views, MANY, half)
    assert drawn == [[1.5, 1.5]]
    narrow = fitted(views, MANY, ALWAYS)
    assert len(drawn) > 2
    # foreseen by two steps of several
    assert 0 < apart(views, MANY, T, narrow) < half.moved * 1.4


@pytest.mark.parametrize("away", [1.8, 2.4])
def test_a_false_spot_beside_a_feature_does_not_draw_the_pose(
    pinhole_cameras: list[PinholeCamera], away: float
) -> None:
    clean = detect(pinhole_cameras[:2], EIGHT, TRUTH, noise=NOISE_PX, seed=2)
    seen = clean[0].observation
    assert isinstance(seen.pattern, PointPattern)
    spot = seen.pattern.points[3] + [away * seen.sigma, 0.0]
    spots = np.vstack([seen.pattern.points, spot])
    views = [view_of("0", clean[0].sensor, spots), clean[1]]
    drawn = apart(views, EIGHT, fitted(views, EIGHT, NEVER), fitted(clean, EIGHT, NEVER))
    left = apart(views, EIGHT, fitted(views, EIGHT), fitted(clean, EIGHT, NEVER))
    assert left < 0.8
    assert drawn > 1.5


def test_the_nearest_detection_but_its_own_is_seen_beside_each_feature(
    pinhole_cameras: list[PinholeCamera],
) -> None:
    clean = detect(pinhole_cameras[:2], EIGHT, TRUTH, noise=NOISE_PX, seed=2)
    seen = clean[0].observation
    assert isinstance(seen.pattern, PointPattern)
    # in place of the first feature's own spot, one that is as near to it and no feature's
    points = seen.pattern.points.copy()
    points[0] += [2.5 * seen.sigma, 0.0]
    objective, _ = at_sigma([view_of("0", clean[0].sensor, points), clean[1]], EIGHT)
    found = matched(objective, TRUTH)
    missed = int(np.flatnonzero(found.detections[0] == -1)[0])
    assert found.neighbour_distance[0, missed] == pytest.approx(2.5, abs=0.2)
    others = np.delete(found.neighbour_distance, missed, axis=1)
    spots, places = clean[1].observation.points, found.places[1]
    assert spots is not None
    for i, place in enumerate(places):
        away = np.linalg.norm(np.delete(spots, found.detections[1, i], axis=0) - place, axis=1)
        assert found.neighbour_distance[1, i] == pytest.approx(away.min() / found.sigmas[1])
    assert others.min() > 3.0


def test_neighbours_that_pull_send_a_fit_on_to_narrower_blurs(
    pinhole_cameras: list[PinholeCamera],
) -> None:
    pairs = np.repeat(EIGHT.means[::2], 2, axis=0) + np.tile([[0.0] * 3, [0.0, 3.0, 4.0]], (4, 1))
    body = Body("pairs", tuple(PointFeature(point) for point in pairs))
    views = bent(detect(pinhole_cameras[:2], body, TRUTH, noise=NOISE_PX, seed=2), 0.9)
    objective, _ = at_sigma(views, body)
    assert np.nanmin(matched(objective, TRUTH).neighbour_distance) < 3.0
    spread, samples = np.repeat([2.0, 0.01], 3), body.means[:, None]
    fit = fit_near(views, body, TRUTH, spread, EstimatorOptions(), samples)
    assert len(fit.blurs) > 1


@pytest.mark.parametrize("apart_px", [1.0, 2.0, 3.0])
def test_features_that_run_into_each_other_where_they_are_hidden_pull_at_nothing(
    apart_px: float, pinhole_cameras: list[PinholeCamera]
) -> None:
    # two behind each other for the first camera, which sees neither; the prediction has both
    camera = pinhole_cameras[0]
    first = transform(TRUTH, np.array([[20.0, 30.0, -10.0]]))[0]
    ray = first - inverse(camera.T_sensor_world)[:3, 3]
    side = np.cross(ray, [0.0, 0.0, 1.0])
    beside = first + 60 * ray / np.linalg.norm(ray) + apart_px * side / np.linalg.norm(side)
    pair = transform(inverse(TRUTH), np.array([first, beside]))
    body = Body("pair", (*EIGHT.features, *map(PointFeature, pair)))
    places = [one.project(transform(TRUTH, body.means))[0] for one in pinhole_cameras]
    views = [view_of("0", camera, places[0][:8]), view_of("1", pinhole_cameras[1], places[1])]
    T = fitted(views, body)
    for sensor, y in zip(pinhole_cameras, places, strict=True):
        found, _ = sensor.project(transform(T, body.means))
        assert np.abs(found - y).max() < 0.01


def test_how_far_narrower_blurs_move_the_pose_is_known_before(
    pinhole_cameras: list[PinholeCamera],
) -> None:
    errors, known = ErrorRules(), np.zeros((2, 2))
    for seed, body in ((1, EIGHT), (2, EIGHT), (3, MANY)):
        views = bent(detect(pinhole_cameras[:2], body, TRUTH, noise=NOISE_PX, seed=seed), 1.2)
        objective, ascent = at_sigma(views, body)
        sigmas = np.array([view.observation.sigma for view in views])
        matches = matched(objective, ascent.states[0])
        _, variances, blurs, _ = errors_seen(matches, 6, known, errors)
        expected, shift, _ = near._moved(matches, ALL_FREE, blurs, variances)
        narrow = matched_objective(views, body, (blurs * sigmas).tolist())
        end = ascend(narrow, ascent.states, perturb, ALL_FREE, FitRules().sharp).states[0]
        unit = float(np.sqrt(variances.mean())) * 1.5 / NOISE_PX
        moved = apart(views, body, end, ascent.states[0]) / unit
        # two steps of iterated least squares, of which there are some more
        assert 0.6 * moved < np.sqrt(expected) < 1.2 * moved
        y = objective.projection.project(np.concatenate([end[None], ascent.states])).y
        farthest = (np.linalg.norm(y[:, 0] - y[:, 1], axis=2) / sigmas[:, None]).max()
        assert 0.6 * farthest < shift < 1.2 * farthest


def test_a_fit_has_the_matches_at_its_own_pose_and_the_noise_that_they_show(
    pinhole_cameras: list[PinholeCamera],
) -> None:
    views = bent(detect(pinhole_cameras[:2], EIGHT, TRUTH, noise=NOISE_PX, seed=4), 1.5)
    objective, _ = at_sigma(views, EIGHT)
    samples, spread = EIGHT.means[:, None], np.repeat([2.0, 0.01], 3)
    for rules in (NEVER, ALWAYS):
        fit = fit_near(views, EIGHT, TRUTH, spread, EstimatorOptions(), samples, rules=rules)
        assert fit.matches is not None
        assert fit.noise is not None
        there = matched(objective, fit.T_world_object)
        np.testing.assert_allclose(fit.matches.offsets, there.offsets, atol=1e-9)
        noise = errors_seen(there, 6, np.zeros((2, 2)))
        np.testing.assert_allclose(fit.noise[1], noise[1])


def test_the_noise_of_frames_before_counts(pinhole_cameras: list[PinholeCamera]) -> None:
    views = bent(detect(pinhole_cameras[:2], EIGHT, TRUTH, noise=0.02, seed=5), 0.4)
    arguments = views, EIGHT, TRUTH, np.repeat([2.0, 0.01], 3), EstimatorOptions()
    samples = EIGHT.means[:, None]
    ends = [
        fit_near(
            *arguments, samples, noise=np.array([[200 * s**2] * 2, [200.0] * 2])
        ).T_world_object
        for s in (0.4, 0.02)
    ]
    # where detections erred by 0.6 px so far, one that is 0.4 px off is no outlier
    off = [apart(views, EIGHT, end, TRUTH) for end in ends]
    assert off[1] < off[0] / 2


def test_sensors_weigh_by_the_noise_that_they_showed_and_not_by_what_calibrations_err_by(
    pinhole_cameras: list[PinholeCamera],
) -> None:
    spread, samples = np.repeat([2.0, 0.01], 3), EIGHT.means[:, None]
    deviations = np.array([0.02, 0.4]) / 1.5
    known = np.array([200 * deviations**2, [200.0, 200.0]])
    covariance, _ = expected_covariance(pinhole_cameras, [0.4, 0.4], EIGHT, TRUTH, ALL_FREE)
    squared = {0.0: 0.0, 1.0: 0.0}
    for seed in range(20):
        views = [
            detect(pinhole_cameras, EIGHT, TRUTH, noise=noise, seed=seed)[k]
            for k, noise in enumerate((0.02, 0.4))
        ]
        rest = views, EIGHT, TRUTH, spread, EstimatorOptions(), samples
        for fields in squared:
            end = fit_near(*rest, noise=known, fields=fields).T_world_object
            twist = twist_between(TRUTH, end)
            squared[fields] += float(twist @ np.linalg.solve(covariance, twist)) / (6 * 20)
    # of two that weigh the same, errors of one count half: a quarter of 0.4² over 0.4² / 2
    assert 0.3 < squared[1.0] < 0.8
    # a quarter of the noise is taken for common, so that weights are 1 : 7 at most; each camera
    # alone tells of what lies along the other's line of sight
    assert squared[0.0] < 0.5 * squared[1.0]
