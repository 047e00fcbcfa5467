"""Spheres and disks: where the centres of their images are, against images of their surfaces."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from mixpose.body import Body, PointFeature
from mixpose.body.model import Shape
from mixpose.objective import project_body
from mixpose.rigid import from_rotation_vector, perturb, transform
from mixpose.sensors import FisheyeCamera, ParallelBeam, PinholeCamera, RangeSensor, Sensor

Floats = NDArray[np.float64]

K = np.array([[900.0, 0.0, 630.0], [0, 890.0, 505.0], [0, 0, 1]])
IMAGE = (1280, 1024)
SIDE = from_rotation_vector([0.0, 0.6, 0.1], [-300.0, -40.0, 260.0])
SENSORS: dict[str, Sensor] = {
    "pinhole": PinholeCamera(K, np.zeros(0), IMAGE),
    "with a lens": PinholeCamera(K, np.array([-0.25, 0.12, 1e-3, -5e-4]), IMAGE, SIDE),
    "fisheye": FisheyeCamera(K / 1.6, np.array([0.05, -0.01, 2e-3, -3e-4]), IMAGE),
    "parallel": ParallelBeam(0.5, np.array([640.0, 512.0]), IMAGE),
}
POINTS = np.array([[-130.0, -90, 0], [140, -60, 30], [120, 100, -40], [-100, 110, 10]])
NORMALS = np.array([[0.0, 0, -1], [0.5, 0, -1], [0.2, -0.6, -1], [-0.9, 0.2, -1]])
NORMALS = NORMALS / np.linalg.norm(NORMALS, axis=1, keepdims=True)
RADII = np.array([20.0, 15.0, 18.0, 9.0])
POSE = from_rotation_vector([0.2, -0.3, 0.4], [20.0, -15.0, 800.0])


def body(shape: Shape) -> Body:
    features = tuple(PointFeature(point) for point in POINTS)
    radii = None if shape == "point" else RADII
    return Body("it", features, NORMALS if shape == "disk" else None, None, shape, radii)


def surface(shape: Shape, k: int) -> Floats:
    """Points all over a sphere, or along the edge of a disk, in the object's frame."""
    around = np.linspace(0, 2 * np.pi, 500, endpoint=False)
    if shape == "disk":
        first = np.cross(NORMALS[k], [0.3, 1.0, 0.2])
        first /= np.linalg.norm(first)
        second = np.cross(NORMALS[k], first)
        circle = np.cos(around)[:, None] * first + np.sin(around)[:, None] * second
        return np.asarray(POINTS[k] + RADII[k] * circle)
    polar = np.linspace(0, np.pi, 250)[:, None]
    sines = np.sin(polar)
    x = np.stack([sines * np.cos(around), sines * np.sin(around), np.cos(polar) + 0 * around], -1)
    return np.asarray(POINTS[k] + RADII[k] * x.reshape(-1, 3))


def seen_centre(sensor: Sensor, points: Floats) -> Floats:
    """Centroid of the area that projected points span."""
    y, seen = sensor.project(points)
    assert seen.all()
    middle = y.mean(axis=0)
    # single precision is what OpenCV knows: near the origin
    x, y_ = cv2.convexHull((y - middle).astype(np.float32))[:, 0].astype(np.float64).T
    cross = x * np.roll(y_, -1) - np.roll(x, -1) * y_
    centre = [(cross * (one + np.roll(one, -1))).sum() / (3 * cross.sum()) for one in (x, y_)]
    return np.asarray(middle + centre)


@pytest.mark.parametrize("shape", ["sphere", "disk"])
@pytest.mark.parametrize("name", SENSORS)
def test_a_marker_is_predicted_where_the_centre_of_its_image_is(name: str, shape: Shape) -> None:
    sensor = SENSORS[name]
    at = project_body((sensor,), body(shape)).project(POSE[None])
    plain = project_body((sensor,), body("point")).project(POSE[None])
    expected = np.array([seen_centre(sensor, transform(POSE, surface(shape, k))) for k in range(4)])
    off = np.linalg.norm(plain.y[0, 0] - expected, axis=1)
    if name != "parallel":
        assert off.max() > 0.01  # what is mended
    # the next order of a marker of 1/40 of its distance is 1e-7 of a focal length
    np.testing.assert_allclose(at.y[0, 0], expected, atol=2e-4)


@pytest.mark.parametrize("shape", ["sphere", "disk"])
@pytest.mark.parametrize("name", SENSORS)
def test_jacobians_are_those_of_the_places(name: str, shape: Shape) -> None:
    projection = project_body((SENSORS[name],), body(shape))
    J = projection.project(POSE[None]).J[0, 0]
    step = 1e-4
    for k, unit in enumerate(np.diag([1.0, 1, 1, 1e-2, 1e-2, 1e-2])):
        ends = [projection.project(perturb(POSE, s * step * unit)[None]).y[0, 0] for s in (1, -1)]
        numeric = (ends[0] - ends[1]) / (2 * step * unit[k])
        # without the turn of the disk itself: (radius / distance)² of a focal length
        scale = np.abs(J[..., k]).max()
        np.testing.assert_allclose(J[..., k], numeric, atol=0.01 * max(scale, 1e-3))


def test_several_sensors_and_poses_at_once_are_each_for_itself() -> None:
    poses = np.array([POSE, perturb(POSE, np.array([10.0, 5, -20, 0.1, -0.1, 0.2]))])
    sensors = (SENSORS["pinhole"], SENSORS["with a lens"])
    ranged = RangeSensor(np.array([0.0, 0, -100]), 0.0, (1.0, 5000.0))
    for shape in ("sphere", "disk"):
        together = project_body((*sensors, ranged), body(shape)).project(poses)
        for k, sensor in enumerate((*sensors, ranged)):
            for h, pose in enumerate(poses):
                alone = project_body((sensor,), body(shape)).project(pose[None])
                np.testing.assert_allclose(together.y[k, h], alone.y[0, 0], rtol=1e-12)
                np.testing.assert_array_equal(together.seen[k, h], alone.seen[0, 0])


def test_a_marker_that_the_border_cuts_is_not_in_view() -> None:
    near_border = perturb(POSE, np.array([-455.0, 0, 0, 0, 0, 0]))
    seen = project_body((SENSORS["pinhole"],), body("sphere")).project(near_border[None]).seen
    plain = project_body((SENSORS["pinhole"],), body("point")).project(near_border[None]).seen
    assert plain.sum() > seen.sum()
