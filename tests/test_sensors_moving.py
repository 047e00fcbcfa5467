"""Cameras that see a moving body late or row after row: as a map from points at the common time."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from mixpose.rigid import from_rotation_vector, inverse, perturb, transform
from mixpose.sensors import (
    FisheyeCamera,
    Motion,
    PinholeCamera,
    RollingSensor,
    Sensor,
    in_motion,
    read_times,
)

Floats = NDArray[np.float64]

K = np.array([[820.0, 0, 633.0], [0, 815.0, 507.0], [0, 0, 1]])
PLACE = from_rotation_vector([0.2, -0.3, 0.1], [30.0, -20.0, 900.0])
IMAGE = (1280, 1024)
CAMERAS: dict[str, Sensor] = {
    "pinhole": PinholeCamera(K, np.array([-0.21, 0.1, 1e-3, -4e-4, 0.02]), IMAGE, PLACE),
    "fisheye": FisheyeCamera(K / 1.5, np.array([0.05, -0.01, 2e-3, -3e-4]), IMAGE, PLACE),
}
BODY = from_rotation_vector([0.4, 0.1, -0.2], [40.0, 25.0, -30.0])
# half a metre and 115 degrees per second, which change in a tenth of a second
MOTION = Motion(
    BODY,
    np.array([350.0, -300.0, 200.0, 1.2, -1.0, 1.3]),
    np.array([-2000.0, 3000.0, 1500.0, 8.0, 9.0, -7.0]),
)
LATE, READOUT = 0.004, 0.025


def points(count: int = 60) -> Floats:
    return transform(BODY, np.random.default_rng(3).uniform(-120, 120, (count, 3)))


def seen_at(camera: Sensor, x: Floats, seconds: float) -> Floats:
    """A point in an image that is taken at once, some seconds later."""
    T = perturb(BODY, MOTION.velocity * seconds + 0.5 * MOTION.acceleration * seconds**2)
    y, seen = camera.project(transform(T @ inverse(BODY), x[None]))
    assert seen.all()
    return np.asarray(y[0])


@pytest.mark.parametrize("name", CAMERAS)
def test_each_point_is_seen_where_it_is_when_its_row_is_read(name: str) -> None:
    camera = CAMERAS[name]
    rolling = in_motion(camera, MOTION, LATE, READOUT)
    assert isinstance(rolling, RollingSensor)
    y, seen = rolling.project(points())
    assert seen.all()
    for x, predicted in zip(points(), y, strict=True):
        # the middle row is read at the delay, the last half a readout later
        when = LATE + READOUT * (predicted[1] - 511.5) / 1023
        # one Newton step, of 12 ms in which the row moves by ten
        np.testing.assert_allclose(seen_at(camera, x, when), predicted, atol=5e-4)


@pytest.mark.parametrize("name", CAMERAS)
def test_jacobians_are_those_of_the_places(name: str) -> None:
    rolling = in_motion(CAMERAS[name], MOTION, LATE, READOUT)
    x, step = points(), 1e-4
    _, J, _ = rolling.linearise(x)
    for k in range(3):
        ahead, behind = (rolling.project(x + s * step * np.eye(3)[k])[0] for s in (1, -1))
        np.testing.assert_allclose(J[..., k], (ahead - behind) / (2 * step), atol=1e-4)


def test_a_late_camera_is_one_that_was_moved_and_one_in_step_itself() -> None:
    camera = CAMERAS["pinhole"]
    assert in_motion(camera, MOTION, 0.0, 0.0) is camera
    assert in_motion(camera, Motion(BODY, np.zeros(6)), LATE, READOUT) is camera
    late = in_motion(camera, MOTION, LATE, 0.0)
    assert type(late) is type(camera)
    for x, y in zip(points(), late.project(points())[0], strict=True):
        np.testing.assert_allclose(seen_at(camera, x, LATE), y, atol=1e-9)


def test_a_rolling_camera_can_be_moved_with_the_world() -> None:
    rolling = in_motion(CAMERAS["pinhole"], MOTION, LATE, READOUT)
    world = perturb(np.eye(4), np.array([30.0, -20.0, 50.0, 0.2, -0.5, 0.3]))
    moved = rolling.moved(world)
    x = transform(inverse(world), points())
    np.testing.assert_allclose(moved.project(x)[0], rolling.project(points())[0], atol=1e-6)


def test_rows_are_read_from_half_a_readout_before_the_delay_to_half_after() -> None:
    ends = np.array([[0.0, 0.0], [0.0, 511.5], [0.0, 1023.0]])
    times = read_times(CAMERAS["pinhole"], ends, LATE, READOUT)
    np.testing.assert_allclose(times, LATE + READOUT * np.array([-0.5, 0, 0.5]))


def test_of_no_points_a_rolling_camera_sees_none() -> None:
    y, seen = in_motion(CAMERAS["pinhole"], MOTION, LATE, READOUT).project(np.zeros((0, 3)))
    assert (y.shape, seen.shape) == ((0, 2), (0,))
