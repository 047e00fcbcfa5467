"""Which detections of one camera are tried as which features, and when it was enough of that."""

from __future__ import annotations

from itertools import product
from math import comb, inf

import numpy as np
import pytest
from detections import ALL_FREE, detect
from numpy.typing import NDArray

from mixpose.body import Body, PointFeature
from mixpose.objective import View
from mixpose.rigid import from_rotation_vector, rotation_angle_deg, transform
from mixpose.search import THOROUGH, SearchBudget, search_frame
from mixpose.search.problem import SearchProblem
from mixpose.search.search import _share_of_rivals
from mixpose.search.three_points import _perspective
from mixpose.search.triples import _seen_together, ray_triples
from mixpose.sensors import PinholeCamera

Floats = NDArray[np.float64]
POSE = from_rotation_vector([2.2, 0.4, 0.3], [15.0, -20.0, 800.0])
CAMERA = PinholeCamera(
    np.array([[1000.0, 0, 640], [0, 1000.0, 512], [0, 0, 1]]), resolution=(1280, 1024)
)


def box(size: float = 120.0, each: int = 6) -> Body:
    """A cube with some features at random places of each side, which face outwards."""
    rng, points, normals = np.random.default_rng(3), [], []
    for axis, side in product(range(3), (-1.0, 1.0)):
        some = rng.uniform(-0.45, 0.45, (each, 3))
        some[:, axis] = side / 2
        points += [*(size * some)]
        normals += each * [side * np.eye(3)[axis]]
    return Body("box", tuple(PointFeature(point) for point in points), np.array(normals))


def seen(body: Body, noise: float = 0.05) -> View:
    """What the camera sees of the sides that face it."""
    assert body.normals is not None
    away = transform(POSE, body.means)
    faces = (away * (body.normals @ POSE[:3, :3].T)).sum(axis=1) < 0
    few = Body("few", tuple(np.array(body.features, dtype=object)[faces]))
    (view,) = detect([CAMERA], few, POSE, noise=noise)
    return view


@pytest.mark.parametrize("repeats", [inf, THOROUGH.repeats])
def test_a_search_ends_where_a_rival_of_its_pose_would_have_been_seen(repeats: float) -> None:
    body = box()
    view = seen(body)
    assert view.observation.cells == 18
    budget = SearchBudget(repeats=repeats)
    found = search_frame([view], body, free=ALL_FREE, T_reference=None, budget=budget)
    best = found.candidates[0].T_world_object
    assert rotation_angle_deg(best, POSE) < 0.2
    # 455 of 816 triples of 18 detections are of any 15 of them, so that 13 guesses at the pose are
    # enough, which the first batches of sixty have
    assert (found.report.made < 20_000) == (repeats < inf)


def test_walls_that_face_each_other_are_seen_together() -> None:
    """Of a channel a camera sees both walls inside; of a board one of its two sides."""
    y, z = (one.ravel() for one in np.meshgrid((-40.0, 0.0, 40.0), (-30.0, 30.0)))
    walls = [np.column_stack([np.full(6, x), y, z]) for x in (-50.0, 50.0)]
    inward = np.repeat([[1.0, 0, 0], [-1.0, 0, 0]], 6, axis=0)
    features = tuple(PointFeature(point) for point in np.concatenate(walls))
    assert _seen_together(Body("channel", features, inward)).shape == (3, 12 * 11 * 10)
    assert _seen_together(Body("board", features, -inward)).shape == (3, 2 * 6 * 5 * 4)


def test_a_rival_that_explains_less_is_led_to_by_fewer_triples() -> None:
    assert _share_of_rivals(15.3, 18.3) == 455 / 816
    assert _share_of_rivals(4.0, 7.0) == 4 / 35
    # what two detections explain no triple leads to: as long as there may be such, all are tried
    assert _share_of_rivals(2.4, 5.4) == 0.0
    assert _share_of_rivals(-3.0, 0.0) == 0.0


def test_neighbours_are_tried_first_and_no_features_that_face_away_from_each_other() -> None:
    body = box()
    rays = CAMERA.rays(seen(body).observation.pattern.points)  # type: ignore[union-attr]
    assert rays is not None
    assert body.normals is not None
    first, *rest = ray_triples(SearchProblem([], body, ALL_FREE, np.eye(4)), rays)
    near = np.argsort(np.linalg.norm(rays.pixels[:, None] - rays.pixels, axis=2), axis=1)[:, :4]
    for triple in first[0].T.tolist():
        assert any(set(triple) <= set(near[k].tolist()) for k in triple)
    sides = np.arange(len(body)) // 6
    assert (sides[first[1]] == sides[first[1][0]]).all()
    # each triple of a side in any order: 6 sides, 12 to 20 triples of 6 neighbours, 6 orders
    assert 6 * 8 * 6 <= len(np.unique(first[1], axis=1).T) <= 6 * 20 * 6
    assert sum(some.shape[1] for some, _ in (first, *rest)) <= THOROUGH.max_problems


def test_guesses_show_each_of_the_features_that_they_are_made_from() -> None:
    body = box()
    rays = CAMERA.rays(seen(body).observation.pattern.points)  # type: ignore[union-attr]
    assert rays is not None
    assert body.normals is not None
    rng, made = np.random.default_rng(0), 0
    for _ in range(400):
        detections, corners = rng.permutation(18)[:3], rng.permutation(len(body))[:3]
        poses = _perspective(body, 4.5, rays, detections[:, None], corners[:, None])
        away = transform(poses, body.means[corners])
        outward = body.normals[corners] @ poses[:, :3, :3].swapaxes(1, 2)
        assert ((outward * away).sum(axis=2) < 0).all()
        made += len(poses)
    assert made > 10


def test_all_triples_of_few_detections_are_tried_but_of_opposite_sides() -> None:
    body = box(each=4)
    rays = CAMERA.rays(np.random.default_rng(0).uniform(100, 900, (5, 2)))
    assert rays is not None
    problem = SearchProblem([], body, ALL_FREE, np.eye(4))
    features = np.concatenate([triples for _, triples in ray_triples(problem, rays)], axis=1)
    # sides 2k and 2k + 1 are opposite
    are_opposite = [features[a] // 4 == (features[b] // 4) ^ 1 for a, b in ((0, 1), (0, 2), (1, 2))]
    assert not np.any(are_opposite)
    # beside one of 24 features 3 are of its side, and then 18 opposite to none; 16 are of others,
    # and then 14
    assert features.shape[1] == comb(5, 3) * 24 * (3 * 18 + 16 * 14)
