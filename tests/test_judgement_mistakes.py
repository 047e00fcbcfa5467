"""A body of another size, or a sensor that stands otherwise than told, in a single frame."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from detections import ALL_FREE, TRUTH, detect
from matches import Seen, scored
from numpy.typing import NDArray
from scipy.special import logsumexp
from scipy.stats import multivariate_normal

from mixpose.body import Body, PointFeature
from mixpose.fit import EstimatorOptions
from mixpose.judgement import APART, NoiseModel, ScoredPose, possible_mistakes
from mixpose.judgement.mistakes import LENS, SIZE, evidence_of
from mixpose.records import Estimate
from mixpose.rigid import from_rotation_vector
from mixpose.sensors import ParallelBeam, PinholeCamera
from mixpose.tracking import Tracker

Floats = NDArray[np.float64]

# of a tool whose origin is its tip
POINTS = np.random.default_rng(5).uniform([-80.0, -80.0, 70.0], [80.0, 80.0, 230.0], (10, 3))


def body(size: float = 1.0, sigma: float = 0.0) -> Body:
    return Body("body", tuple(PointFeature(size * one, sigma**2 * np.eye(3)) for one in POINTS))


def estimate(
    given: Body, seen_by: list[PinholeCamera], told: list[PinholeCamera], noise: float
) -> Estimate:
    views = detect(seen_by, body(), TRUTH, noise=noise)
    views = [replace(view, sensor=camera) for view, camera in zip(views, told, strict=True)]
    tracker = Tracker.create(given, EstimatorOptions())
    return tracker.advance(tracker.begin(), 0, None, views)[1]


def turned(camera: PinholeCamera, degrees: float) -> PinholeCamera:
    turn = from_rotation_vector([0.0, 0.0, np.radians(degrees)], [0.0, 0.0, 0.0])
    return replace(camera, T_sensor_world=turn @ camera.T_sensor_world)


@pytest.mark.parametrize("noise", [0.02, 0.2, 0.5])
def test_with_the_body_and_the_cameras_as_told_frames_are_ok(
    pinhole_cameras: list[PinholeCamera], noise: float
) -> None:
    for cameras in (pinhole_cameras, pinhole_cameras[:2]):
        assert estimate(body(), cameras, cameras, noise).status == "ok"


@pytest.mark.parametrize("size", [0.98, 1.02])
def test_a_body_of_another_size_is_not_ok_before_several_cameras_and_called_so(
    pinhole_cameras: list[PinholeCamera], size: float
) -> None:
    found = estimate(body(size), pinhole_cameras, pinhole_cameras, 0.1)
    assert (found.status, found.doubt) == ("ambiguous", SIZE)
    # which one camera cannot tell from a distance
    one = pinhole_cameras[:1]
    assert estimate(body(size), one, one, 0.1).status == "ok"


def test_a_size_that_the_spread_of_the_body_allows_is_not_another(
    pinhole_cameras: list[PinholeCamera],
) -> None:
    found = estimate(body(1.01, sigma=1.0), pinhole_cameras, pinhole_cameras, 0.1)
    assert found.status == "ok"


def test_cameras_of_which_one_is_turned_contradict_each_other(
    pinhole_cameras: list[PinholeCamera],
) -> None:
    told = [turned(pinhole_cameras[0], 2.0), *pinhole_cameras[1:]]
    found = estimate(body(), pinhole_cameras, told, 0.1)
    assert (found.status, found.doubt) == ("ambiguous", APART)


def test_cameras_whose_distortion_was_forgotten_are_not_ok_and_said_to_have_other_lenses(
    pinhole_cameras: list[PinholeCamera],
) -> None:
    lenses = [
        replace(one, distortion=np.array([-0.25, 0.1, 0.0, 0.0])) for one in pinhole_cameras[:2]
    ]
    found = estimate(body(), lenses, pinhole_cameras[:2], 0.1)
    assert (found.status, found.doubt) == ("ambiguous", LENS)
    assert estimate(body(), lenses, lenses, 0.1).status == "ok"


def test_what_two_cameras_showed_to_be_wrong_is_wrong_where_one_alone_sees_the_body(
    pinhole_cameras: list[PinholeCamera],
) -> None:
    views = detect(pinhole_cameras[:2], body(), TRUTH, noise=0.1)
    for size, expected in ((1.02, ["ambiguous", "ambiguous"]), (1.0, ["ok", "ok"])):
        tracker = Tracker.create(body(size), EstimatorOptions())
        track, both = tracker.advance(tracker.begin(), 0, None, views)
        _, alone = tracker.advance(track, 1, None, views[:1])
        assert [both.status, alone.status] == expected


def test_evidence_is_the_marginal_likelihood_over_sizes_and_noise() -> None:
    rng = np.random.default_rng(2)
    X, r = rng.normal(size=(2, 9, 3)), rng.normal(size=9)
    s2 = np.array([0.1, 1.0])
    found, second = evidence_of(X, r, 9.0, s2)
    for k in range(2):
        each = [multivariate_normal(cov=X[k] @ X[k].T + one * np.eye(9)).logpdf(r) for one in s2]
        assert found[k] == pytest.approx(logsumexp(each) + 4.5 * np.log(2 * np.pi))
        best = s2[int(np.argmax(each))]
        S = np.linalg.inv(X[k].T @ X[k] / best + np.eye(3))
        mean = S @ X[k].T @ r / best
        np.testing.assert_allclose(second[k], S + np.outer(mean, mean), rtol=1e-9)


def seen_from(*twists: Floats, noise: float) -> ScoredPose:
    """A pose by sensors that each see ten features as from a pose a twist (6,) away, in σ_ε."""
    rng = np.random.default_rng(1)
    sensors = []
    for k, twist in enumerate(twists):
        J = rng.normal(size=(10, 2, 6))
        offsets = J @ twist + noise * rng.normal(size=(10, 2))
        sensors.append(Seen(J, str(k), offsets, places=rng.uniform(-200.0, 200.0, (10, 2))))
    pose = scored(TRUTH, *sensors)
    # as residuals tell it
    return replace(pose, variances=np.full(len(sensors), max(noise**2, 1e-4)))


# what one sees is not asked here
SENSORS = {str(k): ParallelBeam(1.0, np.zeros(2)) for k in range(3)}


def mistakes_in(pose: ScoredPose) -> dict[str, float]:
    found = possible_mistakes(pose, body(), ALL_FREE, NoiseModel(), SENSORS, {})
    return {one.what: one.log_odds for one in found if one.log_harm > np.log(0.4)}


def test_sensors_that_see_the_body_at_two_poses_contradict_each_other_and_at_one_do_not() -> None:
    away = np.array([0.4, -0.3, 0.3, 0.0, 0.0, 0.0])
    apart = mistakes_in(seen_from(-away, away, noise=0.05))
    # far beyond the 17 nats that 2 in 10,000 sessions and 1 in 1,000 frames leave
    assert apart[APART] > 20
    assert mistakes_in(seen_from(0 * away, 0 * away, noise=0.05)) == {}


def test_a_sensor_that_stands_otherwise_harms_no_pose_that_the_others_draw() -> None:
    away = np.array([0.4, -0.3, 0.3, 0.0, 0.0, 0.0])
    pose = seen_from(0 * away, 0 * away, away, noise=0.05)
    assert mistakes_in(pose)[APART] > 20
    # of twenty times the noise it has a share of 1/800 in the pose
    hardly = mistakes_in(replace(pose, variances=0.05**2 * np.array([1.0, 1.0, 400.0])))
    assert hardly.get(APART, 0.0) < 1


def test_a_single_feature_that_is_far_off_is_no_contradiction() -> None:
    pose = seen_from(np.zeros(6), np.zeros(6), noise=0.05)
    offsets = pose.matches.offsets.copy()
    offsets[0, 3] += 0.5
    assert mistakes_in(replace(pose, matches=replace(pose.matches, offsets=offsets))) == {}
