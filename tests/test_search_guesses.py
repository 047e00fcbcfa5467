"""Parts of the search: directions that are held, faces turned away."""

from __future__ import annotations

from itertools import product
from math import comb

import numpy as np
import pytest
from detections import ALL_FREE, EIGHT, TRUTH, detect, view_of
from numpy.typing import NDArray

from mixpose.body import Body
from mixpose.rigid import from_parts, from_rotation_vector, perturb, transform, twist_between
from mixpose.search import LIVE, THOROUGH, SearchBudget
from mixpose.search.from_points import (
    TriangulatedPoints,
    _rays_near,
    generators_of,
    point_triples,
)
from mixpose.search.poses import count_inliers, label_image
from mixpose.search.problem import SearchProblem, sensor_detections
from mixpose.search.three_points import align_triples
from mixpose.search.triples import ray_triples
from mixpose.sensors import PinholeCamera

Floats = NDArray[np.float64]


def test_directions_that_are_held_stay_where_the_reference_has_them() -> None:
    free = np.array([True, False, False, False, False, True])
    pose = perturb(TRUTH, np.array([5.0, 7.0, -3.0, 0.0, 0.0, 0.2]))
    (constrained,) = SearchProblem([], EIGHT, free, TRUTH).constrained(pose[None])
    expected = np.array([5.0, 0, 0, 0, 0, 0.2])
    np.testing.assert_allclose(twist_between(TRUTH, constrained), expected, atol=1e-9)


def test_features_that_turn_their_back_to_a_camera_explain_no_detection(
    pinhole_cameras: list[PinholeCamera],
) -> None:
    camera = pinhole_cameras[0]
    y = camera.project(transform(TRUTH, EIGHT.means))[0]
    detections = sensor_detections([view_of("0", camera, y)], EIGHT)
    problem = SearchProblem(detections, EIGHT, ALL_FREE, np.eye(4))
    images = [label_image(*camera, problem.reach(camera[0])) for camera in problem.cameras]
    towards = camera.towards(transform(TRUTH, EIGHT.means)) @ TRUTH[:3, :3]
    normals = towards / np.linalg.norm(towards, axis=1, keepdims=True)
    normals[5:] *= -1
    faced = Body("eight", EIGHT.features, normals)
    counts, _ = count_inliers(images, faced, TRUTH[None])
    assert counts.tolist() == [[5.0]]
    counts, _ = count_inliers(images, EIGHT, TRUTH[None])
    assert counts.tolist() == [[8.0]]


def test_triangles_are_brought_onto_their_images_by_the_motion_between_them() -> None:
    corners = np.random.default_rng(1).uniform(-50, 50, (20, 3, 3))
    images = transform(TRUTH, corners.reshape(-1, 3)).reshape(corners.shape)
    found = align_triples(corners.transpose(1, 2, 0), images.transpose(1, 2, 0))
    np.testing.assert_allclose(found, np.broadcast_to(TRUTH, found.shape), atol=1e-6)
    # of an image whose first side is a little off, the least squares of all three corners are taken
    bent = images.copy()
    bent[:, 1] += 0.5
    for T, here, there in zip(
        align_triples(corners.transpose(1, 2, 0), bent.transpose(1, 2, 0)), corners, bent
    ):
        across = np.cross(there[1] - there[0], there[2] - there[0])
        across /= np.linalg.norm(across)
        off = np.linalg.norm(transform(T, here) - there)
        for angle in (0.002, -0.002):
            centre = there.mean(axis=0)
            turn = (
                from_parts(np.eye(3), centre)
                @ from_rotation_vector(angle * across, np.zeros(3))
                @ from_parts(np.eye(3), -centre)
            )
            assert np.linalg.norm(transform(turn @ T, here) - there) > off


def test_where_false_detections_crowd_three_rays_come_before_points_and_rays(
    pinhole_cameras: list[PinholeCamera],
) -> None:
    def names(false: int) -> list[str]:
        views = detect(pinhole_cameras[:2], EIGHT, TRUTH, false=false)
        seen = sensor_detections(views, EIGHT)
        problem = SearchProblem(seen, EIGHT, ALL_FREE, np.eye(4))
        return [getattr(guesses, "__name__", "") for guesses in generators_of(problem)]

    triples, point, rays = "from_point_triples", "from_point_and_rays", "from_three_rays"
    assert names(8) == [triples, point, rays, rays]
    assert names(9) == [triples, rays, rays, point]  # more than two detections for a feature


