"""Poses of all bodies of a frame, from the points that cameras see together."""

from __future__ import annotations

import numpy as np
import pytest
from bodies_in_view import CAMERAS, at, body
from detections import ALL_FREE
from numpy.typing import NDArray

from mixpose.body import Body, SegmentFeature
from mixpose.density import Observation
from mixpose.objective import View
from mixpose.records import PointPattern
from mixpose.rigid import transform
from mixpose.search import SeenTogether, search_copies
from mixpose.search.copies import _Candidates, _near_triples, _resolve_shared
from mixpose.search.from_points import TriangulatedPoints, feature_triangles
from mixpose.search.problem import SearchBudget

Floats = NDArray[np.float64]

# equal sides but for a hundredth, and a triangle of its own
TRIANGLE = body("triangle", np.array([[0.0, 0, 0], [43.0, 0, 0], [21.4, 37.5, 0]]))
HEAD = body("head", np.array([[0.0, 0, 0], [42.0, 0, 0], [11.0, 49.5, 0]]))
PLACES = [at(-150.0), at(-60.0, 90.0, turn=0.7), at(40.0, -80.0, turn=-0.5), at(130.0, 30.0)]


def seen(bodies: list[Body], poses: list[Floats], seed: int, cameras: int = 2) -> SeenTogether:
    """With 0.15 px of noise, and ten false spots each."""
    rng, views = np.random.default_rng(seed), []
    for name, one in list(CAMERAS.items())[:cameras]:
        spots = [one.project(transform(T, b.means))[0] for b, T in zip(bodies, poses, strict=True)]
        points = rng.permutation(
            np.concatenate([*spots, rng.uniform([0, 0], [1280, 1024], (10, 2))])
        )
        points = points + 0.15 * rng.standard_normal(points.shape)
        views.append(View(name, one, Observation(PointPattern(points, np.ones(len(points))), 1.5)))
    return SeenTogether(views)


def test_equal_triangles_and_another_one_are_found_at_once_each_in_its_place() -> None:
    there = [TRIANGLE, HEAD, TRIANGLE, TRIANGLE]
    for seed in range(10):
        found = search_copies(seen(there, PLACES, seed), [TRIANGLE, HEAD], ALL_FREE)
        best = found[:4]
        assert sorted(one.kind for one in best) == [0, 0, 0, 1]
        middles = [transform(T, b.means).mean(axis=0) for b, T in zip(there, PLACES, strict=True)]
        nearest = []
        for one in best:
            own = transform(one.T_world_object, [TRIANGLE, HEAD][one.kind].means).mean(axis=0)
            away = np.linalg.norm(middles - own, axis=1)
            nearest.append(int(away.argmin()))
            # of 0.15 px at 1200 mm and 1000 px, two rays at 57° to each other
            assert away.min() < 1.5
        assert sorted(nearest) == [0, 1, 2, 3]


def test_no_two_poses_have_the_same_markers() -> None:
    only, *rest = search_copies(seen([TRIANGLE], PLACES[:1], 0), [TRIANGLE], ALL_FREE)
    middle = transform(only.T_world_object, TRIANGLE.means).mean(axis=0)
    others = [transform(one.T_world_object, TRIANGLE.means).mean(axis=0) for one in rest]
    assert all(np.linalg.norm(one - middle) > 20.0 for one in others)


def test_another_point_that_may_be_a_marker_makes_a_rival() -> None:
    # a fourth marker, as far from two of the triangle as the third, on the other side of both
    pair = body("pair", np.concatenate([TRIANGLE.means, [[21.4, -37.5, 0.0]]]))
    found = search_copies(seen([pair], PLACES[:1], 1), [TRIANGLE], ALL_FREE)
    assert found[0].rival is not None


@pytest.mark.parametrize(
    ("kind", "less", "is_rival"), [(0, 1.0, True), (1, 1.0, False), (0, 1e3, False)]
)
def test_a_rival_is_a_pose_of_the_same_body_that_is_not_outdone(
    kind: int, less: float, is_rival: bool
) -> None:
    # both meet the same three detections
    found = [[(PLACES[0], 50.0)], []]
    found[kind].append((PLACES[1], 50.0 - less))
    rivals = {
        k: _Candidates(
            np.array([T for T, _ in some]).reshape(-1, 4, 4),
            np.array([evidence for _, evidence in some]),
            np.zeros(len(some)),
            np.tile(np.arange(3), (len(some), 1)),
        )
        for k, some in enumerate(found)
    }
    (copy,) = _resolve_shared(rivals, [TRIANGLE, HEAD], SearchBudget())
    assert (copy.rival is not None) == is_rival


def test_beside_a_body_of_strokes_one_of_points_is_found() -> None:
    strokes = Body("strokes", tuple(SegmentFeature(p, 1.1 * p + 4.0) for p in TRIANGLE.means))
    found = search_copies(seen([TRIANGLE], PLACES[:1], 0), [strokes, TRIANGLE], ALL_FREE)
    assert [one.kind for one in found] == [1]


def test_one_camera_sees_no_points_in_space() -> None:
    views = seen([TRIANGLE, TRIANGLE], PLACES[:2], 0, cameras=1)
    assert search_copies(views, [TRIANGLE], ALL_FREE) == []


def test_of_triangles_that_symmetries_map_to_each_other_one_is_tried() -> None:
    corners, _ = feature_triangles(TRIANGLE, 48, 0.02)
    assert len(TRIANGLE.symmetries) == 6
    assert corners.tolist() == [[0, 1, 2]]
    assert len(feature_triangles(HEAD, 48, 0.02)[0]) == 6


def test_features_on_a_line_have_no_triangles_and_are_not_found_by_them() -> None:
    line = body("line", np.array([[0.0, 0.0, 0.0], [40.0, 0.0, 0.0], [100.0, 0.5, 0.0]]))
    assert not len(feature_triangles(line, 36, 0.1)[0])
    assert search_copies(seen([line], [at(0.0)], 0), [line], ALL_FREE) == []


@pytest.mark.parametrize(("count", "most"), [(30, 1000), (150, 1000), (150, 10**6)])
def test_triples_of_near_points_are_those_of_the_first_points_however_many_there_are(
    count: int, most: int
) -> None:
    rng = np.random.default_rng(count)
    points = TriangulatedPoints(
        rng.uniform(0, 100, (count, 3)),
        np.full(count, 0.5),
        np.zeros(count),
        np.tile([0, 1], (count, 1)),
        rng.integers(0, count // 2, (count, 2)),
    )

    def is_near(i: int, j: int) -> bool:
        away = float(np.linalg.norm(points.points[i] - points.points[j]))
        return bool(away < 40.0 + 1.0 and (points.rays[i] != points.rays[j]).all())

    expected = [
        (i, j, k)
        for k in range(count)
        for j in range(k)
        for i in range(j)
        if is_near(i, j) and is_near(i, k) and is_near(j, k)
    ]
    found = list(map(tuple, _near_triples(points, 40.0, most).tolist()))
    assert len(found) == min(len(expected), most) > 10
    # the promising ones: in the order of their last point
    assert [k for *_, k in found] == [k for *_, k in expected][:most]
    assert set(found) <= set(expected)
