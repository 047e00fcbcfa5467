"""Laws that every sensor obeys, and agreement with OpenCV's projections."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from mixpose.rigid import from_rotation_vector, transform
from mixpose.sensors import (
    OUTSIDE,
    SENSOR_MODELS,
    CloudSensor,
    FisheyeCamera,
    ParallelBeam,
    PinholeCamera,
    RangeSensor,
    Sensor,
)

K = np.array([[820.0, 0.4, 633.0], [0, 815.0, 507.0], [0, 0, 1]])
T_SENSOR_WORLD = from_rotation_vector([0.2, -0.3, 0.1], [30.0, -20.0, 900.0])
DISTORTIONS = {
    0: [],
    4: [-0.21, 0.1, 1e-3, -4e-4],
    5: [-0.21, 0.1, 1e-3, -4e-4, 0.02],
    8: [0.3, 0.1, 1e-3, -4e-4, 0.02, 0.5, 0.05, 0.01],
    12: [0.3, 0.1, 1e-3, -4e-4, 0.02, 0.5, 0.05, 0.01, 1e-3, 2e-4, -1e-3, 3e-4],
    14: [0.3, 0.1, 1e-3, -4e-4, 0.02, 0.5, 0.05, 0.01, 1e-3, 2e-4, -1e-3, 3e-4, 0.02, -0.03],
}


def points_in_view(count: int = 200) -> NDArray[np.float64]:
    return np.random.default_rng(3).uniform(-150, 150, (count, 3))


def every_sensor() -> dict[str, Sensor]:
    sensors: dict[str, Sensor] = {
        f"pinhole{n}": PinholeCamera(K, np.array(d), (1280, 1024), T_SENSOR_WORLD)
        for n, d in DISTORTIONS.items()
    }
    sensors["fisheye"] = FisheyeCamera(
        K / 1.5, np.array([0.05, -0.01, 2e-3, -3e-4]), (1280, 1024), T_SENSOR_WORLD
    )
    sensors["parallel"] = ParallelBeam(0.5, np.array([640.0, 512.0]), None, T_SENSOR_WORLD)
    sensors["cloud"] = CloudSensor(T_SENSOR_WORLD)
    sensors["lateration"] = RangeSensor(np.array([0.0, -1000.0, 20.0]), 3.5)
    return sensors


SENSORS = every_sensor()


def test_every_registered_model_is_under_test() -> None:
    assert {type(s) for s in SENSORS.values()} == set(SENSOR_MODELS.values())


@pytest.mark.parametrize("name", SENSORS)
def test_analytic_jacobian_agrees_with_central_differences(name: str) -> None:
    sensor, points, step = SENSORS[name], points_in_view(), 1e-3
    _, J, visible = sensor.linearise(points)
    assert visible.mean() > 0.9
    for axis in range(3):
        shift = np.zeros(3)
        shift[axis] = step
        forward, _ = sensor.project(points + shift)
        backward, _ = sensor.project(points - shift)
        numerical = (forward - backward) / (2 * step)
        # truncation is O(step² y‴) and rounding O(1e-13 y / step): both far below 1e-6
        np.testing.assert_allclose(J[visible, :, axis], numerical[visible], atol=1e-6)


@pytest.mark.parametrize("name", SENSORS)
def test_linearise_repeats_project_and_batches_over_leading_axes(name: str) -> None:
    sensor, points = SENSORS[name], points_in_view().reshape(4, 50, 3)
    y, visible = sensor.project(points)
    y2, J, visible2 = sensor.linearise(points)
    assert y.shape == (4, 50, sensor.dimension)
    assert J.shape == (4, 50, sensor.dimension, 3)
    np.testing.assert_allclose(y, y2, atol=1e-10)
    np.testing.assert_array_equal(visible, visible2)
    single, _ = sensor.project(points[2, 7])
    np.testing.assert_allclose(single, y[2, 7], atol=1e-10)


@pytest.mark.parametrize("count", DISTORTIONS)
def test_pinhole_agrees_with_opencv_for_every_number_of_coefficients(count: int) -> None:
    sensor, points = SENSORS[f"pinhole{count}"], points_in_view()
    y, visible = sensor.project(points)
    rvec, _ = cv2.Rodrigues(T_SENSOR_WORLD[:3, :3])
    # cv2.projectPoints has no skew; apply K to its normalised output instead
    coefficients = np.array(DISTORTIONS[count]) if count else np.zeros(4)
    normalised, _ = cv2.projectPoints(points, rvec, T_SENSOR_WORLD[:3, 3], np.eye(3), coefficients)
    expected = normalised[:, 0] @ K[:2, :2].T + K[:2, 2]
    np.testing.assert_allclose(y[visible], expected[visible], atol=1e-8)


def test_fisheye_agrees_with_opencv() -> None:
    sensor, points = SENSORS["fisheye"], points_in_view()
    assert isinstance(sensor, FisheyeCamera)
    y, visible = sensor.project(points)
    rvec, _ = cv2.Rodrigues(T_SENSOR_WORLD[:3, :3])
    normalised, _ = cv2.fisheye.projectPoints(
        points[:, None], rvec, T_SENSOR_WORLD[:3, 3], np.eye(3), sensor.distortion
    )
    expected = normalised[:, 0] @ sensor.camera_matrix[:2, :2].T + sensor.camera_matrix[:2, 2]
    np.testing.assert_allclose(y[visible], expected[visible], atol=1e-8)


def test_fisheye_is_smooth_on_its_axis() -> None:
    sensor = FisheyeCamera(K)
    y, J, visible = sensor.linearise(np.array([[0.0, 0.0, 500.0]]))
    assert visible.all()
    np.testing.assert_allclose(y[0], K[:2, 2])
    np.testing.assert_allclose(J[0, :, :2], K[:2, :2] / 500)


@pytest.mark.parametrize("model", [PinholeCamera, FisheyeCamera])
def test_points_behind_a_camera_are_hidden_finite_and_without_pull(
    model: type[PinholeCamera] | type[FisheyeCamera],
) -> None:
    sensor = model(K, resolution=(1280, 1024))
    y, J, visible = sensor.linearise(np.array([[10.0, 5.0, -800.0], [1.0, 2.0, 0.0]]))
    assert not visible.any()
    assert (y == OUTSIDE).all()
    assert (J == 0).all()


def test_points_outside_the_image_are_hidden() -> None:
    sensor = PinholeCamera(K, resolution=(1280, 1024))
    _, visible = sensor.project(np.array([[0.0, 0.0, 1000.0], [900.0, 0.0, 1000.0]]))
    assert visible.tolist() == [True, False]


def test_a_point_beyond_the_turning_radius_of_the_lens_model_is_hidden() -> None:
    # r(1 - 0.3 r²) turns at r = 1.054: a point at r = 1.5 would fold back to r = 0.49
    sensor = PinholeCamera(K, np.array([-0.3, 0, 0, 0]))
    _, visible = sensor.project(np.array([[1.0, 0, 1.0], [1.5, 0, 1.0]]))
    assert visible.tolist() == [True, False]


def test_range_includes_the_bias() -> None:
    y, visible = RangeSensor(np.zeros(3), 0.25, (0.0, 10.0)).project(
        np.array([[3.0, 4.0, 0.0], [30.0, 40.0, 0.0]])
    )
    assert y[0, 0] == 5.25
    assert visible.tolist() == [True, False]


def test_parallel_beam_of_the_paper() -> None:
    gamma = np.pi / 2
    T = np.eye(4)
    T[:3, :3] = [
        [np.cos(gamma), np.sin(gamma), 0],
        [0, 0, 1],
        [np.sin(gamma), -np.cos(gamma), 0],
    ]
    y, _ = ParallelBeam(1.0, np.zeros(2), None, T).project(np.array([[1.0, 2.0, 3.0]]))
    np.testing.assert_allclose(y[0], [2.0, 3.0], atol=1e-12)


@pytest.mark.parametrize("name", [name for name in SENSORS if name != "cloud"])
def test_the_direction_to_the_sensor_is_the_one_along_which_nothing_moves(name: str) -> None:
    sensor, points = SENSORS[name], points_in_view(20)
    towards = sensor.towards(points)
    _, J, visible = sensor.linearise(points)
    along = np.einsum("nmk,nk->nm", J, towards / np.linalg.norm(towards, axis=1, keepdims=True))
    # a camera sees no motion along its ray; a range falls by the whole of it
    expected = -1.0 if name == "lateration" else 0.0
    np.testing.assert_allclose(along[visible], expected, atol=1e-9)
    if name != "lateration":
        depth = towards @ sensor.T_sensor_world[2, :3]  # type: ignore[attr-defined]
        assert (depth < 0).all()


@pytest.mark.parametrize("name", ["pinhole0", "fisheye", "parallel"])
def test_an_image_reaches_half_a_pixel_beyond_the_centres_of_its_outermost_pixels(
    name: str,
) -> None:
    kinds: dict[str, Sensor] = {
        "pinhole0": PinholeCamera(np.eye(3), resolution=(20, 10)),
        "fisheye": FisheyeCamera(np.eye(3) * 20, resolution=(20, 10)),
        "parallel": ParallelBeam(1.0, np.zeros(2), (20, 10)),
    }
    sensor = kinds[name]
    scale = 20.0 if name == "fisheye" else 1.0
    for u, v, seen in [
        (-0.49, -0.49, True),
        (19.49, 9.49, True),
        (-0.51, 5.0, False),
        (5.0, -0.51, False),
        (19.51, 5.0, False),
        (5.0, 9.51, False),
    ]:
        radius = np.hypot(u, v) / scale
        # a fisheye without coefficients shows the angle as the radius
        depth = radius / np.tan(radius) if name == "fisheye" else 1.0
        point = np.array([[u / scale, v / scale, depth]])
        assert sensor.project(point)[1].tolist() == [seen], (u, v)


def test_a_parallel_beam_has_its_pixel_size_and_the_origin_at_the_principal_point() -> None:
    sensor = ParallelBeam(0.5, np.array([640.0, 512.0]))
    y, J, _ = sensor.linearise(np.array([[0.0, 0.0, 70.0], [3.0, -1.0, 900.0]]))
    # half a unit of length to a pixel: 3 units are 6 px
    np.testing.assert_array_equal(y, [[640.0, 512.0], [646.0, 510.0]])
    np.testing.assert_array_equal(J[0], [[2.0, 0.0, 0.0], [0.0, 2.0, 0.0]])


STRONG_FISHEYE = np.array([0.05, -0.03, 0.02, -0.01])


def wide_angles() -> NDArray[np.float64]:
    """Points 20 to 70 degrees off the axis, where all four coefficients count."""
    theta, phi = np.meshgrid(np.radians(np.linspace(20, 70, 11)), np.linspace(0, 6, 7))
    away = np.stack([np.cos(phi) * np.sin(theta), np.sin(phi) * np.sin(theta), np.cos(theta)], -1)
    return 500.0 * away.reshape(-1, 3)


def test_fisheye_agrees_with_opencv_at_wide_angles() -> None:
    points, still = wide_angles(), np.zeros(3)
    y, visible = FisheyeCamera(np.eye(3), STRONG_FISHEYE).project(points)
    expected, _ = cv2.fisheye.projectPoints(
        points[:, None], still, still, np.eye(3), STRONG_FISHEYE
    )
    assert visible.all()
    # at 70 degrees the last coefficient alone moves the image by 0.06
    np.testing.assert_allclose(y, expected[:, 0], atol=1e-12)


def test_fisheye_jacobian_agrees_with_central_differences_at_wide_angles() -> None:
    sensor, points, step = FisheyeCamera(K, STRONG_FISHEYE), wide_angles(), 1e-3
    _, J, visible = sensor.linearise(points)
    assert visible.all()
    for axis, shift in enumerate(step * np.eye(3)):
        numerical = (sensor.project(points + shift)[0] - sensor.project(points - shift)[0]) / (
            2 * step
        )
        np.testing.assert_allclose(J[..., axis], numerical, atol=1e-6)


@pytest.mark.parametrize("degrees", [30.0, 89.0, 90.0, 91.0, 105.0, 120.0])
def test_a_fisheye_sees_beside_and_behind_itself_as_far_as_its_image_goes(degrees: float) -> None:
    # 125 degrees from the middle to the side, 94 down
    sensor = FisheyeCamera(
        np.array([[293.0, 0, 639.5], [0, 293.0, 479.5], [0, 0, 1]]), np.zeros(4), (1280, 960)
    )
    theta, step = np.radians(degrees), 1e-4
    point = 500.0 * np.array([[np.sin(theta), 0.0, np.cos(theta)]])
    y, J, visible = sensor.linearise(point)
    assert visible.all()
    # 293 px a radian
    np.testing.assert_allclose(y, [[639.5 + 293.0 * theta, 479.5]], atol=1e-9)
    numerical = [
        (sensor.project(point + shift)[0] - sensor.project(point - shift)[0])[0] / (2 * step)
        for shift in step * np.eye(3)
    ]
    np.testing.assert_allclose(J[0].T, numerical, atol=1e-6)
    np.testing.assert_allclose(sensor.rays(y).directions, point / 500.0, atol=1e-12)
    assert FisheyeCamera(K).project(point)[1].tolist() == [degrees < 90]  # of no known size


def test_a_point_beyond_the_turning_angle_of_a_fisheye_is_hidden() -> None:
    # θ (1 - 0.3 θ²) turns at θ = 1.054, which is 60.4 degrees
    sensor = FisheyeCamera(K, np.array([-0.3, 0, 0, 0]))
    angles = np.radians([59.0, 62.0, 85.0])
    points = np.stack([np.sin(angles), 0 * angles, np.cos(angles)], axis=-1)
    assert sensor.project(points)[1].tolist() == [True, False, False]


@pytest.mark.parametrize("name", SENSORS)
def test_a_sensor_moved_against_a_motion_measures_what_it_would_of_moved_points(name: str) -> None:
    sensor, points = SENSORS[name], points_in_view(20)
    motion = from_rotation_vector([0.3, -0.2, 0.15], [20.0, 5.0, -40.0])
    expected, seen = sensor.project(transform(motion, points))
    y, visible = sensor.moved(motion).project(points)
    np.testing.assert_array_equal(visible, seen)
    np.testing.assert_allclose(y, expected, atol=1e-8)
    assert np.abs(expected - sensor.project(points)[0]).max() > 5.0


@pytest.mark.parametrize("coefficients", [[], [0.1, 0.01, 0.001, 0.001], [0.1] * 8])
def test_of_no_pixels_there_are_no_lines_of_sight(coefficients: list[float]) -> None:
    K = np.array([[900.0, 0, 640], [0, 900.0, 512], [0, 0, 1]])
    camera = PinholeCamera(K, np.array(coefficients), (1280, 1024))
    assert len(camera.rays(np.zeros((0, 2)))) == 0
    fisheye = FisheyeCamera(K, np.zeros(4), (1280, 1024))
    assert len(fisheye.rays(np.zeros((0, 2)))) == 0
