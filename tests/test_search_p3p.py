from __future__ import annotations

import numpy as np
from detections import ALL_FREE
from scipy.spatial.transform import Rotation

from mixpose.body import Body, PointFeature
from mixpose.rigid import from_rotation_vector, rotation_angle_deg, transform
from mixpose.search import SearchBudget
from mixpose.search.problem import SearchProblem
from mixpose.search.three_points import SIDES, align_triples, depths, from_three_rays
from mixpose.sensors import PinholeCamera


def random_problems(count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Triangles of the body, unit lines of sight, squared sides, and the true distances."""
    rng = np.random.default_rng(0)
    body = rng.uniform(-100, 100, (count, 3, 3))
    R = Rotation.random(count, rng=rng).as_matrix()
    shift = rng.uniform([-200, -200, 300], [200, 200, 2000], (count, 3))
    seen = body @ np.swapaxes(R, 1, 2) + shift[:, None]
    distance = np.linalg.norm(seen, axis=2)
    sides = [body[:, i] - body[:, j] for i, j in ((0, 1), (0, 2), (1, 2))]
    squared = np.array([(side**2).sum(axis=1) for side in sides])
    lines = (seen / distance[..., None]).transpose(1, 2, 0)
    return body.transpose(1, 2, 0), lines, squared, distance.T


def cosines_of(lines: np.ndarray) -> np.ndarray:
    return np.array([(lines[i] * lines[j]).sum(axis=0) for i, j in SIDES])


def test_the_true_distances_are_among_the_solutions_of_every_problem() -> None:
    _, lines, squared, truth = random_problems(5000)
    found, which = depths(cosines_of(lines), squared)
    error = np.abs(found - truth[:, which]).max(axis=0)
    nearest = np.full(truth.shape[1], np.inf)
    np.minimum.at(nearest, which, error)
    # near double roots two Newton steps leave some 1e-6 of the distance
    assert nearest.max() < 1e-3
    assert np.median(nearest) < 1e-9


def test_every_solution_satisfies_the_projection_equations() -> None:
    body, lines, squared, _ = random_problems(2000)
    found, which = depths(cosines_of(lines), squared)
    T = align_triples(body[:, :, which], lines[:, :, which] * found[:, None])
    points = np.einsum("kij,njk->nik", T[:, :3, :3], body[:, :, which]) + T[:, :3, 3].T
    directions = points / np.linalg.norm(points, axis=1, keepdims=True)
    assert np.abs(directions - lines[:, :, which]).max() < 1e-3
    assert np.median(np.abs(directions - lines[:, :, which])) < 1e-12
    R = T[:, :3, :3]
    assert np.abs(R @ np.swapaxes(R, 1, 2) - np.eye(3)).max() < 1e-9
    assert np.linalg.det(R).min() > 0


def test_no_problem_has_more_than_four_solutions() -> None:
    _, lines, squared, _ = random_problems(2000)
    _, which = depths(cosines_of(lines), squared)
    assert np.bincount(which).max() <= 4


def test_impossible_triangles_have_no_solution() -> None:
    # three lines within a degree cannot hold a triangle with sides 1, 1, 10
    lines = np.array([[0, 0, 1.0], [0.01, 0, 1], [0, 0.01, 1]])
    lines /= np.linalg.norm(lines, axis=1, keepdims=True)
    found, which = depths(cosines_of(lines[:, :, None]), np.array([[1.0], [1.0], [100.0]]))
    assert found.shape == (3, 0)
    assert len(which) == 0


def test_triangles_of_which_corners_are_at_one_place_are_aligned_by_a_rotation() -> None:
    corner, other = np.array([3.0, -2.0, 7.0]), np.array([40.0, 5.0, 1.0])
    for three in ((corner, corner, other), (corner, other, corner), (corner, corner, corner)):
        triangle = np.stack(three)[:, :, None]
        (T,) = align_triples(triangle, triangle + 10.0)
        # no direction of the plane is given, but it must be a rotation all the same
        np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-12)


def test_five_detections_of_a_body_of_36_features_are_enough_for_all_draws() -> None:
    # 428,400 problems, more than are tried in turn: most are drawn among near ones
    rng = np.random.default_rng(0)
    features = rng.uniform(-100, 100, (36, 3))
    T = from_rotation_vector([0.3, -0.2, 0.1], [10.0, -20.0, 900.0])
    camera = PinholeCamera(np.array([[800.0, 0, 320], [0, 800, 256], [0, 0, 1]]))
    near = np.argsort(np.linalg.norm(features - features[0], axis=1))[:5]
    rays = camera.rays(camera.project(transform(T, features[near]))[0])
    body = Body("36", tuple(PointFeature(one) for one in features))
    budget = SearchBudget(max_problems=40_000)
    problem = SearchProblem([], body, ALL_FREE, np.eye(4), budget=budget)
    found = [poses() for poses in from_three_rays(problem, 4.5, rays)]
    # one chunk of neighbours, one of those far apart, and four that are drawn among all five
    assert len(found) == 6
    assert rotation_angle_deg(T, np.concatenate(found)).min() < 0.1


def test_guesses_of_one_camera_face_it() -> None:
    # two squares back to back: of a triple on one of them, half of the poses show its back
    square = np.array([[-30.0, -30, 0], [30, -30, 0], [30, 30, 0], [-30, 30, 0]])
    points = np.concatenate([square, np.add(square, [0.0, 0.0, 40.0])])
    normals = np.repeat([[0.0, 0.0, -1.0], [0.0, 0.0, 1.0]], 4, axis=0)
    body = Body("box", tuple(PointFeature(z) for z in points), normals)
    bare = Body("box", body.features)
    camera = PinholeCamera(np.array([[1500.0, 0, 640], [0, 1500, 512], [0, 0, 1]]))
    truth = from_rotation_vector(np.array([0.3, -0.2, 0.1]), np.array([10.0, -20.0, 600.0]))
    rays = camera.rays(camera.project(transform(truth, square))[0])

    def guesses(one: Body) -> np.ndarray:
        problem = SearchProblem([], one, ALL_FREE, np.eye(4), budget=SearchBudget())
        return np.concatenate([make() for make in from_three_rays(problem, 4.5, rays)])

    facing = guesses(body)
    away = transform(facing, points)
    outward = facing[:, :3, :3] @ normals.T
    seen = np.count_nonzero((outward.swapaxes(1, 2) * away).sum(axis=2) < 0, axis=1)
    assert seen.min() >= 3
    assert len(facing) < len(guesses(bare)) / 2
    assert np.abs(facing - truth).max(axis=(1, 2)).min() < 1e-6
