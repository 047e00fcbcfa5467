"""What a sensor sees: hidden, averted and false features, and lines."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from mixpose.body import Body, Gravity, PointFeature, SegmentFeature
from mixpose.rigid import from_rotation_vector, transform
from mixpose.sensors import CloudSensor, ParallelBeam, PinholeCamera, RangeSensor, Sensor
from mixpose.simulation.motion import Shutter
from mixpose.simulation.options import SimulationOptions
from mixpose.simulation.render import ImageFormat, render_image
from mixpose.simulation.scenery import Actor, Scenery
from mixpose.simulation.visible_spots import View, displacements, facing, look

Floats = NDArray[np.float64]
K = np.array([[800.0, 0, 320], [0, 800, 256], [0, 0, 1]])
CAMERA = PinholeCamera(K, resolution=(640, 512))
T = from_rotation_vector([0.3, -0.2, 0.5], [10.0, -5.0, 900.0])
POINTS = np.random.default_rng(4).uniform(-80, 80, (8, 3))
BODY = Body("body", tuple(PointFeature(p) for p in POINTS))


def view_of(sensor: Sensor, count: int = 8, *, spacing: float = 1.0, ridge: float = 0.0) -> View:
    low, high = sensor.lower, sensor.upper
    if sensor.dimension == 1:
        low, high = np.zeros(1), np.array([2000.0])
    if sensor.dimension == 3:
        low, high = np.full(3, -2000.0), np.full(3, 2000.0)
    return View(sensor, low, high, np.ones(count), spacing, ridge)


def counts(options: SimulationOptions, frames: int = 400) -> tuple[float, float, set[int]]:
    """Mean numbers of true and false features, and the numbers of false ones that occur."""
    true, false = [], []
    for frame in range(frames):
        seen = look(view_of(CAMERA), BODY, T, options, np.random.default_rng(frame))
        true.append(int((seen.features < len(BODY)).sum()))
        false.append(int((seen.features >= len(BODY)).sum()))
    return float(np.mean(true)), float(np.mean(false)), set(false)


def test_spots_are_where_the_features_project_to() -> None:
    seen = look(view_of(CAMERA), BODY, T, SimulationOptions(1), np.random.default_rng(0))
    expected, _ = CAMERA.project(transform(T, POINTS))
    assert np.array_equal(seen.features, np.arange(8))
    np.testing.assert_allclose(seen.points, expected, atol=1e-9)


def test_a_whole_number_of_false_features_is_there_in_every_frame() -> None:
    true, false, numbers = counts(SimulationOptions(1, clutter=3), 50)
    assert (true, false, numbers) == (8, 3, {3})


def test_a_broken_number_of_false_features_is_their_mean() -> None:
    _, false, numbers = counts(SimulationOptions(1, clutter=1.25))
    assert numbers == {1, 2}
    assert false == pytest.approx(1.25, abs=3 * np.sqrt(0.25 * 0.75 / 400))


def test_false_features_are_spread_over_the_image() -> None:
    options = SimulationOptions(1, clutter=4000)
    seen = look(view_of(CAMERA), BODY, T, options, np.random.default_rng(0))
    false = seen.points[seen.features >= 8]
    assert false.min(axis=0) == pytest.approx([-0.5, -0.5], abs=1.0)
    assert false.max(axis=0) == pytest.approx([639.5, 511.5], abs=1.0)
    assert false.mean(axis=0) == pytest.approx([319.5, 255.5], abs=3 * 185 / np.sqrt(4000))


def test_features_are_hidden_with_the_given_probability() -> None:
    true, _, _ = counts(SimulationOptions(1, hidden=0.25))
    assert true == pytest.approx(8 * 0.75, abs=3 * np.sqrt(8 * 0.25 * 0.75 / 400))


def test_a_number_of_features_can_be_hidden_in_every_view() -> None:
    assert counts(SimulationOptions(1, hidden_count=3), 50)[0] == 5
    assert counts(SimulationOptions(1, hidden_count=20), 3)[0] == 0


@pytest.mark.parametrize(
    ("sensor", "towards"),
    [
        (CAMERA, [0, 0, -1]),
        (ParallelBeam(1.0, np.zeros(2), (640, 512)), [0, 0, -1]),
        (RangeSensor(np.array([0.0, 5000.0, 900.0])), [0, 1, 0]),
    ],
    ids=["camera", "parallel", "range"],
)
def test_features_that_face_away_are_not_seen(sensor: Sensor, towards: list[float]) -> None:
    features = (PointFeature(np.zeros(3)), PointFeature(np.ones(3)), PointFeature(-np.ones(3)))
    R = T[:3, :3]
    normals_world = np.array([towards, np.negative(towards), towards], dtype=np.float64)
    body = Body("flat", features, normals_world @ R)
    assert facing(sensor, body, T).tolist() == [True, False, True]
    seen = look(view_of(sensor, 3), body, T, SimulationOptions(1), np.random.default_rng(0))
    assert seen.features.tolist() == [0, 2] or sensor.dimension == 2
    assert 1 not in seen.features


def test_a_line_is_drawn_as_bright_as_a_point() -> None:
    sigma, spacing = 1.6, 0.7 * 1.6
    ridge = spacing / (np.sqrt(2 * np.pi) * sigma)
    line = SegmentFeature(np.array([-60.0, 0, 0]), np.array([60.0, 10, 20]))
    body = Body("rod", (line, PointFeature(np.array([0, 50.0, 0]))))
    options = SimulationOptions(1, noise=0, shot_noise=0, background=0)
    view = view_of(CAMERA, 2, spacing=spacing, ridge=ridge)
    seen = look(view, body, T, options, np.random.default_rng(0))
    image = render_image(seen, ImageFormat((640, 512), sigma), options, np.random.default_rng(0))
    along = line.start + np.linspace(0.1, 0.9, 50)[:, None] * (line.end - line.start)
    y, _ = CAMERA.project(transform(T, along))
    nearest = np.rint(y).astype(int)
    brightest = [image[v - 1 : v + 2, u - 1 : u + 2].max() for u, v in nearest]
    # the line's depth differs by a sixth from end to end, and with it how dense its spots are
    assert np.array(brightest) == pytest.approx(options.brightness, rel=0.2)


def test_detections_of_a_line_weigh_as_much_as_a_point() -> None:
    line = SegmentFeature(np.array([-60.0, 0, 0]), np.array([60.0, 10, 20]))
    body = Body("rod", (line, PointFeature(np.array([0, 50.0, 0]))))
    seen = look(view_of(CAMERA, 2), body, T, SimulationOptions(1), np.random.default_rng(0))
    assert [seen.levels[seen.features == i].sum() for i in (0, 1)] == pytest.approx([1, 1])
    gaps = np.linalg.norm(np.diff(seen.points[seen.features == 0], axis=0), axis=1)
    assert 0.5 < gaps.min() <= gaps.max() <= 1.05


def test_deformed_features_scatter_by_the_spread_that_the_body_states() -> None:
    covariance = np.array([[9.0, 2.0, 0.0], [2.0, 4.0, 0.0], [0.0, 0.0, 0.0]])
    body = Body("soft", (PointFeature(np.zeros(3), covariance), PointFeature(np.ones(3))))
    drawn = [displacements(body, T, np.random.default_rng(i)) for i in range(4000)]
    offsets = np.array(drawn)
    np.testing.assert_allclose(np.cov(offsets[:, 0].T), covariance, atol=0.5)
    assert not offsets[:, 1].any()
    seen = look(
        view_of(CAMERA, 2), body, T, SimulationOptions(1), np.random.default_rng(0),
        offsets=offsets[0],
    )  # fmt: skip
    expected, _ = CAMERA.project(transform(T, body.means + offsets[0]))
    np.testing.assert_allclose(seen.points, expected, atol=1e-9)


def test_features_that_sag_are_displaced_along_gravity_however_the_body_is_turned() -> None:
    gravity = Gravity(np.array([0.0, 0.0, -3.0]), 2.0)
    body = Body("soft", (PointFeature(np.zeros(3)), PointFeature(np.ones(3))), gravity=gravity)
    turned = from_rotation_vector([0.4, -0.9, 0.3], [5.0, 6.0, 7.0])
    drawn = [displacements(body, turned, np.random.default_rng(i)) for i in range(4000)]
    in_world = np.array(drawn) @ turned[:3, :3].T
    np.testing.assert_allclose(in_world[..., :2], 0.0, atol=1e-12)
    # of 4000 draws a standard deviation is known to 1.1 %
    np.testing.assert_allclose(in_world[..., 2].std(axis=0), 2.0, rtol=0.05)
    # each feature by itself: by chance the correlation is 0.016
    assert abs((in_world[:, 0, 2] * in_world[:, 1, 2]).mean() / 2.0**2) < 0.06


SPHERES = Body("spheres", BODY.features, shape="sphere", radii=np.full(8, 3.0))


@pytest.mark.parametrize(
    "sensor",
    [RangeSensor(np.array([0.0, -800, 900])), CloudSensor(np.eye(4))],
    ids=["range", "cloud"],
)
def test_spheres_are_points_to_what_takes_no_images(sensor: Sensor) -> None:
    of_spheres, of_points = (
        look(view_of(sensor), body, T, SimulationOptions(1), np.random.default_rng(0))
        for body in (SPHERES, BODY)
    )
    np.testing.assert_allclose(of_spheres.points, of_points.points, atol=1e-9)


def test_spheres_are_seen_where_they_are_displaced_to() -> None:
    offsets = np.random.default_rng(1).normal(0, 5, (8, 3))
    seen = look(
        view_of(CAMERA), SPHERES, T, SimulationOptions(1), np.random.default_rng(0), offsets=offsets
    )
    expected, _ = CAMERA.project(transform(T, POINTS + offsets))
    # centres of outlines are off those of spheres of 3 at 900 by 0.01 px
    np.testing.assert_allclose(seen.points, expected, atol=0.05)


def test_a_mirror_image_is_read_at_the_moment_of_the_row_in_which_it_is_seen() -> None:
    speed, readout, rows = np.array([300.0, 900.0, 0.0]), 0.03, 512

    def pose(seconds: float) -> Floats:
        return from_rotation_vector([0.3, -0.2, 0.5], np.array([10.0, -5, 900]) + seconds * speed)

    upside_down = np.diag([1.0, -1.0, 1.0, 1.0])
    image = Actor(BODY, pose, np.ones(8), upside_down, is_body_image=True)
    shutter = Shutter(readout_s=readout, rows=rows)
    view = replace(view_of(CAMERA), shutter=shutter, scenery=Scenery((image,)))
    options, rng = SimulationOptions(1), np.random.default_rng(0)
    seen = look(view, BODY, T, options, rng, pose_after=pose)
    images = seen.points[seen.features >= len(BODY)]
    assert len(images) == len(BODY)
    moments = readout * (images[:, 1] / (rows - 1) - 0.5)
    expected = [
        CAMERA.project(transform(upside_down @ pose(seconds), point[None]))[0][0]
        for seconds, point in zip(moments.tolist(), POINTS, strict=True)
    ]
    # the moment of the body's own row is up to 20 ms aside, 16 px
    np.testing.assert_allclose(images, expected, atol=0.05)
