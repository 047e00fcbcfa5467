"""Predicted accuracy: against formulae, numerical derivatives, and simulated frames."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mixpose.body import Body, PointFeature, congruent_parts
from mixpose.design import (
    Plan,
    best_marker_move,
    best_new_sensor,
    confirm,
    noise_to_equal,
    plan_of,
    predict,
    spread_poses,
)
from mixpose.design.advice import scaled
from mixpose.design.prediction import at_tip
from mixpose.design.study import SHARE_OF_RADIUS
from mixpose.executing import in_processes
from mixpose.records import Floats
from mixpose.rigid import perturb, rotation_angle_deg, rotation_matrix, transform
from mixpose.sensors import ParallelBeam, PinholeCamera, RangeSensor, Sensor
from mixpose.session import load_session
from mixpose.session.marker_files import read_marker_file

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tools"))

from paper.planned import paper_poses, planned  # noqa: E402
from paper.systems import systems  # noqa: E402

TWO_CAMERAS = ROOT / "data" / "synthetic" / "two_cameras" / "session.toml"
ALL = np.ones(6, dtype=np.bool_)
POINTS = np.array([[0, 0, 0], [0, 30, 40], [10, 0, 90], [-20, -45, 40], [35, 10, 10.0]])
ORIGIN = np.zeros(3)


def three_beams() -> tuple[Sensor, ...]:
    """Parallel beams along three axes: each coordinate of a point is measured twice."""
    axes = [np.eye(3)[[i, j, k]] for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1))]
    beams = []
    for R in axes:
        T = np.eye(4)
        T[:3, :3] = R
        beams.append(ParallelBeam(1.0, np.array([500.0, 500.0]), (1001, 1001), T))
    return tuple(beams)


def body_of(points: Floats, sigma: float = 0.0) -> Body:
    return Body("b", tuple(PointFeature(point, sigma**2 * np.eye(3)) for point in points))


def point_sets(points: Floats, noise: float, markers: float = 0.0) -> Plan:
    names = ("a", "b", "c")
    sigmas = (3 * noise,) * 3
    return Plan(names, three_beams(), (noise,) * 3, sigmas, body_of(points, markers), ALL)


def registration_error(points: Floats, target: Floats, fle: float) -> float:
    """Fitzpatrick, West and Maurer (1998), equation 46, for a total error `fle` of each point."""
    centred = points - points.mean(axis=0)
    axes = np.linalg.svd(centred)[2]
    away = target - points.mean(axis=0)
    total = 0.0
    for axis in axes:
        d2 = away @ away - (away @ axis) ** 2
        f2 = ((centred**2).sum(axis=1) - (centred @ axis) ** 2).mean()
        total += d2 / f2
    return float(np.sqrt(fle**2 / len(points) * (1 + total / 3)))


POSE = np.eye(4)
POSE[:3, :3] = rotation_matrix([0.3, -0.5, 0.9])
POSE[:3, 3] = [12, -7, 25]


@pytest.mark.parametrize("target", [[0, 0, 0], [0, 0, -100], [40, -200, 10]])
@pytest.mark.parametrize("from_markers", [False, True])
def test_the_error_of_a_target_is_that_of_point_set_registration(
    target: list[float], *, from_markers: bool
) -> None:
    """Exact: isotropic errors of points, whether of their measurement or of the body itself."""
    tip = np.array(target, dtype=np.float64)
    # two views of each coordinate: σ/√2 along each of three axes
    plan = point_sets(POINTS, 0.2) if not from_markers else point_sets(POINTS, 1e-6, 0.2)
    fle = 0.2 * np.sqrt(3) if from_markers else 0.2 * np.sqrt(3 / 2)
    found = np.sqrt(np.trace(at_tip(predict(plan, POSE[None]), tip)[0]))
    assert found == pytest.approx(registration_error(POINTS, tip, fle), rel=1e-6)


def registered(points: Floats, measured: Floats, targets: Floats) -> Floats:
    """Where least squares puts targets (n, 3) that move with points (Kabsch)."""
    at, to = points.mean(axis=0), measured.mean(axis=0)
    U, _, Vt = np.linalg.svd((measured - to).T @ (points - at))
    R = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
    return np.asarray((targets - at) @ R.T + to)


def test_the_tip_of_a_real_tool_errs_as_registrations_of_it_do(recordings: Path) -> None:
    """Markers of NDI's tool that err by 0.25 mm in all, and tips 100 and 200 mm from it."""
    points = read_marker_file(recordings / "body_files" / "ndi_8700339.rom", "mm").points
    per_axis = 0.25 / np.sqrt(3)
    plan = point_sets(points, 1e-6, per_axis)
    rng = np.random.default_rng(0)
    noise = rng.normal(0, per_axis, (4000, *points.shape))
    tips = np.array([[0, 0, -100.0], [0, 0, -200], [0, -100, 0], [0, -200, 0]])
    errors = np.array([registered(points, points + each, tips) - tips for each in noise])
    for tip, found in zip(tips, np.sqrt((errors**2).sum(axis=2).mean(axis=0)), strict=True):
        predicted = np.sqrt(np.trace(at_tip(predict(plan, np.eye(4)[None]), tip)[0]))
        # 4000 draws of about three directions: 1 %; second order of 1/100 rad: 1e-4
        assert found == pytest.approx(predicted, rel=0.03)


