from __future__ import annotations

import tracemalloc

import numpy as np
import pytest
from detections import ALL_FREE
from scipy.spatial.transform import Rotation

from mixpose.body import Body, PointFeature
from mixpose.density import Observation
from mixpose.objective import View
from mixpose.records import PointPattern
from mixpose.rigid import from_parts
from mixpose.search import SearchBudget
from mixpose.search.from_points import (
    feature_triangles,
    from_point_triples,
    sort_by_support,
    triangulate,
)
from mixpose.search.problem import SearchProblem, sensor_detections
from mixpose.sensors import FisheyeCamera, ParallelBeam, PinholeCamera, Sensor

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
def test_rays_of_two_cameras_meet_in_the_point_that_both_see(kind: str) -> None:
    points = np.random.default_rng(1).uniform(-100, 100, (10, 3))
    rays = [camera.rays(camera.project(points)[0]) for camera in cameras(kind)]
    found = triangulate([each for each in rays if each is not None], [1.0, 1.0])
    same = found.rays[:, 0] == found.rays[:, 1]
    assert same.sum() == 10
    np.testing.assert_allclose(found.points[same], points[found.rays[same, 0]], atol=0.02)
    # rays of different points rarely meet
    assert (~same).sum() < 10


def test_thousands_of_rays_are_not_all_held_against_each_other_at_once() -> None:
    """Four million pairs, of which a number each would take 32 MB, and a point each 96 MB."""
    rng = np.random.default_rng(6)
    seen = [
        camera.rays(rng.uniform([0, 0], [1280, 1024], (2000, 2))) for camera in cameras("pinhole")
    ]
    rays = [each for each in seen if each is not None]
    tracemalloc.start()
    try:
        found = triangulate(rays, [0.3, 0.2])
        _, most = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert most < 2**24
    a, b = (each.select(found.rays[:, k]) for k, each in enumerate(rays))
    normal = np.cross(a.directions, b.directions)
    between = np.abs(((b.origins - a.origins) * normal).sum(axis=1))
    # lines pass at |(o_b - o_a) . (d_a x d_b)| / |d_a x d_b|; each pair within its gate, none twice
    assert len(np.unique(found.rays, axis=0)) == len(found.rays) > 1000
    assert found.gap.max() <= 1
    allowed = found.tolerance / np.clip(4 * found.gap, 0.3, 1)
    np.testing.assert_allclose(found.gap * allowed, between / (normal**2).sum(axis=1))
    # of some rays of the first camera, none that meets is left out
    some = rays[0].select(np.arange(1500, 1520))
    again = triangulate([some, rays[1]], [0.3, 0.2])
    own = (found.rays[:, 0] >= 1500) & (found.rays[:, 0] < 1520)
    np.testing.assert_array_equal(again.rays, found.rays[own] - np.array([1500, 0]))
    np.testing.assert_allclose(again.points, found.points[own], atol=1e-6)


@pytest.mark.parametrize(
    ("noise", "within", "least"), [(0.03, 1.0, 0.3), (0.45, 0.97, 0.3), (1.5, 0.84, 0.95)]
)
def test_points_are_as_exact_as_their_rays_meet(noise: float, within: float, least: float) -> None:
    """Detections that err by 0.02, 0.3 and 1 of a σ_ε of 1.5 px, with gates of three of them.

    Of those that err by as much as nothing does, 6 in 7 are no farther off than four of their gaps.
    """
    rng = np.random.default_rng(8)
    points, pair = rng.uniform(-100, 100, (400, 3)), cameras("pinhole")
    seen = [
        camera.rays(camera.project(points)[0] + rng.normal(0, noise, (400, 2))) for camera in pair
    ]
    found = triangulate([each for each in seen if each is not None], [4.5, 4.5])
    own = found.rays[:, 0] == found.rays[:, 1]
    off = np.linalg.norm(found.points[own] - points[found.rays[own, 0]], axis=1)
    assert np.mean(off < found.tolerance[own]) >= within
    # against what gates by themselves would allow
    assert np.median(np.clip(4 * found.gap[own], 0.3, 1)) == pytest.approx(least, abs=0.05)


def test_three_points_in_space_give_the_pose() -> None:
    rng = np.random.default_rng(2)
    features = rng.uniform(-100, 100, (6, 3))
    T = from_parts(Rotation.random(rng=rng).as_matrix(), [10.0, -20.0, 5.0])
    world = features @ T[:3, :3].T + T[:3, 3]
    rays = [camera.rays(camera.project(world[:4])[0]) for camera in cameras("parallel")]
    found = triangulate([each for each in rays if each is not None], [0.1, 0.1])
    body = Body("six", tuple(PointFeature(point) for point in features))
    generator = from_point_triples(SearchProblem([], body, ALL_FREE, np.eye(4)), found)
    guesses = np.concatenate([poses() for poses in generator])
    error = np.abs(guesses - T).max(axis=(1, 2))
    assert error.min() < 1e-6


def test_triangles_of_features_are_ordered_and_not_flat() -> None:
    corners = [[0.0, 0, 0], [30, 0, 0], [0, 40, 0], [60, 0, 0]]
    body = Body("four", tuple(PointFeature(np.array(point)) for point in corners))
    triples, tree = feature_triangles(body, 1000, 0.05)
    # of four triples three are no line, in six orders each
    assert len(triples) == 18
    away, index = tree.query([30.0, 40.0, 50.0])
    assert away < 1e-9
    assert triples[index].tolist() == [0, 1, 2]


def test_points_that_more_cameras_confirm_come_first() -> None:
    rng = np.random.default_rng(3)
    points = rng.uniform(-100, 100, (5, 3))
    third = from_parts(Rotation.from_euler("x", 90, degrees=True).as_matrix(), [0, 0, 1000.0])
    sensors = [*cameras("pinhole"), PinholeCamera(K, np.zeros(0), (1280, 1024), third)]
    views = []
    for k, camera in enumerate(sensors):
        false = rng.uniform([0, 0], [1280, 1024], (40, 2))
        y = np.concatenate([false, camera.project(points)[0]])
        views.append(View(str(k), camera, Observation(PointPattern(y, np.ones(45)), 1.0)))
    body = Body("five", tuple(PointFeature(point) for point in points))
    detections = sensor_detections(views, body)
    rays = [each.rays for each in detections if each.rays is not None]
    budget = SearchBudget(max_triples=40 * 10)
    problem = SearchProblem(detections, body, ALL_FREE, np.eye(4), budget=budget)
    found = sort_by_support(problem, triangulate(rays, [3.0] * 3))
    off = np.linalg.norm(found.points[:5, None] - points, axis=2).min(axis=1)
    # 40 false detections a view leave a point by chance that three confirm now and then
    assert np.sum(off < 0.1) >= 4
