"""Poses of one frame, and tracking from frame to frame."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from detections import (
    ALL_FREE,
    EIGHT,
    TRUTH,
    detect,
    interpolation_bound,
    interpolation_bound_of_features,
    random_start,
)

from mixpose.body import Body, PointFeature
from mixpose.density import Observation
from mixpose.fit import EstimatorOptions
from mixpose.judgement import RememberedNoise
from mixpose.objective import View
from mixpose.objective.matched import STEPS_PER_SIGMA
from mixpose.records import PointPattern
from mixpose.rigid import (
    from_rotation_vector,
    perturb,
    rotation_angle_deg,
    transform,
    twist_between,
)
from mixpose.sensors import PinholeCamera, RangeSensor
from mixpose.tracking import Tracker, estimate_pose


@pytest.fixture
def body() -> Body:
    return EIGHT


def test_a_camera_that_showed_little_noise_so_far_weighs_more(
    body: Body, pinhole_cameras: list[PinholeCamera]
) -> None:
    tracker = Tracker.create(body, EstimatorOptions(), TRUTH)
    known = np.array([200 * np.array([0.02, 0.4]) ** 2 / 1.5**2, [200.0, 200.0]])
    off = []
    # by each camera's own noise, and by noise that may as well be what calibrations err by
    for fields in (0.0, 1.0):
        before = RememberedNoise(("0", "1"), known, fields=fields)
        track = replace(tracker.begin(), residuals=before)
        squared = 0.0
        for seed in range(8):
            exact, noisy = (
                detect(pinhole_cameras, body, TRUTH, noise=noise, seed=seed)
                for noise in (0.02, 0.4)
            )
            T = tracker.advance(track, 0, None, [exact[0], noisy[1]])[1].T_world_object
            assert T is not None
            squared += float(rotation_angle_deg(T, TRUTH)) ** 2
        off.append(squared)
    assert off[0] < 0.6 * off[1]


def test_hidden_markers_and_clutter_do_not_move_the_pose(
    body: Body, pinhole_cameras: list[PinholeCamera]
) -> None:
    for seed in range(10):
        views = detect(pinhole_cameras, body, TRUTH, hidden=2, false=4, seed=seed)
        estimate = estimate_pose(views, body, random_start(seed))
        assert estimate.status == "ok"
        assert estimate.T_world_object is not None
        # clutter within a few σ of a marker pulls at it; seen at most 0.05° and 0.1 mm
        assert rotation_angle_deg(estimate.T_world_object, TRUTH) < 0.2
        assert np.linalg.norm((estimate.T_world_object - TRUTH)[:3, 3]) < 0.3


def test_three_ranges_give_a_pose(body: Body, range_sensors: list[RangeSensor]) -> None:
    views = detect(range_sensors, body, TRUTH, sigma=1.0)
    estimate = estimate_pose(views, body, random_start(3, 3.0, 2.0))
    assert estimate.T_world_object is not None
    assert rotation_angle_deg(estimate.T_world_object, TRUTH) < 0.01


def test_mixing_a_camera_and_ranges_in_one_rig(
    body: Body, pinhole_cameras: list[PinholeCamera], range_sensors: list[RangeSensor]
) -> None:
    views = detect([pinhole_cameras[0], range_sensors[1]], body, TRUTH)
    estimate = estimate_pose(views, body, random_start(4))
    assert estimate.T_world_object is not None
    twist = np.abs(twist_between(TRUTH, estimate.T_world_object))
    assert (twist < interpolation_bound(views, body, TRUTH, ALL_FREE)).all()
    # of 24 coordinates least squares leave no more than the look-up errs by; all of that in 8
    # ranges; σ_ε is 1.5, C wider by √2
    look_up = np.sqrt(3) / 72 / STEPS_PER_SIGMA**3 * np.sqrt(2) * 1.5
    assert estimate.sensors["1"].rms == pytest.approx(0.0, abs=np.sqrt(24 / 8) * look_up)


def test_directions_that_are_not_free_stay_at_the_start(
    body: Body, pinhole_cameras: list[PinholeCamera]
) -> None:
    options = EstimatorOptions(free=("x", "y", "rz"))
    start = perturb(TRUTH, np.array([3.0, -2.0, 0, 0, 0, 0.03]))
    views = detect(pinhole_cameras, body, TRUTH)
    estimate = estimate_pose(views, body, start, options)
    assert estimate.T_world_object is not None
    assert estimate.covariance is not None
    twist = twist_between(TRUTH, estimate.T_world_object)
    free = np.array([True, True, False, False, False, True])
    assert (np.abs(twist)[free] < interpolation_bound(views, body, TRUTH, free)[free]).all()
    moved = twist_between(start, estimate.T_world_object)
    np.testing.assert_allclose(moved[[2, 3, 4]], 0, atol=1e-9)
    assert not estimate.covariance[[2, 3, 4]].any()


def test_errors_have_the_size_that_the_covariance_says(
    body: Body, pinhole_cameras: list[PinholeCamera]
) -> None:
    squared = []
    for seed in range(60):
        views = detect(pinhole_cameras, body, TRUTH, noise=0.2, seed=seed)
        estimate = estimate_pose(views, body, TRUTH)
        assert estimate.T_world_object is not None
        assert estimate.covariance is not None
        error = twist_between(TRUTH, estimate.T_world_object)
        squared.append(error @ np.linalg.solve(estimate.covariance, error) / 6)
    # mean of 60 · 6 squares of unit normals: standard deviation 0.075; to have 99.9 % inside with a
    # noise of 26 redundant measurements, F makes covariances 1.44 times as large where errors are
    # 1.08 times, and that one of them may be cut a tenth: 0.68
    assert 0.5 < np.mean(squared) < 0.95


def test_a_frame_without_the_body_is_lost(body: Body, pinhole_cameras: list[PinholeCamera]) -> None:
    rng = np.random.default_rng(0)
    views = []
    for k, camera in enumerate(pinhole_cameras):
        pattern = PointPattern(rng.uniform([0, 0], [1280, 1024], (8, 2)), np.ones(8))
        views.append(View(str(k), camera, Observation(pattern, 1.5)))
    estimate = estimate_pose(views, body, TRUTH)
    assert estimate.status == "lost"
    assert estimate.T_world_object is None
    assert estimate.covariance is None


def test_no_features_in_any_sensor_is_lost(
    body: Body, pinhole_cameras: list[PinholeCamera]
) -> None:
    empty = Observation(PointPattern(np.zeros((0, 2)), np.zeros(0)), 1.5)
    views = [View("left", pinhole_cameras[0], empty)]
    estimate = estimate_pose(views, body, TRUTH)
    assert estimate.status == "lost"
    assert not estimate.sensors["left"].used


def test_without_a_start_the_pose_is_found_everywhere(
    body: Body, pinhole_cameras: list[PinholeCamera]
) -> None:
    T = from_rotation_vector([1.4, -2.0, 0.7], [80.0, 20.0, -30.0])
    estimate = estimate_pose(detect(pinhole_cameras, body, T, noise=0.2, false=3), body)
    assert estimate.status == "ok"
    assert estimate.T_world_object is not None
    assert rotation_angle_deg(estimate.T_world_object, T) < 0.3


def test_a_moving_body_is_followed_and_found_again_after_an_occlusion(
    body: Body, pinhole_cameras: list[PinholeCamera]
) -> None:
    tracker = Tracker.create(body, EstimatorOptions(), TRUTH)
    track = tracker.begin()
    statuses = []
    for frame in range(20):
        phase = 0.25 * frame
        twist = np.array([8 * np.sin(phase), 5 * phase, 4 * phase, 0.05 * phase, 0, 0.08 * phase])
        T = perturb(TRUTH, twist)
        views = detect(pinhole_cameras, body, T, noise=0.1, hidden=1, false=2, seed=frame)
        if 8 <= frame < 10:
            views = []
        track, estimate = tracker.advance(track, frame, None, views)
        statuses.append(estimate.status)
        if estimate.T_world_object is not None:
            assert rotation_angle_deg(estimate.T_world_object, T) < 0.3
    assert statuses[:8] == ["ok"] * 8
    assert statuses[8:10] == ["lost"] * 2
    assert statuses[10:] == ["ok"] * 10


def test_a_grid_that_moves_by_a_step_between_frames_is_not_followed_a_step_aside(
    pinhole_cameras: list[PinholeCamera],
) -> None:
    step = 20.0
    places = [(step * i, step * j, 0.0) for i in range(7) for j in range(5)]
    grid = Body("grid", tuple(PointFeature(np.array(place)) for place in places))
    T_next = TRUTH.copy()
    T_next[:3, 3] += step * TRUTH[:3, 0]
    tracker = Tracker.create(grid, EstimatorOptions(), TRUTH)
    track = tracker.begin()
    for frame, T in enumerate([TRUTH, T_next]):
        views = detect(pinhole_cameras, grid, T, noise=0.1, seed=frame)
        track, estimate = tracker.advance(track, frame, None, views)
        assert estimate.status == "ok"
        assert estimate.T_world_object is not None
        # a slip would be off by the whole step, with 28 of 35 features met
        nearest = grid.symmetries[..., :3, :3] @ np.zeros(3) + grid.symmetries[..., :3, 3]
        centres = transform(estimate.T_world_object, nearest)
        assert np.linalg.norm(centres - T[:3, 3], axis=1).min() < 0.5


def test_after_thirty_frames_of_occlusion_the_first_visible_frame_gives_the_pose(
    body: Body, pinhole_cameras: list[PinholeCamera]
) -> None:
    tracker = Tracker.create(body, EstimatorOptions(), TRUTH)
    track = tracker.begin()
    for frame in range(3):
        views = detect(pinhole_cameras, body, TRUTH, noise=0.1, seed=frame)
        track, estimate = tracker.advance(track, frame, frame / 25, views)
        assert estimate.status == "ok"
    for frame in range(3, 33):
        track, estimate = tracker.advance(track, frame, frame / 25, [])
        assert estimate.status == "lost"
        assert estimate.T_world_object is None
    elsewhere = perturb(TRUTH, np.array([90.0, -60.0, 40.0, 1.5, -0.8, 2.0]))
    views = detect(pinhole_cameras, body, elsewhere, noise=0.1, hidden=1, false=2)
    _, estimate = tracker.advance(track, 33, 33 / 25, views)
    assert estimate.status == "ok"
    assert estimate.T_world_object is not None
    assert rotation_angle_deg(estimate.T_world_object, elsewhere) < 0.3


PLATE = np.array(
    [[-50.0, -40, 0], [50, -40, 0], [40, 45, 0], [-30, 35, 0], [10, -10, 0], [-45, 5, 0]]
)


@pytest.mark.parametrize(("distance", "status"), [(400.0, "ok"), (3000.0, "ambiguous")])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_flat_body_is_ambiguous_where_it_is_too_far_away_for_perspective(
    distance: float, status: str, seed: int
) -> None:
    # 24 degrees of tilt change depths by some 20 mm: at 400 mm by 5 % and features by up to 6 px
    # between the pose and its mirror image, at 3 m by 0.1 px, half of the noise
    body = Body("plate", tuple(PointFeature(p) for p in PLATE), np.tile([0, 0, -1.0], (6, 1)))
    camera = PinholeCamera(
        np.array([[900.0, 0, 640], [0, 900.0, 512], [0, 0, 1]]), resolution=(1280, 1024)
    )
    truth = from_rotation_vector([0.35, 0.25, 0.3], [10.0, -20.0, distance])
    y, seen = camera.project(transform(truth, PLATE))
    assert seen.all()
    y += 0.2 * np.random.default_rng(seed).standard_normal(y.shape)
    view = View("camera", camera, Observation(PointPattern(y, np.ones(6)), 1.5))
    estimate = estimate_pose([view], body)
    assert estimate.status == status
    assert estimate.T_world_object is not None
    if status == "ok":
        assert rotation_angle_deg(estimate.T_world_object, truth) < 1.5
        return
    turns = [rotation_angle_deg(one.T_world_object, truth) for one in estimate.hypotheses]
    # noise of 0.2 px turns either by some degrees; the mirror image is tilted by twice 24 degrees
    assert min(turns) < 5
    assert 40 < max(turns) < 56


def test_a_body_on_one_line_is_never_sure_as_its_turn_about_it_is_open(
    pinhole_cameras: list[PinholeCamera],
) -> None:
    places = ((0.0, 0.0, 0.0), (50.0, 0.0, 0.0), (90.0, 0.0, 0.0))
    wand = Body("wand", tuple(PointFeature(np.array(place)) for place in places))
    views = detect(pinhole_cameras, wand, TRUTH)
    estimate = estimate_pose(views, wand, TRUTH)
    assert estimate.status == "ambiguous"
    assert estimate.T_world_object is not None
    # everything else of the pose is right: detections are exact
    moved = transform(estimate.T_world_object, wand.means) - transform(TRUTH, wand.means)
    assert (np.abs(moved) < interpolation_bound_of_features(views, wand, TRUTH)).all()


def test_a_spot_that_is_cut_tells_little_of_how_far_off_a_sensor_is_met(
    body: Body, pinhole_cameras: list[PinholeCamera]
) -> None:
    views = []
    for view in detect(pinhole_cameras, body, TRUTH, noise=0.05):
        assert view.observation.points is not None
        points = view.observation.points.copy()
        points[0, 0] += 2.0
        cut = PointPattern(points, np.ones(len(points)), 2.0 * (np.arange(len(points)) == 0))
        views.append(replace(view, observation=Observation(cut, view.observation.sigma)))
    found = estimate_pose(views, body, TRUTH)
    for name, one in found.offsets.items():
        # 2 px against a noise of some hundredths
        assert sorted(one.weights)[0] < 0.01
        assert sorted(one.weights)[1] == 1.0
        rms = found.sensors[name].rms
        assert rms is not None
        assert rms > 0.5
        assert found.weighted_rms[name] == pytest.approx(one.rms)
        assert one.rms < 0.2
