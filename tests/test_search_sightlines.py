from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mixpose.rigid import from_parts
from mixpose.search.sightlines import sightlines
from mixpose.search.spatial import from_points
from mixpose.search.triangulation import triangulate
from mixpose.sensors import FisheyeCamera, ParallelBeam, PinholeCamera, RangeSensor, Sensor

K = np.array([[900.0, 2.0, 639.5], [0, 880.0, 511.5], [0, 0, 1]])


def poses() -> tuple[np.ndarray, np.ndarray]:
    """Two cameras at right angles, a unit of 1000 from the middle."""
    first = from_parts(np.eye(3), [0, 0, 1000.0])
    second = from_parts(Rotation.from_euler("y", 90, degrees=True).as_matrix(), [0, 0, 1000.0])
    return first, second


def cameras(kind: str) -> list[Sensor]:
    made: list[Sensor] = []
    for T in poses():
        if kind == "pinhole":
            made.append(PinholeCamera(K, np.array([-0.2, 0.05, 1e-3, -1e-3]), (1280, 1024), T))
        elif kind == "fisheye":
            made.append(FisheyeCamera(K, np.array([0.05, -0.01, 0.0, 0.0]), (1280, 1024), T))
        else:
            made.append(ParallelBeam(0.5, np.array([640.0, 512.0]), (1280, 1024), T))
    return made


@pytest.mark.parametrize("kind", ["pinhole", "fisheye", "parallel"])
def test_a_line_of_sight_passes_through_the_point_that_was_seen(kind: str) -> None:
    points = np.random.default_rng(0).uniform(-100, 100, (20, 3))
    for camera in cameras(kind):
        y, seen = camera.project(points)
        assert seen.all()
        lines = sightlines(camera, y)
        assert lines is not None
        away = points - lines.origins
        across = np.linalg.norm(np.cross(away, lines.directions), axis=1)
        # lens distortion is undone by iteration, to 0.02 px: 1.2e-5 rad at a distance of 1000
        assert across.max() < 0.02


def test_a_range_has_no_line_of_sight() -> None:
    assert sightlines(RangeSensor(np.zeros(3)), np.array([[100.0]])) is None


@pytest.mark.parametrize("kind", ["pinhole", "fisheye", "parallel"])
def test_lines_of_two_cameras_meet_in_the_point_that_both_see(kind: str) -> None:
    points = np.random.default_rng(1).uniform(-100, 100, (10, 3))
    lines = [sightlines(camera, camera.project(points)[0]) for camera in cameras(kind)]
    found = triangulate([each for each in lines if each is not None], [1.0, 1.0])
    same = found.lines[:, 0] == found.lines[:, 1]
    assert same.sum() == 10
    np.testing.assert_allclose(found.points[same], points[found.lines[same, 0]], atol=0.02)
    # lines of different points rarely meet
    assert (~same).sum() < 10


def test_three_points_in_space_give_the_pose() -> None:
    rng = np.random.default_rng(2)
    features = rng.uniform(-100, 100, (6, 3))
    T = from_parts(Rotation.random(rng=rng).as_matrix(), [10.0, -20.0, 5.0])
    world = features @ T[:3, :3].T + T[:3, 3]
    lines = [sightlines(camera, camera.project(world[:4])[0]) for camera in cameras("parallel")]
    found = triangulate([each for each in lines if each is not None], [0.1, 0.1])
    guesses = from_points(found, features, rng)
    error = np.abs(guesses - T).max(axis=(1, 2))
    assert error.min() < 1e-6