@pytest.mark.parametrize("tip", [[0, 0, 0], [10, -40, 150]])
def test_errors_at_the_tip_follow_those_of_the_pose(tip: list[float]) -> None:
    prediction = predict(point_sets(POINTS, 0.5), POSE[None])
    L = np.linalg.cholesky(prediction.covariances[0])
    at = transform(POSE, np.array([tip], dtype=np.float64))[0]
    moves = []
    for column in L.T:  # derivatives along each of six independent directions
        ahead, behind = (perturb(POSE, sign * 1e-5 * column) for sign in (1, -1))
        moved = [transform(T, np.array([tip], dtype=np.float64))[0] for T in (ahead, behind)]
        moves.append((moved[0] - moved[1]) / 2e-5)
    expected = np.array(moves).T @ np.array(moves)
    assert np.linalg.norm(at) > 0
    covariance = at_tip(prediction, np.array(tip, dtype=np.float64))[0]
    np.testing.assert_allclose(covariance, expected, rtol=1e-6, atol=1e-9)


def test_markers_on_the_back_do_not_count() -> None:
    towards = np.repeat([[0.0, 0.0, -1.0]], len(POINTS), axis=0)  # to the first beam's source
    averted = towards.copy()
    averted[0] *= -1
    beam = (three_beams()[0],)
    free = np.array([True, True, False, False, False, True])
    predictions = []
    for body in (
        Body("b", body_of(POINTS).features, averted),
        Body("b", body_of(POINTS[1:]).features, towards[1:]),
    ):
        predictions.append(predict(Plan(("a",), beam, (1.0,), (1.0,), body, free), np.eye(4)[None]))
    assert predictions[0].seen.sum() == len(POINTS) - 1
    np.testing.assert_allclose(predictions[0].covariances, predictions[1].covariances)


def test_a_direction_that_no_sensor_sees_is_infinite_at_the_tip_too() -> None:
    beam = three_beams()[0]
    plan = Plan(("a",), (beam,), (1.0,), (1.0,), body_of(POINTS), ALL)
    prediction = predict(plan, np.eye(4)[None])
    assert np.isinf(prediction.covariances[0, 2, 2])  # along the beam
    tip = at_tip(prediction, ORIGIN)[0]
    assert np.isinf(tip[2, 2])
    assert np.isfinite(tip[0, 0])
    assert np.isfinite(tip[1, 1])


@pytest.mark.parametrize("number", [0, 1, 2])
def test_simulated_frames_of_the_papers_systems_err_as_predicted(number: int) -> None:
    """Markers of systems 2 and 3 err, too, in all sensors alike."""
    system = systems(0.25)[number]
    session = planned(system, 0.25)
    plan = replace(plan_of(session), noises=(0.25,) * len(system.sensors))
    found = confirm(session, plan, paper_poses(2), 100, tip=ORIGIN)
    # where noise is as large as sigma, one frame in a hundred looks as if a sensor were elsewhere
    assert found.statuses["ok"] >= 99
    assert found.chance == pytest.approx(1 / np.sqrt(2 * 100 * 6))
    # 5 %, and what 100 frames leave to chance
    assert abs(found.overall - 1) < 0.05 + found.chance


