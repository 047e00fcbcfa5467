"""Objectives: gradients, the paper's validation example, the bias and its cure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from detections import drawn_everywhere
from numpy.typing import NDArray

from mixpose.body import Body, Gravity, PointFeature, SegmentFeature
from mixpose.density import Density, Observation, Window, render
from mixpose.objective import (
    OBJECTIVES,
    IndependentObjective,
    MatchedObjective,
    ObjectiveName,
    PaperObjective,
    View,
    build_objective,
    matched_objective,
    pose_jacobian,
)
from mixpose.objective.matched import FINE_STEPS
from mixpose.objective.paper import SampledTerm
from mixpose.records import PointPattern
from mixpose.rigid import from_rotation_vector, perturb, transform
from mixpose.sensors import ParallelBeam, PinholeCamera, Sensor

Floats = NDArray[np.float64]
TRUTH = from_rotation_vector([0.05, -0.03, -1.05], [30.0, 20.0, 40.0])


def views_of(
    sensors: Sequence[Sensor], body: Body, T: Floats, sigma: float, weights: Floats | None = None
) -> list[View]:
    """What the sensors would detect of a body, without error."""
    found = []
    for k, sensor in enumerate(sensors):
        y, visible = sensor.project(transform(T, body.nodes.points))
        assert visible.all()
        pattern = PointPattern(y, np.ones(len(y)) if weights is None else weights)
        found.append(View(str(k), sensor, Observation(pattern, sigma)))
    return found


def random_twists(count: int, length: float, angle: float, seed: int = 0) -> Floats:
    rng = np.random.default_rng(seed)
    return np.asarray(rng.uniform(-1, 1, (count, 6)) * np.repeat([length, angle], 3))


def test_pose_jacobian_agrees_with_central_differences(
    paper_body: Body, pinhole_cameras: list[PinholeCamera]
) -> None:
    camera, points = pinhole_cameras[0], paper_body.means
    _, by_world, _ = camera.linearise(transform(TRUTH, points))
    J = pose_jacobian(by_world, points @ TRUTH[:3, :3].T)
    for k, step in enumerate([1e-3] * 3 + [1e-6] * 3):
        twist = np.zeros(6)
        twist[k] = step
        forward, _ = camera.project(transform(perturb(TRUTH, twist), points))
        backward, _ = camera.project(transform(perturb(TRUTH, -twist), points))
        np.testing.assert_allclose(J[..., k], (forward - backward) / (2 * step), atol=1e-4)


def on_fine_grids(
    name: ObjectiveName, views: list[View], body: Body, sigma: float
) -> MatchedObjective | PaperObjective:
    """An objective whose densities are so fine that interpolation errs by less than 0.1 %."""
    if name == "matched":
        sigmas = [sigma] * len(views)
        return matched_objective(views, body, sigmas, steps_per_sigma=24.0)
    terms = []
    for view in views:
        lower, upper = view.observation.extent
        window = Window.around(lower - 4 * sigma, upper + 4 * sigma, sigma / 16)
        density = render(view.observation.pattern, sigma, window, gradient=True)
        terms.append(SampledTerm(view.sensor, density))
    kind = PaperObjective if name == "paper" else IndependentObjective
    return kind(terms, body.sample(200))


@pytest.mark.parametrize("name", OBJECTIVES)
@pytest.mark.parametrize("rig", ["parallel_cameras", "pinhole_cameras", "range_sensors"])
def test_gradients_agree_with_central_differences(
    name: ObjectiveName, rig: str, soft_paper_body: Body, request: pytest.FixtureRequest
) -> None:
    views = views_of(request.getfixturevalue(rig), soft_paper_body, TRUTH, 12.0)
    objective = on_fine_grids(name, views, soft_paper_body, 12.0)
    T = perturb(TRUTH, np.array([2.0, -3.0, 2.0, 0.02, 0.03, -0.02]))
    gradient = objective.linearise(T[None]).gradient[0]
    numerical = np.zeros(6)
    for k, step in enumerate([1.2] * 3 + [0.012] * 3):
        twist = np.zeros(6)
        twist[k] = step
        up, down = objective.value(np.stack([perturb(T, twist), perturb(T, -twist)]))
        numerical[k] = (up - down) / (2 * step)
    # third derivatives over a step of σ/10 leave (1/10)²/6 = 0.2 %, the kinks of bilinear values
    # on 16 grid points per σ (1/16)²/8 of the value, which is 1 % of a slope over such a step
    scale = np.repeat([np.abs(gradient[:3]).max(), np.abs(gradient[3:]).max()], 3)
    assert np.abs((gradient - numerical) / scale).max() < 0.025


@pytest.mark.parametrize("name", OBJECTIVES)
def test_a_batch_of_poses_gives_the_values_of_their_linearisations(
    name: ObjectiveName, soft_paper_body: Body, pinhole_cameras: list[PinholeCamera]
) -> None:
    views = views_of(pinhole_cameras, soft_paper_body, TRUTH, 5.0)
    samples = soft_paper_body.sample(10)
    objective = build_objective(name, views, soft_paper_body, samples, [5.0, 5.0], TRUTH)
    poses = perturb(TRUTH, random_twists(70, 4.0, 0.03))
    values = objective.value(poses)
    assert values.shape == (70,)
    singles = [objective.linearise(T[None]).value[0] for T in poses]
    np.testing.assert_allclose(values, singles, rtol=1e-5)
    np.testing.assert_allclose(objective.linearise(poses).value, values, rtol=1e-5)


def formula_4(
    cameras: Sequence[PinholeCamera],
    seen: Sequence[Floats],
    samples: Floats,
    T: Floats,
    sigma: float,
) -> tuple[float, float]:
    """Formula (4) sum by sum, and the product of the separate sums, on exact densities.

    g_l is a mean of Gaussians about the detections; p is the pinhole projection without a lens.
    """
    inside, outside = 0.0, np.zeros(len(cameras))
    for z in samples.reshape(-1, 3):
        product = 1.0
        for k, (camera, detections) in enumerate(zip(cameras, seen, strict=True)):
            x, y, depth = camera.T_sensor_world[:3] @ T @ np.append(z, 1.0)
            K = camera.camera_matrix
            p = np.array([K[0, 0] * x / depth + K[0, 2], K[1, 1] * y / depth + K[1, 2]])
            squared = ((detections - p) ** 2).sum(axis=1)
            g = float(np.mean(np.exp(-squared / (2 * sigma**2)) / (2 * np.pi * sigma**2)))
            product *= g
            outside[k] += g
        inside += product
    count = samples.size // 3
    return inside / count, float(np.prod(outside / count))


def test_the_papers_objectives_are_formula_4_and_its_separate_sums_written_down(
    soft_paper_body: Body, pinhole_cameras: list[PinholeCamera]
) -> None:
    cameras = [replace(camera, distortion=np.zeros(0)) for camera in pinhole_cameras]
    samples = soft_paper_body.sample(20)
    sigma = 12.0
    # the first camera sees features 0 to 2, the second 2 to 5: both see but one
    shown = ([0, 1, 2], [2, 3, 4, 5])
    means = transform(TRUTH, soft_paper_body.means)
    seen = [camera.project(means[k])[0] for camera, k in zip(cameras, shown)]
    views = [
        View(str(k), camera, Observation(PointPattern(y, np.ones(len(y))), sigma))
        for k, (camera, y) in enumerate(zip(cameras, seen))
    ]
    terms = on_fine_grids("paper", views, soft_paper_body, sigma).terms  # type: ignore[union-attr]
    poses = perturb(TRUTH, np.concatenate([np.zeros((1, 6)), random_twists(4, 8.0, 0.05)]))
    expected = np.array([formula_4(cameras, seen, samples, T, sigma) for T in poses])
    # bilinear values on 16 grid points per σ are up to 1/16²/8 of the curvature low: 0.1 %
    inside = PaperObjective(terms, samples).value(poses)
    np.testing.assert_allclose(inside, expected[:, 0], rtol=4e-3)
    outside = IndependentObjective(terms, samples).value(poses)
    np.testing.assert_allclose(outside, expected[:, 1], rtol=4e-3)
    # one of six features inside, 3/6 and 4/6 of them outside: one is half of the other there
    assert expected[0, 0] == pytest.approx(0.5 * expected[0, 1], rel=0.1)


@pytest.mark.parametrize("name", OBJECTIVES)
def test_a_body_out_of_view_of_all_sensors_has_no_slope(
    name: ObjectiveName, paper_body: Body, pinhole_cameras: list[PinholeCamera]
) -> None:
    away = perturb(TRUTH, np.array([1e5, 1e5, 0, 0, 0, 0]))
    views, samples = views_of(pinhole_cameras, paper_body, TRUTH, 2.0), paper_body.sample(10)
    objective = build_objective(name, views, paper_body, samples, [2.0, 2.0], away)
    assert objective.value(away) == 0.0
    assert not objective.value(np.array([away, away])).any()
    found = objective.linearise(away[None])
    for part in (found.value, found.gradient, found.curvature):
        assert not part.any()


def test_what_gravity_displaces_belongs_to_the_samples_of_the_same_seed(
    paper_body: Body, pinhole_cameras: list[PinholeCamera]
) -> None:
    body = replace(paper_body, gravity=Gravity(np.array([0.0, 0.0, -1.0]), 3.0))
    views = views_of(pinhole_cameras, body, TRUTH, 2.0)
    samples, level = body.sample(50, seed=3), [2.0, 2.0]
    objective = build_objective("paper", views, body, samples, level, TRUTH, 3)
    assert isinstance(objective, PaperObjective)
    by_hand = PaperObjective(objective.terms, samples, body.world_offsets(50, seed=3))
    assert objective.value(TRUTH) == by_hand.value(TRUTH)


@pytest.mark.parametrize("name", ["matched", "paper"])
@pytest.mark.parametrize("rig", ["parallel_cameras", "pinhole_cameras"])
def test_the_papers_validation_example_has_its_maximum_at_the_truth(
    name: ObjectiveName, rig: str, paper_body: Body, request: pytest.FixtureRequest
) -> None:
    # exact features, no bias of the observation, features far apart against σ
    sensors = request.getfixturevalue(rig)
    views = views_of(sensors, paper_body, TRUTH, 2.0)
    objective = build_objective(name, views, paper_body, paper_body.sample(10), [2.0, 2.0], TRUTH)
    at_truth = objective.value(TRUTH[None])[0]
    around = perturb(TRUTH, random_twists(400, 3.0, 0.03))
    assert (objective.value(around) < at_truth).all()


def test_at_the_truth_the_curvature_agrees_with_differences_of_the_gradient(
    paper_body: Body, parallel_cameras: list[ParallelBeam]
) -> None:
    # parallel beams: the projection is linear in the position, and turns bend it little here;
    # where everything fits, what Gauss-Newton and mean-shift leave out is zero
    views = views_of(parallel_cameras, paper_body, TRUTH, 12.0)
    objective = on_fine_grids("matched", views, paper_body, 12.0)
    curvature = objective.linearise(TRUTH[None]).curvature[0]
    for k, step in enumerate([0.5] * 3 + [0.005] * 3):
        twist = np.zeros(6)
        twist[k] = step
        up = objective.linearise(perturb(TRUTH, twist)[None]).gradient[0]
        down = objective.linearise(perturb(TRUTH, -twist)[None]).gradient[0]
        numerical = -(up - down) / (2 * step)
        # third derivatives over a step of σ/24 leave 0.1 %, single precision a few times that
        np.testing.assert_allclose(curvature[k], numerical, atol=0.01 * np.abs(curvature[k]).max())


def test_the_matched_share_is_one_at_the_truth_and_what_clutter_leaves_of_it(
    paper_body: Body, pinhole_cameras: list[PinholeCamera]
) -> None:
    camera = pinhole_cameras[0]
    clean = views_of([camera], paper_body, TRUTH, 2.0)
    pattern = clean[0].observation.pattern
    assert isinstance(pattern, PointPattern)
    false = np.array([[100.0, 100.0], [300.0, 900.0], [1200.0, 50.0]])
    cluttered = PointPattern(np.concatenate([pattern.points, false]), np.ones(9))
    for found, expected in ((pattern, 1.0), (cluttered, 6 / 9)):
        views = [View("0", camera, Observation(found, 2.0))]
        objective = matched_objective(views, paper_body, [2.0], steps_per_sigma=FINE_STEPS)
        share = objective.value(TRUTH[None])[0] / objective.weights[0, 0]
        # bilinear values on 8 grid points per σ err by 1/8²/12 along each axis, twice that squared
        assert share == pytest.approx(expected, rel=2e-3)


def test_clutter_in_one_sensor_does_not_take_the_weight_from_its_features(
    paper_body: Body, pinhole_cameras: list[PinholeCamera]
) -> None:
    clean = views_of(pinhole_cameras, paper_body, TRUTH, 2.0)
    pattern = clean[1].observation.pattern
    assert isinstance(pattern, PointPattern)
    false = np.column_stack([np.arange(100) * 12.0, np.full(100, 1000.0)])
    cluttered = PointPattern(np.concatenate([pattern.points, false]), np.ones(106))
    views = [clean[0], View("1", pinhole_cameras[1], Observation(cluttered, 2.0))]
    objective = matched_objective(views, paper_body, [2.0, 2.0], steps_per_sigma=FINE_STEPS)
    # as many equal features as there are, per feature of the body: 6/6 and 106/6, of which the
    # body explains all and 6/106
    assert objective.weights[:, 0] == pytest.approx([1.0, 106 / 6], rel=1e-3)
    assert objective.shares(TRUTH[None])[:, 0] == pytest.approx([1.0, 1.0], rel=4e-3)


def test_a_pose_does_not_gain_by_features_that_leave_the_picture(
    paper_body: Body, pinhole_cameras: list[PinholeCamera]
) -> None:
    camera = pinhole_cameras[0]
    y, _ = camera.project(transform(TRUTH, paper_body.means))
    narrow = replace(camera, resolution=(int(np.sort(y[:, 0])[3]), 1024))
    seen = narrow.project(transform(TRUTH, paper_body.means))[1]
    count = int(seen.sum())
    assert 0 < count < 6
    observation = Observation(PointPattern(y[seen], np.ones(count)), 2.0)
    objective = matched_objective(
        [View("0", narrow, observation)], paper_body, [2.0], steps_per_sigma=FINE_STEPS
    )
    visible, whole = (objective.shares(TRUTH[None], whole=each)[0, 0] for each in (False, True))
    # all that is in view is met: as many of six, where the others count as missed
    assert visible == pytest.approx(count / 6, rel=4e-3)
    assert whole == pytest.approx(count / 6 * count / 6, rel=4e-3)


def test_far_away_on_one_bright_marker_the_paper_collapses_and_the_matched_does_not(
    pinhole_cameras: list[PinholeCamera],
) -> None:
    rng = np.random.default_rng(5)
    body = Body("cube", tuple(PointFeature(p) for p in rng.uniform(-60, 60, (6, 3))))
    camera = PinholeCamera(pinhole_cameras[0].camera_matrix, resolution=(1280, 1024))
    truth = from_rotation_vector([0.3, 0.2, 0.1], [10.0, -20.0, 700.0])
    weights = np.array([1.0, 1.0, 2.0, 1.0, 1.0, 1.0])
    views = views_of([camera], body, truth, 5.0, weights)
    pattern = views[0].observation.pattern
    assert isinstance(pattern, PointPattern)
    ray = np.linalg.solve(camera.camera_matrix, np.array([*pattern.points[2], 1.0]))
    far = from_rotation_vector([0.3, 0.2, 0.1], ray * 50_000.0)
    both = np.stack([truth, far])
    paper = PaperObjective(drawn_everywhere(views, 5.0), body.sample(10)).value(both)
    matched = matched_objective(views, body, [5.0]).value(both)
    assert paper[1] > 1.5 * paper[0]
    assert matched[0] > 1.5 * matched[1]


def test_features_that_face_away_are_not_expected(paper_body: Body) -> None:
    camera = PinholeCamera(np.array([[800.0, 0, 320], [0, 800.0, 240], [0, 0, 1]]))
    points = np.array([[0.0, 0, -20], [40.0, 0, -20], [0, 30.0, -20], [0, 0, 20.0], [40, 30, 20.0]])
    normals = np.where(points[:, 2:] < 0, [0, 0, -1.0], [0, 0, 1.0])
    truth = from_rotation_vector([0.1, 0.2, 0.3], [0, 0, 600.0])
    front = Body("front", tuple(PointFeature(p) for p in points[:3]))
    views = views_of([camera], front, truth, 3.0)
    features = tuple(PointFeature(p) for p in points)
    faced = matched_objective(views, Body("b", features, normals), [3.0]).value(truth[None])
    blind = matched_objective(views, Body("b", features), [3.0]).value(truth[None])
    # three of five features are met: (3/5) of the share is left when all are expected
    assert blind[0] / faced[0] == pytest.approx(3 / 5, abs=0.01)


def test_a_segment_is_matched_along_its_whole_length() -> None:
    camera = PinholeCamera(np.array([[800.0, 0, 320], [0, 800.0, 240], [0, 0, 1]]))
    ends = np.array([[-50.0, 0, 0], [50.0, 10, 0], [0, -40, 5.0], [0, 60, 0.0]])
    body = Body("cross", (SegmentFeature(ends[0], ends[1]), SegmentFeature(ends[2], ends[3])))
    truth = from_rotation_vector([0.2, -0.1, 0.3], [5.0, 0, 700.0])
    views = views_of([camera], body, truth, 4.0, body.nodes.weights)
    objective = matched_objective(views, body, [4.0])
    at_truth = objective.value(truth[None])[0]
    assert (objective.value(perturb(truth, random_twists(200, 5.0, 0.1))) < at_truth).all()


def paper_objective(views: list[View], body: Body, samples: Floats, sigma: float) -> PaperObjective:
    offsets = body.world_offsets(samples.shape[1])
    return PaperObjective(drawn_everywhere(views, sigma), samples, offsets)


def test_wider_features_keep_the_maximum_of_a_deformed_object_where_exact_ones_split_it(
    paper_body: Body, parallel_cameras: list[ParallelBeam]
) -> None:
    # the paper's scenario III: the object is stretched about its centre, the model is not told
    centre = paper_body.means.mean(axis=0)
    stretched = (paper_body.means - centre) * [0.8, 1.0, 1.2] + centre
    deformed = Body("deformed", tuple(PointFeature(p) for p in stretched))
    views = views_of(parallel_cameras, deformed, TRUTH, 5.0)
    turns_deg = np.linspace(-30, 30, 121)
    poses = perturb(TRUTH, np.outer(np.radians(turns_deg), [0, 0, 0, 0, 0, 1.0]))
    # turn about the centre of the features, where the stretching leaves them
    poses[:, :3, 3] += transform(TRUTH, centre[None]) - transform(poses, centre[None])[:, 0]

    def maxima_deg(sigma: float) -> Floats:
        soft = tuple(PointFeature(p, sigma**2 * np.eye(3)) for p in paper_body.means)
        body = Body("soft", soft)
        value = paper_objective(views, body, body.sample(1000), 5.0).value(poses)
        inner = value[1:-1]
        peaks = (inner > value[:-2]) & (inner > value[2:]) & (inner > 0.5 * value.max())
        return np.asarray(turns_deg[1:-1][peaks])

    # seen: -5.5° and 5.5° with exact features, 1.0° with a spread of 10
    assert len(maxima_deg(0.0)) == 2
    assert np.abs(maxima_deg(0.0)).min() > 4
    assert len(maxima_deg(10.0)) == 1
    assert np.abs(maxima_deg(10.0)).max() < 2


def test_sag_along_gravity_is_expected_along_gravity_in_every_pose(
    paper_body: Body, parallel_cameras: list[ParallelBeam]
) -> None:
    # all features hang 6 below where they belong; only a spread along the world's vertical,
    # not one that turns with the body, expects that in both poses
    down, sag = np.array([0.0, 0.0, -1.0]), 6.0
    lying = perturb(TRUTH, np.array([0, 0, 0, np.pi / 2, 0, 0]))
    for T in (TRUTH, lying):
        hanging = T.copy()
        hanging[:3, 3] += sag * down
        views = views_of(parallel_cameras, paper_body, hanging, 2.0)

        def value(body: Body, views: list[View] = views, T: Floats = T) -> float:
            samples = body.sample(500)
            return float(paper_objective(views, body, samples, 2.0).value(T[None])[0])

        exact = value(paper_body)
        hung = value(Body("sag", paper_body.features, gravity=Gravity(down, 6.0)))
        assert hung > 5 * exact
    along_x = np.diag([36.0, 0.0, 0.0])
    sideways = Body("x", tuple(PointFeature(p, along_x) for p in paper_body.means))
    assert value(sideways) < hung


def test_a_density_that_is_not_gaussian_is_integrated_as_well(
    paper_body: Body, parallel_cameras: list[ParallelBeam]
) -> None:
    # one camera with a ramp as density: the mean over any zero-mean q is the value at the mean
    ramp = np.tile(np.arange(401, dtype=np.float32), (401, 1))
    density = Density(ramp, Window(np.zeros(2), ramp.shape, 1.0), 1.0)
    boxes = tuple(PointFeature(p, 16.0 * np.eye(3), "uniform") for p in paper_body.means)
    body = Body("boxes", boxes)
    objective = PaperObjective([SampledTerm(parallel_cameras[0], density)], body.sample(200))
    y, _ = parallel_cameras[0].project(transform(TRUTH, paper_body.means))
    assert objective.value(TRUTH[None])[0] == pytest.approx(y[:, 0].mean(), rel=1e-5)