def test_a_point_and_two_rays_give_each_pose_once(pinhole_cameras: list[PinholeCamera]) -> None:
    seen = sensor_detections(detect(pinhole_cameras[:2], EIGHT, TRUTH, noise=0.1), EIGHT)
    guesses = generators_of(SearchProblem(seen, EIGHT, ALL_FREE, np.eye(4)))[1]
    poses = next(guesses)()
    # of two rays and two features, not the other way round again; a ray that passes by is met once
    assert len(np.unique(poses.round(6), axis=0)) == len(poses) > 100


def test_rays_beside_a_point_are_those_that_pass_nearest(
    pinhole_cameras: list[PinholeCamera],
) -> None:
    seen = sensor_detections(detect(pinhole_cameras[:2], EIGHT, TRUTH, false=60), EIGHT)
    problem = SearchProblem(seen, EIGHT, ALL_FREE, np.eye(4))
    place = transform(TRUTH, EIGHT.means[:1])
    sensors, rays = np.array([[0, 1]]), np.array([[0, 0]])
    points = TriangulatedPoints(place, np.ones(1), np.zeros(1), sensors, rays)
    origins, directions, across, *_ = _rays_near(problem, points, 0)
    expected = np.linalg.norm(np.cross(place - origins, directions), axis=1)
    np.testing.assert_allclose(across, expected, atol=1e-6)
    rest = [one.select(np.arange(1, len(one))) for _, one in problem.cameras]
    passing = [np.cross(place - one.origins, one.directions) for one in rest]
    every = np.sort(np.linalg.norm(np.concatenate(passing), axis=1))
    assert len(every) > len(across) == 3 * THOROUGH.sample
    np.testing.assert_allclose(across, every[: len(across)], atol=1e-6)


def test_triples_are_drawn_near_each_other_where_most_detections_are_false() -> None:
    # 8 of 56 rays in one place: of triples drawn anywhere 1 in 500 is of them, of a ray and two
    # of the 7 nearest to it 1 in 7
    K = np.array([[800.0, 0, 640], [0, 800.0, 512], [0, 0, 1]])
    camera = PinholeCamera(K, resolution=(1280, 1024))
    y = camera.project(transform(TRUTH, EIGHT.means) + np.array([0.0, 0.0, 2000.0]))[0]
    u, v = np.meshgrid(np.linspace(20, 1260, 8), np.linspace(20, 1000, 6))
    far = np.stack([u.ravel(), v.ravel()], axis=1)
    rays = camera.rays(np.concatenate([y, far]))
    assert rays is not None
    budget = SearchBudget(max_problems=4 * THOROUGH.batch)
    problem = SearchProblem([], EIGHT, ALL_FREE, np.eye(4), budget=budget)
    chunks = list(ray_triples(problem, rays))
    own = [float((triples < 8).all(axis=0).mean()) for triples, _ in chunks]
    assert len(chunks) == 4  # one for each crowd and one for all
    assert own[0] == pytest.approx(1 / 7, rel=0.1)
    assert own[3] == pytest.approx(8 * 7 * 6 / (56 * 55 * 54), rel=0.7)


def test_features_of_which_no_three_face_alike_are_tried_with_those_near_them() -> None:
    corners = np.array(list(product((-1.0, 1.0), repeat=3)))  # of a cube: 70° apart
    body = Body("hedgehog", EIGHT.features, corners / np.sqrt(3))
    camera = PinholeCamera(np.diag([800.0, 800.0, 1.0]), resolution=(1280, 1024))
    rays = camera.rays(np.random.default_rng(0).uniform(0, 1000, (12, 2)))
    assert rays is not None
    budget = SearchBudget(max_problems=4 * THOROUGH.batch)
    chunks = list(ray_triples(SearchProblem([], body, ALL_FREE, np.eye(4), budget=budget), rays))
    assert sum(triples.shape[1] for triples, _ in chunks) == 2 * THOROUGH.batch


def test_sizes_of_a_search_follow_from_its_numbers() -> None:
    # as many of the most promising points as all triples of can be tried
    none = np.zeros((100, 3))
    points = TriangulatedPoints(
        none, none[:, 0], none[:, 0], np.tile([0, 1], (100, 1)), np.arange(200).reshape(-1, 2)
    )
    triples = point_triples(SearchProblem([], EIGHT, ALL_FREE, np.eye(4)), points)
    assert sum(len(batch) for batch in triples) == comb(63, 3) <= THOROUGH.max_triples < comb(64, 3)
    # a search of 2,000 guesses is not spent on one batch
    assert (THOROUGH.batch, LIVE.batch) == (4096, 1000)
    # 1,200 features refined, and of any body a quarter of the guesses
    assert [THOROUGH.refined(n) for n in (5, 8, 16, 100)] == [150, 150, 75, 37]
