"""Sensors side by side measure what they measure one by one."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from numpy.typing import NDArray

from mixpose.rigid import from_rotation_vector
from mixpose.sensors import (
    OUTSIDE,
    FisheyeCamera,
    ParallelBeam,
    PinholeCamera,
    RangeSensor,
    Sensor,
    SensorBatch,
    side_by_side,
)
from mixpose.sensors.batch import MixedBatch, PinholeBatch, RangeBatch

Floats = NDArray[np.float64]

K = np.array([[820.0, 3.0, 633.0], [0, 815.0, 507.0], [0, 0, 1]])
BARREL = np.array([-0.21, 0.02, 1e-3, -4e-4, 0.0])
RATIONAL = np.array([0.3, 0.1, 1e-3, -4e-4, 0.02, 0.5, 0.05, 0.01])
PRISM = np.array([*RATIONAL, 1e-3, 2e-4, -1e-3, 3e-4])
TILTS = [np.array([*PRISM, *tilt]) for tilt in ((0.02, -0.03), (-0.05, 0.04))]
PLACES = [
    from_rotation_vector([0.2, -0.3, 0.1], [30.0, -20.0, 900.0]),
    from_rotation_vector([-0.1, 0.9, 0.3], [-60.0, 10.0, 700.0]),
    from_rotation_vector([0.0, 0.4, -0.2], [0.0, 40.0, 1100.0]),
]
# most of them in view of each camera, some beside the image, behind a camera or beside it
POINTS = np.concatenate(
    [
        np.random.default_rng(3).uniform(-250, 250, (60, 3)),
        np.random.default_rng(4).uniform(-3000, 3000, (60, 3)),
    ]
)


def cameras(
    *lenses: Floats | None, resolution: tuple[int, int] | None = (1280, 1024)
) -> list[PinholeCamera]:
    return [
        PinholeCamera(K + 5.0 * k * np.diag([1, 1, 0]), np.zeros(0) if D is None else D,
                      resolution, T)
        for k, (D, T) in enumerate(zip(lenses, PLACES, strict=False))
    ]  # fmt: skip


def assert_as_one_by_one(together: SensorBatch, sensors: Sequence[Sensor], points: Floats) -> None:
    y, J, visible = together.linearise(points)
    m = sensors[0].dimension
    assert y.shape == (len(sensors), len(points), 2)
    assert J.shape == (len(sensors), len(points), 2, 3)
    # sensors of one coordinate have 0 as their second
    assert not y[visible][:, m:].any()
    assert not J[..., m:, :].any()
    for k, sensor in enumerate(sensors):
        y_alone, J_alone, visible_alone = sensor.linearise(points)
        np.testing.assert_array_equal(visible[k], visible_alone)
        # the same sums in another order: rounding of numbers up to 1e4, hence 1e-8 at most
        np.testing.assert_allclose(y[k, :, :m], y_alone, rtol=1e-11, atol=1e-9)
        np.testing.assert_allclose(J[k, :, :m], J_alone, rtol=1e-10, atol=1e-9)
        towards = together.towards(points)[k]
        np.testing.assert_allclose(towards, sensor.towards(points), rtol=1e-11, atol=1e-9)


@pytest.mark.parametrize(
    "lenses",
    [
        (None, None, None),
        (BARREL, RATIONAL, PRISM),
        (None, BARREL, None),
    ],
    ids=["without lenses", "with lenses", "a lens beside cameras without"],
)
@pytest.mark.parametrize("resolution", [(1280, 1024), None], ids=["image", "no limits"])
def test_pinholes_side_by_side_are_those_one_by_one(
    lenses: tuple[Floats | None, ...], resolution: tuple[int, int] | None
) -> None:
    sensors = cameras(*lenses, resolution=resolution)
    together = side_by_side(sensors)
    assert isinstance(together, PinholeBatch)
    visible = together.linearise(POINTS)[2]
    # the comparison is of what is seen and of what is not
    assert visible.any(axis=1).all()
    assert not visible.all(axis=1).any()
    assert_as_one_by_one(together, sensors, POINTS)


def test_pinholes_that_see_all_points_are_those_one_by_one() -> None:
    near = 0.2 * POINTS[:60]
    sensors = cameras(None, BARREL, RATIONAL)
    assert side_by_side(sensors).linearise(near)[2].all()
    assert_as_one_by_one(side_by_side(sensors), sensors, near)


def test_an_image_of_known_size_beside_one_without_limits() -> None:
    bounded, unbounded = cameras(BARREL)[0], cameras(BARREL, resolution=None)[0]
    R, t = PLACES[0][:3, :3], PLACES[0][:3, 3]
    # about u = 633 + 820 (1 - 0.21) = 1281 px, where the image ends at 1279.5
    beside = (np.array([[900.0, 0.0, 900.0]]) - t) @ R
    assert side_by_side([bounded, unbounded]).linearise(beside)[2][:, 0].tolist() == [False, True]
    assert_as_one_by_one(side_by_side([bounded, unbounded]), [bounded, unbounded], POINTS)


def test_a_camera_without_a_lens_sees_wide_angles_beside_one_whose_model_folds_back() -> None:
    # r (1 - 0.3 r²) turns at r = 1.054; without a lens nothing ends at r = 2
    plain = PinholeCamera(K)
    folding = PinholeCamera(K, np.array([-0.3, 0, 0, 0]))
    points = np.array([[1.0, 0, 1.0], [1.1, 0, 1.0], [2.0, 0, 1.0]])
    visible = side_by_side([plain, folding]).linearise(points)[2]
    np.testing.assert_array_equal(visible, [[True, True, True], [True, False, False]])
    assert_as_one_by_one(side_by_side([plain, folding]), [plain, folding], points)


def test_the_skew_of_a_camera_matrix_is_in_pixels_and_jacobian() -> None:
    skewed = PinholeCamera(np.array([[800.0, 80.0, 0], [0, 800.0, 0], [0, 0, 1]]))
    y, J, _ = side_by_side([skewed]).linearise(np.array([[0.0, 0.5, 1.0]]))
    # u = 800 x/z + 80 y/z: by y it grows by 80
    np.testing.assert_allclose(y[0, 0], [40.0, 400.0])
    np.testing.assert_allclose(J[0, 0], [[800.0, 80.0, -40.0], [0.0, 800.0, -400.0]])


def test_points_behind_cameras_side_by_side_are_outside_and_without_pull() -> None:
    sensors = [PinholeCamera(K), PinholeCamera(K, BARREL)]
    y, J, visible = side_by_side(sensors).linearise(
        np.array([[10.0, 5.0, -800.0], [0.0, 0.0, 800.0]])
    )
    np.testing.assert_array_equal(visible, [[False, True], [False, True]])
    assert (y[:, 0] == OUTSIDE).all()
    assert (J[:, 0] == 0).all()


def test_tilted_cameras_side_by_side_keep_a_tilt_each() -> None:
    sensors = cameras(*TILTS)
    together = side_by_side(sensors)
    assert isinstance(together, MixedBatch)
    assert_as_one_by_one(together, sensors, POINTS)
    one_tilt = PinholeCamera(K, TILTS[0], (1280, 1024), PLACES[1])
    y = together.linearise(0.2 * POINTS[:60])[0]
    # the two tilts put features pixels apart
    assert np.abs(y[1] - one_tilt.linearise(0.2 * POINTS[:60])[0]).max() > 1.0


def test_ranges_with_biases_and_limits_side_by_side_are_those_one_by_one() -> None:
    sensors = [
        RangeSensor(np.array([0.0, -1000.0, 20.0]), 3.5),
        RangeSensor(np.array([800.0, 0.0, 0.0]), -12.0, (600.0, 1500.0)),
        RangeSensor(np.array([0.0, 100.0, 900.0])),
    ]
    together = side_by_side(sensors)
    assert isinstance(together, RangeBatch)
    visible = together.linearise(POINTS)[2]
    assert visible[[0, 2]].all()
    assert 0 < visible[1].sum() < len(POINTS)
    assert_as_one_by_one(together, sensors, POINTS)


def test_a_bias_makes_every_range_longer_by_itself() -> None:
    sensors = [RangeSensor(np.zeros(3), bias, (0.0, 10.0)) for bias in (0.25, -0.5)]
    y, J, visible = side_by_side(sensors).linearise(np.array([[3.0, 4.0, 0.0], [30.0, 40.0, 0.0]]))
    np.testing.assert_allclose(y[:, 0, 0], [5.25, 4.5])
    np.testing.assert_allclose(J[:, 0, 0], [[0.6, 0.8, 0.0]] * 2)
    np.testing.assert_array_equal(visible, [[True, False]] * 2)
    assert (y[:, 1] == OUTSIDE).all()
    assert (J[:, 1] == 0).all()


def test_a_point_at_the_very_place_of_a_range_sensor_has_a_finite_jacobian() -> None:
    y, J, visible = side_by_side([RangeSensor(np.ones(3))]).linearise(np.ones((1, 3)))
    assert y.tolist() == [[[0.0, 0.0]]]
    assert J.tolist() == [[[[0.0, 0.0, 0.0], [0.0, 0.0, 0.0]]]]
    assert visible.all()


def test_cameras_of_all_kinds_side_by_side_are_those_one_by_one() -> None:
    sensors: list[Sensor] = [
        *cameras(None, BARREL),
        FisheyeCamera(K / 1.5, np.array([0.05, -0.01, 2e-3, -3e-4]), (1280, 1024), PLACES[2]),
        ParallelBeam(0.5, np.array([640.0, 512.0]), (1280, 1024), PLACES[1]),
    ]
    together = side_by_side(sensors)
    assert isinstance(together, MixedBatch)
    visible = together.linearise(POINTS)[2]
    assert visible.any(axis=1).all()
    assert not visible.all(axis=1).any()
    assert_as_one_by_one(together, sensors, POINTS)
