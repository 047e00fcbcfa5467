"""Matches of several poses and sensors are what each pose and each sensor has by itself."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest
from detections import EIGHT, TRUTH, detect
from matches import Seen, matches_of
from numpy.typing import NDArray

from mixpose.body import Body
from mixpose.matching import AssociationRules, ErrorRules, Matches, associate
from mixpose.objective import View, matched_objective
from mixpose.records import PointPattern
from mixpose.rigid import from_rotation_vector, perturb, transform
from mixpose.sensors import PinholeCamera, RangeSensor, Sensor

Floats = NDArray[np.float64]

RULES = AssociationRules()
PER_POSE = [one.name for one in fields(Matches)][3:]


def matched(
    views: list[View], poses: Floats, body: Body = EIGHT, *, merged: bool = True
) -> Matches:
    objective = matched_objective(views, body, [view.observation.sigma for view in views])
    rules = replace(RULES, merged=merged)
    narrowest = ErrorRules().narrowest
    return Matches.stacked([associate(objective, T, rules, narrowest) for T in poses])


def assert_same(a: Matches, b: Matches) -> None:
    assert a.names == b.names
    assert a.dimensions.tolist() == b.dimensions.tolist()
    np.testing.assert_allclose(a.sigmas, b.sigmas, rtol=1e-12)
    for name in PER_POSE:
        one, other = getattr(a, name), getattr(b, name)
        assert (one is None) == (other is None), name
        if one is not None:
            # densities are float32
            near = 1e-6 if name == "explained" else 1e-9
            np.testing.assert_allclose(one, other, rtol=1e-9, atol=near, err_msg=name)


def poses_around(count: int, seed: int = 0) -> Floats:
    rng = np.random.default_rng(seed)
    twists = rng.uniform(-1, 1, (count, 6)) * np.repeat([2.0, 0.02], 3)
    return np.array([perturb(TRUTH, twist) for twist in twists])


def crowded(sensors: list[Sensor], seed: int = 0, sigma: float = 1.5) -> list[View]:
    """Two features hidden, and false detections that are as near to some of the others."""
    noise = 0.7 * sigma
    return detect(sensors, EIGHT, TRUTH, noise=noise, hidden=2, false=40, sigma=sigma, seed=seed)


@pytest.fixture
def mixed(pinhole_cameras: list[PinholeCamera], range_sensors: list[RangeSensor]) -> list[View]:
    """Two cameras, one of them with a calibration in doubt, and three ranges."""
    views = crowded([*pinhole_cameras, *range_sensors])
    turned = from_rotation_vector([0.0, 0.0, 0.001], np.zeros(3))
    camera = pinhole_cameras[1]
    doubted = replace(camera, T_sensor_world=turned @ camera.T_sensor_world)
    views[1] = replace(views[1], doubts=(camera, doubted))
    return views


def test_one_of_many_poses_has_the_matches_that_it_has_alone(mixed: list[View]) -> None:
    poses = poses_around(5)
    together = matched(mixed, poses)
    assert together.shares.shape == (5, 5, 8)
    for k, pose in enumerate(poses):
        assert_same(together.at(k), matched(mixed, pose[None]).at(0))
        assert_same(Matches.stacked([together.at(k)]).at(0), together.at(k))


def test_poses_that_are_put_together_again_are_those_that_were_taken_apart(
    mixed: list[View],
) -> None:
    together = matched(mixed, poses_around(4))
    assert_same(Matches.stacked([together.at(k) for k in range(4)]), together)


def test_bodies_of_fewer_features_are_filled_up_with_what_no_sensor_sees(
    mixed: list[View],
) -> None:
    five = Body("five", EIGHT.features[:5])
    alone = [matched(mixed, TRUTH[None], body).at(0) for body in (EIGHT, five)]
    both = Matches.stacked(alone)
    assert both.weights.shape == (2, 5, 8)
    for array in (both.weights, both.shares, both.squared, both.J):
        assert not array[1, :, 5:].any()
    assert (both.detections[1, :, 5:] == -1).all()
    for k, own in enumerate(alone):
        for name in ("met", "expected", "missed", "coverage", "measurements", "squares"):
            np.testing.assert_allclose(getattr(both, name)[k], getattr(own, name), rtol=1e-12)
        assert both.at(k).rms == pytest.approx(own.rms)


def test_some_of_the_sensors_have_what_they_have_without_the_others(mixed: list[View]) -> None:
    whole = matched(mixed, TRUTH[None]).at(0)
    doubted = np.array([False, True, False, True, False])
    for chosen in ([1, 3], doubted, np.array([1, 3])):
        some = whole.of_sensors(chosen)
        assert_same(some, matched([mixed[1], mixed[3]], TRUTH[None]).at(0))
        assert some.met_by.tolist() == np.count_nonzero(whole.shares[[1, 3]], axis=0).tolist()


def test_ranges_beside_cameras_have_one_coordinate(mixed: list[View]) -> None:
    found = matched(mixed, TRUTH[None]).at(0)
    assert found.dimensions.tolist() == [2, 2, 1, 1, 1]
    assert found.measurements == pytest.approx(found.dimensions * found.met)
    assert found.met.min() > 0
    # what is not there has neither an offset nor a Jacobian
    assert not found.offsets[2:, :, 1].any()
    assert not found.J[2:, :, 1].any()
    assert found.by_calibration is not None
    assert not found.by_calibration[[0, 2, 3, 4]].any()
    assert found.by_calibration[1].any()
    # a camera turned by 0.001 about its axis: features r px from the middle are 0.001 r / σ_ε off
    away = found.places[1] - np.array([639.5, 511.5])
    moved = np.linalg.norm(found.by_calibration[1, ..., 0], axis=1)
    np.testing.assert_allclose(moved, 0.001 * np.linalg.norm(away, axis=1) / 1.5, rtol=0.05)


def test_offsets_and_jacobians_are_in_standard_deviations_of_the_sensor(mixed: list[View]) -> None:
    found = matched(mixed, TRUTH[None]).at(0)
    twist = np.array([0.3, -0.2, 0.1, 0.001, -0.002, 0.001])
    world, moved = (transform(T, EIGHT.means) for T in (TRUTH, perturb(TRUTH, twist)))
    for k, view in enumerate(mixed):
        m = int(found.dimensions[k])
        y = view.sensor.project(world)[0]
        np.testing.assert_allclose(found.places[k, :, :m], y, atol=1e-6)
        shift = (view.sensor.project(moved)[0] - y) / found.sigmas[k]
        # pairs that share a detection move as their middle; of the others to second order
        alone = np.array([list(found.detections[k]).count(j) < 2 for j in found.detections[k]])
        there = (found.J[k] @ twist)[:, :m]
        np.testing.assert_allclose(there[alone], shift[alone], atol=0.01 * np.abs(shift).max())
        pattern = view.observation.pattern
        assert isinstance(pattern, PointPattern)
        single = (found.detections[k] >= 0) & alone
        off = (pattern.points[found.detections[k, single]] - y[single]) / found.sigmas[k]
        np.testing.assert_allclose(found.offsets[k, single, :m], off, atol=1e-6)


def test_rows_are_those_of_least_squares_by_the_shares(mixed: list[View]) -> None:
    found = matched(mixed, TRUTH[None]).at(0)
    J, offsets = found.rows()
    assert J.shape == (5, 16, 6)
    np.testing.assert_allclose((offsets**2).sum(axis=1), found.squares, rtol=1e-12)
    for k in range(5):
        expected = sum(s * one.T @ one for s, one in zip(found.shares[k], found.J[k], strict=True))
        np.testing.assert_allclose(J[k].T @ J[k], expected, rtol=1e-9, atol=1e-12)


def test_what_a_sensor_has_adds_up_over_its_features() -> None:
    # by hand: three of four met, one of them half, in px of σ_ε = 2
    seen = Seen(
        np.zeros((4, 2, 6)),
        offsets=np.array([[2.0, 0.0], [0.0, 4.0], [2.0, 2.0], [0.0, 0.0]]),
        shares=np.array([1.0, 1.0, 0.5, 0.0]),
        sigma=2.0,
        unseen=1.0,
    )
    found = matches_of(seen)
    assert found.squared.tolist() == [[1.0, 4.0, 2.0, 0.0]]
    assert (found.met.tolist(), found.expected.tolist()) == ([2.5], [4.0])
    assert found.missed.tolist() == [1.5]
    assert found.coverage.tolist() == [0.5]
    assert found.measurements.tolist() == [5.0]
    assert found.squares.tolist() == [6.0]
    assert found.rms == pytest.approx([2 * np.sqrt(6 / 2.5)])
    assert matches_of(replace(seen, shares=np.zeros(4))).rms == [None]


def test_two_features_that_share_a_detection_are_met_as_one_in_each_pose(
    pinhole_cameras: list[PinholeCamera],
) -> None:
    camera = pinhole_cameras[0]
    y = camera.project(transform(TRUTH, EIGHT.means))[0]
    first, second = 0, int(np.argsort(np.linalg.norm(y - y[0], axis=1))[1])
    # a σ_ε so large that the two look near to each other
    views = detect([camera], EIGHT, TRUTH)
    pattern = views[0].observation.pattern
    assert isinstance(pattern, PointPattern)
    wide = 2 * float(np.linalg.norm(y[first] - y[second]))
    merged = np.vstack([np.delete(y, [first, second], axis=0), y[[first, second]].mean(axis=0)])
    observation = replace(
        views[0].observation, pattern=PointPattern(merged, np.ones(7)), sigma=wide / 4
    )
    found = matched([replace(views[0], observation=observation)], np.array([TRUTH, TRUTH]))
    pair = [first, second]
    assert found.merged.tolist() == [[1], [1]]
    assert found.shares[:, 0, pair].tolist() == [[0.5, 0.5]] * 2
    assert (found.detections[:, 0, pair] == 6).all()
    np.testing.assert_allclose(found.offsets[:, 0, pair], 0.0, atol=1e-9)
    # the Jacobian is that of their middle, which is the mean of theirs
    both = matched(detect([camera], EIGHT, TRUTH, sigma=wide / 4), TRUTH[None]).J[0, 0, pair]
    np.testing.assert_allclose(found.J[0, 0, pair], [both.mean(axis=0)] * 2, rtol=1e-9)


def nearest_by_hand(points: Floats, y: Floats, reach: float) -> list[int]:
    """By which detection each feature is met: the nearest pair of all, then of those left."""
    met = [-1] * len(y)
    away = np.linalg.norm(points - y[:, None], axis=2)
    while (least := away.min()) <= reach:
        i, j = np.argwhere(away == least)[0]
        met[i] = int(j)
        away[i], away[:, j] = np.inf, np.inf
    return met


@pytest.mark.parametrize("seed", range(6))
def test_features_meet_the_nearest_detections_that_no_nearer_feature_takes(
    seed: int, pinhole_cameras: list[PinholeCamera], range_sensors: list[RangeSensor]
) -> None:
    # σ_ε of 6: every detection is within reach of some features, and features of some detections
    views = crowded([*pinhole_cameras, *range_sensors], seed=seed, sigma=6.0)
    poses = poses_around(4, seed)
    found = matched(views, poses, merged=False)
    reach, contested = 1.5518 * np.sqrt(2) * 6.0, 0  # √(−2 ln 0.3) deviations of C
    for h, pose in enumerate(poses):
        for k, view in enumerate(views):
            pattern = view.observation.pattern
            assert isinstance(pattern, PointPattern)
            y = view.sensor.project(transform(pose, EIGHT.means))[0]
            expected = nearest_by_hand(pattern.points, y, reach)
            assert found.detections[h, k].tolist() == expected
            assert found.shares[h, k].tolist() == [float(j >= 0) for j in expected]
            near = np.linalg.norm(pattern.points - y[:, None], axis=2) <= reach
            contested += int((near.sum(axis=0) > 1).sum())
    assert contested > 40  # detections that two features could have
