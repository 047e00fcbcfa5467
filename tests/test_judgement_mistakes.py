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
from mixpose.judgement import (
    APART,
    Mistake,
    NoiseModel,
    ScoredPose,
    odds_of_mistakes,
    possible_mistakes,
)
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
    found, means, spreads = evidence_of(X, r, 9.0, s2)
    for k in range(2):
        each = [multivariate_normal(cov=X[k] @ X[k].T + one * np.eye(9)).logpdf(r) for one in s2]
        assert found[k] == pytest.approx(logsumexp(each) + 4.5 * np.log(2 * np.pi))
        best = s2[int(np.argmax(each))]
        S = np.linalg.inv(X[k].T @ X[k] / best + np.eye(3))
        mean = S @ X[k].T @ r / best
        np.testing.assert_allclose(means[k], mean, rtol=1e-9)
        np.testing.assert_allclose(spreads[k], S, rtol=1e-9)


def seen_from(*twists: Floats, noise: float) -> ScoredPose:
    """A pose by sensors that each see ten features as from a pose a twist (6,) away, in σ_ε."""
    rng = np.random.default_rng(1)
    sensors = []
    for k, twist in enumerate(twists):
        J = rng.normal(size=(10, 2, 6))
        offsets = J @ twist + noise * rng.normal(size=(10, 2))
        sensors.append(Seen(J, str(k), offsets, places=rng.uniform(-200.0, 200.0, (10, 2))))
    # as residuals tell it
    return of_noise(scored(TRUTH, *sensors), *[max(noise**2, 1e-4)] * len(sensors))


def of_noise(pose: ScoredPose, *variances: float) -> ScoredPose:
    """The same by sensors of other noise."""
    rows = pose.matches.J / np.sqrt(variances)[:, None, None, None]
    covariance = np.linalg.inv(np.einsum("lnij,lnik->jk", rows, rows))
    return replace(pose, variances=np.array(variances), covariance=covariance)


# what one sees is not asked here
SENSORS = {str(k): ParallelBeam(1.0, np.zeros(2)) for k in range(3)}


# log odds of 0.999, up to which a pose is ok
DOUBT = np.log(999.0)


def against(pose: ScoredPose) -> float:
    """Log odds that sensors stand otherwise and put the pose elsewhere, one in 5000 sessions."""
    found = possible_mistakes(pose, body(), ALL_FREE, NoiseModel(), SENSORS, {})
    some = [one for one in found if one.what == APART]
    return float(logsumexp([-np.inf, *odds_of_mistakes(some, [2e-4] * len(some))]))


def test_sensors_that_see_the_body_at_two_poses_contradict_each_other_and_at_one_do_not() -> None:
    away = np.array([0.4, -0.3, 0.3, 0.0, 0.0, 0.0])
    assert against(seen_from(-away, away, noise=0.05)) > DOUBT
    assert against(seen_from(0 * away, 0 * away, noise=0.05)) < -DOUBT


def test_a_sensor_that_stands_otherwise_harms_no_pose_that_the_others_draw() -> None:
    away = np.array([0.4, -0.3, 0.3, 0.0, 0.0, 0.0])
    by_two, by_all = (
        seen_from(-share * away, -share * away, (1 - share) * away, noise=0.05)
        for share in (0.0, 1 / 3)
    )
    # of two that agree neither is likely to stand otherwise, as the third does
    assert against(by_two) < -DOUBT
    for noise in (0.1, 0.2, 0.3):
        assert against(of_noise(by_two, *[noise**2] * 3)) < -DOUBT
        assert against(of_noise(by_all, *[noise**2] * 3)) > DOUBT


def test_a_likelier_mistake_that_leaves_the_pose_in_place_tells_against_others() -> None:
    harmful, harmless = Mistake("a", APART, 20.0, 0.0), Mistake("b", APART, 40.0, -np.inf)
    (alone,) = odds_of_mistakes([harmful], [2e-4])
    assert alone == pytest.approx(20 + np.log(2e-4))
    both = odds_of_mistakes([harmful, harmless], [2e-4, 2e-4])
    # e²⁰ against e⁴⁰, whatever sessions are like
    assert both == [pytest.approx(-20.0, abs=1e-6), -np.inf]
    # which says nothing of the size of the body, that puts one pose of a hundred elsewhere
    of_size = odds_of_mistakes([Mistake("a", SIZE, 40.0, np.log(0.01)), harmless], [2e-4, 2e-4])
    assert of_size == [pytest.approx(np.log(0.01 / 0.99)), -np.inf]