def test_frames_simulated_by_other_processes_are_those_of_this_one(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("mixpose.design.confirmation._FEWEST_FRAMES", 6)  # at two poses
    session = planned(systems(0.0)[0], 0.25)
    plan = replace(plan_of(session), noises=(0.25,) * 2)
    here = confirm(session, plan, paper_poses(2), 13, tip=ORIGIN)
    with in_processes(2) as workers:
        there = confirm(session, plan, paper_poses(2), 13, tip=ORIGIN, executor=workers)
    assert np.array_equal(here.found, there.found)
    assert np.array_equal(here.ratios, there.ratios)
    assert here.statuses == there.statuses


def test_ranges_alone_are_weighed_by_sigma_and_not_by_what_they_err_by() -> None:
    """Of two ranges that see the same, the one that errs four times as much counts as much."""
    first, second = (RangeSensor(np.array(place)) for place in ([0.0, -900.0, 0.0], [900.0, 0, 0]))
    ranges = (first, first, second, second)
    unlike = (0.1, 0.4, 0.1, 0.4)
    plan = Plan(("a", "b", "c", "d"), ranges, unlike, (1.0,) * 4, body_of(POINTS), ALL)
    mean = np.sqrt((0.1**2 + 0.4**2) / 4)  # of two measurements with equal weights
    alone = Plan(("a", "c"), (first, second), (mean, mean), (1.0, 1.0), plan.body, ALL)
    expected = predict(alone, POSE[None]).covariances
    np.testing.assert_allclose(predict(plan, POSE[None]).covariances, expected, rtol=1e-9)


def test_sensors_are_weighed_by_sigma_and_by_the_noise_that_they_show() -> None:
    first, second, _ = three_beams()
    beams = (first, first, second, second)
    unlike = (0.1, 0.4, 0.1, 0.4)
    plan = Plan(("a", "b", "c", "d"), beams, unlike, (1.0,) * 4, body_of(POINTS), ALL)
    alone = Plan(("a", "c"), (first, second), (1.0, 1.0), (1.0, 1.0), plan.body, ALL)
    # a quarter of the noise is that of all sensors: variances of 0.75 s² and a quarter of 0.085
    shares = 1 / (0.75 * np.square(unlike[:2]) + 0.25 * 0.085)
    mean = float(np.sqrt((shares * unlike[:2]) @ (shares * unlike[:2])) / shares.sum())
    expected = predict(replace(alone, noises=(mean, mean)), POSE[None]).covariances
    np.testing.assert_allclose(predict(plan, POSE[None]).covariances, expected, rtol=1e-9)
    # with sigma in proportion, as of one measurement whose information is the sum
    weighed = replace(plan, sigmas=unlike)
    best = (0.1**-2 + 0.4**-2) ** -0.5
    expected = predict(replace(alone, noises=(best, best)), POSE[None]).covariances
    np.testing.assert_allclose(predict(weighed, POSE[None]).covariances, expected, rtol=1e-9)


def test_simulated_frames_of_two_cameras_with_unlike_noise_err_as_predicted() -> None:
    session = load_session(TWO_CAMERAS)
    plan = replace(plan_of(session), noises=(0.1, 0.4))
    poses = spread_poses(session, 2)
    found = confirm(session, plan, poses, 200, tip=np.array([0, 0, -150.0]))
    assert abs(found.overall - 1) < 0.05 + found.chance
    # RMS of a vector with about two directions that count
    assert found.found[2] == pytest.approx(found.predicted[2], rel=0.1)


def test_ranges_are_as_good_as_cameras_with_the_noise_that_is_printed() -> None:
    first, third = systems(0.0)[0], systems(0.0)[2]
    poses = paper_poses(2)

    def error_of(plan: Plan) -> float:
        return float(np.sqrt(np.trace(predict(plan, poses).covariances[:, :3, :3].mean(axis=0))))

    cameras, ranges = (plan_of(planned(one, 0.25)) for one in (first, third))
    cameras = replace(cameras, noises=(0.25, 0.25))
    factor = noise_to_equal(ranges, error_of(cameras), error_of)
    assert factor is not None
    equal = scaled(ranges, factor)
    assert error_of(equal) == pytest.approx(error_of(cameras), rel=1e-8)
    found = confirm(planned(third, 0.25), equal, poses, 100, tip=ORIGIN)
    assert found.found[0] == pytest.approx(error_of(cameras), rel=0.12)


def test_no_noise_equals_a_system_whose_markers_err_less() -> None:
    poor = point_sets(POINTS, 0.1, 1.0)

    def error_of(plan: Plan) -> float:
        return float(np.sqrt(np.trace(predict(plan, POSE[None]).covariances[0, :3, :3])))

    assert noise_to_equal(poor, 0.5 * error_of(scaled(poor, 1e-6)), error_of) is None


def test_nothing_equals_a_system_that_determines_nothing_and_none_errs_without_end() -> None:
    plan = point_sets(POINTS, 0.1)

    def error_of(plan: Plan) -> float:
        return float(np.sqrt(np.trace(predict(plan, POSE[None]).covariances[0, :3, :3])))

    own = error_of(plan)
    assert noise_to_equal(plan, np.inf, error_of) is None
    assert noise_to_equal(plan, own, lambda _: np.inf) is None
    # errors grow as the noise does, and ten thousand times of it is the most that is looked at
    assert noise_to_equal(plan, 9e3 * own, error_of) == pytest.approx(9e3, rel=1e-6)
    assert noise_to_equal(plan, 1.1e4 * own, error_of) is None
    assert noise_to_equal(plan, own / 9e3, error_of) == pytest.approx(1 / 9e3, rel=1e-6)
    assert noise_to_equal(plan, own / 1.1e4, error_of) is None


def test_advice_gains_what_it_says() -> None:
    session = load_session(TWO_CAMERAS)
    plan, poses = plan_of(session), spread_poses(session, 6)

    def error_of(plan: Plan) -> float:
        return float(np.sqrt(np.trace(predict(plan, poses).covariances[:, :3, :3].mean(axis=0))))

    move = best_marker_move(plan, error_of)
    assert move is not None
    assert move.error < error_of(plan)
    assert np.linalg.norm(move.shift) == pytest.approx(plan.body.radius / 4)
    points = plan.body.means.copy()
    points[move.marker] += move.shift
    assert error_of(replace(plan, body=body_of(points))) == pytest.approx(move.error)
    middle = poses[0, :3, :3] @ plan.body.means.mean(axis=0) + poses[0, :3, 3]
    new = best_new_sensor(plan, error_of, middle)
    assert new is not None
    # a third camera of the same kind: about √(3/2) better at least
    assert new.error < error_of(plan) / 1.2
    assert isinstance(new.sensor, PinholeCamera)
    y, seen = new.sensor.project(middle[None])
    assert seen.all()
    np.testing.assert_allclose(y[0], new.sensor.camera_matrix[:2, 2], atol=1e-6)


def test_a_range_sensor_is_added_as_far_away_as_the_one_it_is_like() -> None:
    session = planned(systems(0.0)[2], 1.0)
    plan, poses = plan_of(session), paper_poses(3)
    middle = transform(poses[0], plan.body.means).mean(axis=0)

    def error_of(plan: Plan) -> float:
        return float(np.sqrt(np.trace(predict(plan, poses).covariances[:, :3, :3].mean(axis=0))))

    new = best_new_sensor(plan, error_of, middle)
    assert new is not None
    assert isinstance(new.sensor, RangeSensor)
    first = plan.sensors[plan.names.index(new.like)]
    assert isinstance(first, RangeSensor)
    away = [np.linalg.norm(sensor.position - middle) for sensor in (new.sensor, first)]
    assert away[0] == pytest.approx(away[1])
    assert new.error < error_of(plan)


def test_poses_fill_the_volume_and_no_more() -> None:
    session = load_session(TWO_CAMERAS)
    sides = np.array([100.0, 40.0, 10.0])
    poses = spread_poses(session, 64, volume=sides, turn_deg=15)
    middles = np.array([transform(T, session.body.means).mean(axis=0) for T in poses])
    off = middles - middles[0]
    assert (np.abs(off) <= sides / 2 + 1e-9).all()
    assert (np.ptp(off, axis=0) > 0.8 * sides).all()
    angles = rotation_angle_deg(poses, poses[0])
    assert angles.max() <= 15 + 1e-9
    assert angles.max() > 10
    np.testing.assert_array_equal(poses, spread_poses(session, 64, volume=sides, turn_deg=15))


def test_turns_favour_no_direction() -> None:
    session = load_session(TWO_CAMERAS)
    poses = spread_poses(session, 256, volume=np.ones(3), turn_deg=15)
    R = poses[1:, :3, :3] @ poses[0, :3, :3].T
    turns = Rotation.from_matrix(R).as_rotvec() / np.radians(15)
    # evenly in a ball of radius 1: <v> = 0, <v v^T> = 1/5; 256 points of a sequence that fills it
    # evenly do so to 0.01 (measured 0.007 and 0.009)
    np.testing.assert_allclose(turns.mean(axis=0), 0, atol=0.02)
    np.testing.assert_allclose(turns.T @ turns / len(turns), np.eye(3) / 5, atol=0.02)
    # over all rotations, the nine entries are uncorrelated and of variance 1/3
    wide = spread_poses(session, 512, volume=np.ones(3), turn_deg=180)
    entries = (wide[1:, :3, :3] @ wide[0, :3, :3].T).reshape(-1, 9)
    np.testing.assert_allclose(entries.mean(axis=0), 0, atol=0.05)
    np.testing.assert_allclose(entries.T @ entries / len(entries), np.eye(9) / 3, atol=0.05)


def test_markers_that_lie_like_those_of_another_body_are_named() -> None:
    rng = np.random.default_rng(3)
    first = np.array(
        [[0, 0, 0], [70, 5, 0], [-20, 60, 8], [9, -33, 41], [5, 12, 77], [40, 50, 25.0]]
    )
    shared = [4, 0, 2, 1]
    R, t = rotation_matrix([0.4, 1.1, -0.3]), np.array([100.0, 5, -30])
    second = np.concatenate([rng.uniform(-80, 80, (2, 3)), first[shared] @ R.T + t])
    second += rng.uniform(-0.5, 0.5, second.shape)
    alike = congruent_parts(body_of(first), body_of(second), 2.0)[0]
    pairs = zip(alike.features, alike.partners, strict=True)
    assert sorted(pairs) == sorted((i, 2 + k) for k, i in enumerate(shared))
    assert alike.off < 1.0
    mirrored = congruent_parts(body_of(first), body_of(second * [1, 1, -1]), 2.0)
    assert all(len(part.features) == 3 for part in mirrored)  # three are their own mirror image


def test_bodies_of_a_recording_that_are_taken_for_each_other_are_told(recordings: Path) -> None:
    folder = recordings / "several_bodies"
    forearm, arm = (
        load_session(folder / "wheelchair_4_bodies" / f"session_{name}.toml").body
        for name in ("ForearmL", "ArmL")
    )
    tolerance = SHARE_OF_RADIUS * min(forearm.radius, arm.radius)
    assert len(congruent_parts(forearm, arm, tolerance)[0].features) == 3
    assert not congruent_parts(forearm, arm, tolerance / 2)


def test_markers_on_a_line_do_not_count_as_alike() -> None:
    line = np.array([[0, 0, 0], [10, 0, 0], [30, 0, 0.0]])
    one = np.concatenate([line, [[0, 50, 0]]])
    other = np.concatenate([line, [[0, 0, 90]]])
    assert not congruent_parts(body_of(one), body_of(other), 1.0)
