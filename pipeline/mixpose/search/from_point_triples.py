"""Guesses of several cameras: three triangulated points as three features of the body.

Triangles of features are put into a tree by the lengths of their sides, once for a body; three
points find the triangles of the same shape in it.  The points that most cameras confirm, and where
the rays pass each other most closely, are combined first (PROSAC, Chum and Matas, CVPR 2005).
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache, partial
from itertools import combinations
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from mixpose.body import Body
from mixpose.records import Floats, Indices
from mixpose.search.problem import Generator, SearchProblem
from mixpose.search.three_points import FIRST, SECOND, align_triples, gathered
from mixpose.search.triangulation import TriangulatedPoints


class FeatureTriangles(NamedTuple):
    """Ordered triples of features that span a triangle."""

    corners: Indices  # (K, 3)
    tree: cKDTree  # of the sides (K, 3): lengths between corners 0 and 1, 0 and 2, 1 and 2


@lru_cache(maxsize=16)
def feature_triangles(body: Body, count: int, min_sine: float) -> FeatureTriangles:
    """All ordered triples of a body's features, or `count` at random where they are more.

    Left out are those whose height is a smaller share of the longest side than `min_sine`.
    """
    n = len(body)
    if n * (n - 1) * (n - 2) <= count:
        corners = np.stack(np.meshgrid(*[np.arange(n)] * 3, indexing="ij"), -1).reshape(-1, 3)
    else:
        corners = np.random.default_rng(0).integers(0, n, (count, 3))
    sides = _sides(body.means, corners)
    wide = _is_wide(sides, min_sine)
    return FeatureTriangles(corners[wide], cKDTree(sides[wide].reshape(-1, 3)))


def from_point_triples(problem: SearchProblem, points: TriangulatedPoints) -> Generator:
    """Poses of triples of points, the most promising first."""
    budget = problem.budget
    # the features of each triangle in all six orders
    triangles = feature_triangles(problem.body, 6 * budget.max_triples, budget.min_sine)
    if not len(triangles.corners) or len(points) < 3:
        return Generator("point triples", [], np.asarray)
    batches = _point_triples(problem, points, float(triangles.tree.data.max()))
    return Generator("point triples", batches, partial(_poses, problem, points, triangles))


def _poses(
    problem: SearchProblem, points: TriangulatedPoints, triangles: FeatureTriangles, drawn: Indices
) -> Floats:
    """Poses that bring triangles of features onto those of triples (K, 3) of points."""
    budget, body, tree = problem.budget, problem.body, triangles.tree
    bent = problem.gate * np.sqrt(2) * body.spread  # of a side between two features that give way
    sides = _sides(points.points, drawn)
    slack = 2 * points.tolerance[drawn].max(axis=1) + bent
    possible = _is_wide(sides, budget.min_sine) & (sides.max(axis=1) < tree.data.max() + slack)
    triples, sides = drawn[possible], sides[possible]
    squares = points.tolerance[triples] ** 2
    allowed = np.sqrt(squares[:, FIRST] + squares[:, SECOND] + bent**2)
    away, index = tree.query(
        sides,
        k=np.arange(1, min(2 * budget.sample, len(triangles.corners)) + 1),
        distance_upper_bound=float(allowed.max(initial=0.0)) * np.sqrt(3),
    )
    which, rank = np.nonzero(np.isfinite(away))
    chosen = index[which, rank]
    alike = (np.abs(sides[which] - tree.data[chosen]) <= allowed[which]).all(axis=1)
    features, world = triangles.corners[chosen[alike]], triples[which[alike]]
    return align_triples(gathered(body.means, features.T), gathered(points.points, world.T))


def by_promise(problem: SearchProblem, points: TriangulatedPoints) -> TriangulatedPoints:
    """The points that most sensors confirm, the closest first, each place once."""
    # each of them is the first of twenty triples
    count = problem.budget.max_triples // 20
    if len(problem.cameras) == 2:  # every feature once
        return points.select(np.argsort(points.gap, kind="stable")[:count])
    support, error = np.zeros((2, len(points)))
    for sensor, _ in problem.cameras:
        y, seen = sensor.view.sensor.project(points.points)
        reach = problem.reach(sensor)
        away, _ = cKDTree(sensor.points).query(y, distance_upper_bound=reach)
        met = seen & np.isfinite(away)
        support += met
        error += np.where(met, away / reach, 0.0)
    error /= np.maximum(support, 1.0)
    kept: list[int] = []
    left = np.ones(len(points), dtype=np.bool_)
    for k in np.lexsort((error, -support)):
        if left[k] and len(kept) < count:
            kept.append(int(k))
            near = np.abs(points.points - points.points[k]).max(axis=1) <= points.tolerance[k]
            left &= ~near
    return points.select(np.array(kept, dtype=np.intp))


def _point_triples(
    problem: SearchProblem, points: TriangulatedPoints, reach: float
) -> Iterator[Indices]:
    """Batches of triples (K, 3) of points that share no ray, the most promising first."""
    # as many triangles are alike as `2 * sample` at most; later ones twice as many, up to eight
    size = problem.budget.batch // 32
    rays = points.sensors * (points.rays.max(initial=0) + 1) + points.rays
    first = min(len(points), problem.budget.promising)
    triples = _combinations(first)
    if first < len(points):
        triples = np.concatenate([triples, _near_triples(problem, points.points, reach)])
    end = 0
    while end < len(triples):
        start, end = end, min(end + max(end, size), end + 8 * size)
        batch = triples[start:end]
        six = np.sort(rays[batch].reshape(-1, 6), axis=1)
        yield batch[(np.diff(six, axis=1) > 0).all(axis=1)]


@lru_cache(maxsize=64)
def _combinations(count: int) -> Indices:
    """Triples (K, 3) of numbers below `count`, those of the first numbers first."""
    triples = np.array(list(combinations(range(count), 3)), dtype=np.intp).reshape(-1, 3)
    return triples[np.argsort(triples[:, 2], kind="stable")]


def _near_triples(problem: SearchProblem, points: Floats, reach: float) -> Indices:
    """Triples (K, 3) drawn among points (P, 3) that are within reach of the first of them."""
    rng = np.random.default_rng(problem.seed)
    pairs = cKDTree(points).query_pairs(reach, output_type="ndarray")
    pairs = np.concatenate([pairs, pairs[:, ::-1]])
    pairs = pairs[np.argsort(pairs[:, 0], kind="stable")]
    counts = np.bincount(pairs[:, 0], minlength=len(points))
    crowded = np.flatnonzero(counts > 1)
    if not len(crowded):
        return np.zeros((0, 3), dtype=np.intp)
    first = rng.choice(crowded, problem.budget.max_triples)
    begin = (np.cumsum(counts) - counts)[first]
    second, third = (
        pairs[begin + (rng.random(len(first)) * counts[first]).astype(np.intp), 1] for _ in range(2)
    )
    return np.asarray(np.stack([first, second, third], axis=1)[second != third])


def _sides(points: Floats, triples: Indices) -> Floats:
    sides = points[triples[:, FIRST]] - points[triples[:, SECOND]]
    return np.asarray(np.linalg.norm(sides, axis=2))


def _is_wide(sides: Floats, min_sine: float) -> NDArray[np.bool_]:
    """Whether triangles with sides (K, 3) have a height, as a share of the longest side."""
    a, b, c = np.sort(sides, axis=1).T
    # Heron's formula; twice the area is height times longest side
    area4 = np.maximum((a + b + c) * (a + b - c) * (a - b + c) * (b + c - a), 0.0)
    return np.asarray(np.sqrt(area4) / 2 > min_sine * c * c)