def test_a_single_feature_that_is_far_off_is_no_contradiction() -> None:
    pose = seen_from(np.zeros(6), np.zeros(6), noise=0.05)
    offsets = pose.matches.offsets.copy()
    offsets[0, 3] += 0.5
    assert against(replace(pose, matches=replace(pose.matches, offsets=offsets))) < -DOUBT


def test_a_camera_that_a_pose_does_not_follow_tells_of_no_lenses(
    pinhole_cameras: list[PinholeCamera],
) -> None:
    """Of six, one was bumped by 0.2 degrees and sees two of ten markers: robust least squares
    passes over these 3 px."""
    first, cameras = pinhole_cameras[0], list[PinholeCamera]()
    for k in range(6):
        about = from_rotation_vector([0.0, 0.0, np.pi / 3 * k], [0.0, 0.0, 0.0])
        cameras.append(replace(first, T_sensor_world=first.T_sensor_world @ about))
    tilt = from_rotation_vector([np.radians(0.2), 0.0, 0.0], [0.0, 0.0, 0.0])
    bumped = replace(cameras[5], T_sensor_world=tilt @ cameras[5].T_sensor_world)
    for seed in range(4):
        views = detect(cameras, body(), TRUTH, noise=0.1, seed=seed)
        told = [*cameras[:5], bumped]
        views = [replace(view, sensor=camera) for view, camera in zip(views, told, strict=True)]
        few = views[5].observation
        views[5] = replace(views[5], observation=few.only(np.arange(few.cells) < 2))
        tracker = Tracker.create(body(), EstimatorOptions())
        track, found = tracker.advance(tracker.begin(), 0, None, views)
        assert found.status == "ok"
        track, found = tracker.advance(track, 1, None, views)
        assert found.status == "ok"
        assert LENS not in track.mistaken


@pytest.mark.parametrize(("degrees", "noise"), [(0.08, 0.05), (0.15, 0.1)])
@pytest.mark.parametrize("seed", range(4))
def test_a_camera_turned_by_little_amid_a_recording_is_told_by_a_few_frames(
    pinhole_cameras: list[PinholeCamera], degrees: float, noise: float, seed: int
) -> None:
    """Larger noise would explain each frame, but not that all of them ask for the same turn."""
    exact, since, rng = pinhole_cameras[:2], 12, np.random.default_rng(seed)
    turn = np.radians(degrees) * rng.choice([-1.0, 1.0], 3) / np.sqrt(3)
    T_turned = from_rotation_vector(turn, [0.1, -0.1, 0.0]) @ exact[1].T_sensor_world
    turned_by_little = [exact[0], replace(exact[1], T_sensor_world=T_turned)]
    tracker = Tracker.create(body(), EstimatorOptions())
    track, phases, estimates = tracker.begin(), rng.uniform(0, 2 * np.pi, 6), list[Estimate]()
    for frame in range(3 * since):
        step = np.array([90.0, 60.0, 60.0, 0.3, 0.3, 0.3]) * np.sin(0.15 * frame + phases)
        T = TRUTH @ from_rotation_vector(step[3:], step[:3])
        seen_by = turned_by_little if frame >= since else exact
        views = detect(seen_by, body(), T, noise=noise, seed=100 * seed + frame)
        views = [replace(view, sensor=camera) for view, camera in zip(views, exact, strict=True)]
        track, estimate = tracker.advance(track, frame, frame / 30, views)
        estimates.append(estimate)
    assert {estimate.status for estimate in estimates[:since]} == {"ok"}
    assert {estimate.status for estimate in estimates[since + 2 :]} == {"ambiguous"}
    assert sum(estimate.doubt == APART for estimate in estimates[since + 2 :]) >= 3
