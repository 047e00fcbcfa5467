"""Sensors moved with the world, and lines of sight: of all kinds of sensors."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from mixpose.rigid import from_rotation_vector, inverse, perturb, transform
from mixpose.sensors import (
    SENSOR_MODELS,
    CloudSensor,
    FisheyeCamera,
    ParallelBeam,
    PinholeCamera,
    RangeSensor,
    Sensor,
)

Floats = NDArray[np.float64]

K = np.array([[820.0, 0.4, 633.0], [0, 815.0, 507.0], [0, 0, 1]])
PLACE = from_rotation_vector([0.2, -0.3, 0.1], [30.0, -20.0, 900.0])
IMAGE = (1280, 1024)
BARREL = np.array([-0.21, 0.1, 1e-3, -4e-4, 0.02])
SENSORS: dict[str, Sensor] = {
    "pinhole": PinholeCamera(K, np.zeros(0), IMAGE, PLACE),
    "pinhole with a lens": PinholeCamera(K, BARREL, IMAGE, PLACE),
    "fisheye": FisheyeCamera(K / 1.5, np.array([0.05, -0.01, 2e-3, -3e-4]), IMAGE, PLACE),
    "parallel": ParallelBeam(0.5, np.array([640.0, 512.0]), IMAGE, PLACE),
    "cloud": CloudSensor(PLACE),
    "lateration": RangeSensor(np.array([100.0, -900.0, 30.0]), 2.0, (500.0, 1400.0)),
}
WITHOUT_RAYS = ("cloud", "lateration")
MOTION = perturb(np.eye(4), np.array([30.0, -20.0, 50.0, 0.2, -0.5, 0.3]))


def points(count: int = 200) -> Floats:
    return np.random.default_rng(3).uniform(-150, 150, (count, 3))


def test_every_kind_of_sensor_is_under_test() -> None:
    assert {type(sensor) for sensor in SENSORS.values()} == set(SENSOR_MODELS.values())


@pytest.mark.parametrize("name", SENSORS)
def test_a_moved_sensor_sees_where_this_one_sees_what_moved(name: str) -> None:
    sensor, x = SENSORS[name], points()
    moved = sensor.moved(MOTION)
    assert type(moved) is type(sensor)
    y, seen = moved.project(x)
    expected, expected_seen = sensor.project(transform(MOTION, x))
    assert seen.mean() > 0.5
    np.testing.assert_array_equal(seen, expected_seen)
    # rounding of lengths of a thousand
    np.testing.assert_allclose(y, expected, rtol=1e-12, atol=1e-9)


@pytest.mark.parametrize("name", SENSORS)
def test_a_moved_sensor_stays_the_sensor_that_it_was(name: str) -> None:
    sensor, x = SENSORS[name], points(20)
    moved = sensor.moved(MOTION)
    np.testing.assert_array_equal(moved.lower, sensor.lower)
    np.testing.assert_array_equal(moved.upper, sensor.upper)
    back = moved.moved(inverse(MOTION))
    np.testing.assert_allclose(back.project(x)[0], sensor.project(x)[0], rtol=1e-12, atol=1e-9)


@pytest.mark.parametrize("name", [name for name in SENSORS if name not in WITHOUT_RAYS])
def test_rays_pass_through_the_points_that_are_seen_there(name: str) -> None:
    sensor, x = SENSORS[name], points()
    y, seen = sensor.project(x)
    rays = sensor.rays(y[seen])
    assert rays is not None
    assert len(rays) == np.count_nonzero(seen) > 100
    np.testing.assert_array_equal(rays.pixels, y[seen])
    away = x[seen] - rays.origins
    along = (away * rays.directions).sum(axis=1)
    across = np.linalg.norm(away - along[:, None] * rays.directions, axis=1)
    # lenses are undone by iteration: to 1e-3 px, which is as many mm at 0.8 m and 800 px
    assert across.max() < 1.5e-3
    # away from the sensor, in front of which the points are
    np.testing.assert_allclose(np.linalg.norm(rays.directions, axis=1), 1.0, rtol=1e-12)
    assert (along > 0).all()
    assert ((rays.directions * sensor.towards(x[seen])).sum(axis=1) < 0).all()


@pytest.mark.parametrize("name", [name for name in SENSORS if name not in WITHOUT_RAYS])
def test_points_along_a_ray_are_seen_at_its_pixel(name: str) -> None:
    sensor = SENSORS[name]
    y, seen = sensor.project(points(60))
    rays = sensor.rays(y[seen])
    assert rays is not None
    for distance in (600.0, 900.0, 1500.0):
        again, visible = sensor.project(rays.origins + distance * rays.directions)
        assert visible.all()
        np.testing.assert_allclose(again, rays.pixels, atol=2e-3)


@pytest.mark.parametrize("name", [name for name in SENSORS if name not in WITHOUT_RAYS])
def test_a_pixel_covers_the_length_across_a_ray_that_is_stated(name: str) -> None:
    sensor, x = SENSORS[name], points(60)
    y, J, seen = sensor.linearise(x)
    rays = sensor.rays(y[seen])
    assert rays is not None
    distance = ((x[seen] - rays.origins) * rays.directions).sum(axis=1)
    length = rays.offset + rays.slope * distance
    # px per length across the ray: the root of the product of the two singular values
    scales = np.linalg.svd(J[seen], compute_uv=False)
    ratio = length * np.sqrt(scales[:, 0] * scales[:, 1])
    # off the axis a pinhole's pixels cover less: up to cos³ of 14 degrees; lenses change 10 %
    assert np.median(ratio) == pytest.approx(1.0, abs=0.1)


def test_rays_of_strong_lenses_are_as_exact() -> None:
    lens = np.array([5.2, 2.1, 1e-4, -1e-4, 0.09, 5.6, 3.5, 0.5])
    camera = PinholeCamera(
        np.array([[600.0, 0, 640], [0, 600.0, 480], [0, 0, 1]]), lens, (1280, 960)
    )
    places = np.stack(np.meshgrid(np.linspace(-1, 1, 40), np.linspace(-0.75, 0.75, 30)), axis=-1)
    x = np.concatenate([places.reshape(-1, 2), np.ones((1200, 1))], axis=1)
    y, seen = camera.project(x)
    rays = camera.rays(y[seen])
    assert len(rays) == np.count_nonzero(seen) > 1000
    again, _ = camera.project(rays.origins + rays.directions)
    np.testing.assert_allclose(again, y[seen], atol=1e-6)


def test_a_range_leaves_no_line_of_sight() -> None:
    assert SENSORS["lateration"].rays(np.array([[900.0]])) is None
    assert SENSORS["cloud"].rays(np.zeros((1, 3))) is None


def test_detections_that_no_point_causes_have_no_ray() -> None:
    # r (1 - 0.3 r²) is 0.70 at the most, where the model turns: 577 px from the centre
    camera = PinholeCamera(K, np.array([-0.3, 0, 0, 0]), IMAGE)
    y = np.array([[633.0 + 300, 507.0], [633.0 + 640, 507.0]])
    rays = camera.rays(y)
    np.testing.assert_array_equal(rays.pixels, y[:1])
