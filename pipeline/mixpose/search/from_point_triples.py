"""Guesses of several cameras: three triangulated points as three features of the body.

Triangles of features are put into a tree by the lengths of their sides, once for a body; three
points find the triangles of the same shape in it.  The points that most cameras confirm, and where
the rays pass each other most closely, are combined first (PROSAC, Chum and Matas, CVPR 2005).
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache
from itertools import combinations
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from mixpose.body import Body
from mixpose.records import Floats
from mixpose.search.problem import Kind, SearchProblem
from mixpose.search.three_points import SIDES, align_triples
from mixpose.search.triangulation import Indices, TriangulatedPoints

_FIRST, _SECOND = np.transpose(SIDES)


class FeatureTriangles(NamedTuple):
    """Ordered triples of features that span a triangle."""

    corners: Indices  # (K, 3)
    tree: cKDTree  # of the sides (K, 3): lengths between corners 0 and 1, 0 and 2, 1 and 2


@lru_cache(maxsize=16)
def feature_triangles(body: Body, count: int, min_height: float) -> FeatureTriangles:
    """All ordered triples of a body's features, or `count` at random where they are more.

    Left out are those whose height is a smaller share of the longest side than `min_height`.
    """
    n = len(body)
    if n * (n - 1) * (n - 2) <= count:
        corners = np.stack(np.meshgrid(*[np.arange(n)] * 3, indexing="ij"), -1).reshape(-1, 3)
    else:
        corners = np.random.default_rng(0).integers(0, n, (count, 3))
    sides = _sides(body.means, corners)
    wide = _is_wide(sides, min_height)
    return FeatureTriangles(corners[wide], cKDTree(sides[wide].reshape(-1, 3)))


def from_point_triples(problem: SearchProblem, found: TriangulatedPoints) -> Kind:
    """Poses of triples of points, the most promising first."""
    budget, body = problem.budget, problem.body
    triangles = feature_triangles(body, budget.max_triangles, budget.min_height)
    if not len(triangles.corners) or len(found) < 3:
        return Kind("point triples", [], np.asarray)
    longest = float(triangles.tree.data.max())
    bent = budget.gate * np.sqrt(2) * body.spread  # of a side between two features that give way

    def poses(drawn: Indices) -> Floats:
        sides = _sides(found.points, drawn)
        slack = 2 * found.tolerance[drawn].max(axis=1) + bent
        possible = _is_wide(sides, budget.min_height) & (sides.max(axis=1) < longest + slack)
        triples, sides = drawn[possible], sides[possible]
        squares = found.tolerance[triples] ** 2
        allowed = np.sqrt(squares[:, _FIRST] + squares[:, _SECOND] + bent**2)
        away, index = triangles.tree.query(
            sides,
            k=np.arange(1, min(budget.triangles_alike, len(triangles.corners)) + 1),
            distance_upper_bound=float(allowed.max(initial=0.0)) * np.sqrt(3),
        )
        which, rank = np.nonzero(np.isfinite(away))
        chosen = index[which, rank]
        off = np.abs(sides[which] - triangles.tree.data[chosen])
        alike = (off <= allowed[which]).all(axis=1)
        which, chosen = which[alike], chosen[alike]
        world = found.points[triples[which]].transpose(1, 2, 0)
        return align_triples(body.means[triangles.corners[chosen]].transpose(1, 2, 0), world)

    return Kind("point triples", _point_triples(problem, found, longest), poses)


def by_promise(problem: SearchProblem, found: TriangulatedPoints) -> TriangulatedPoints:
    """The points that most sensors confirm, the closest first, each place once."""
    support, error, count = np.zeros(len(found)), np.zeros(len(found)), problem.budget.max_points
    if len(problem.cameras) == 2:  # every feature once
        return found.select(np.argsort(found.gap, kind="stable")[:count])
    for each, _ in problem.cameras:
        y, seen = each.view.sensor.project(found.points)
        reach = problem.reach(each)
        away, _ = cKDTree(each.points).query(y, distance_upper_bound=reach)
        met = seen & np.isfinite(away)
        support += met
        error += np.where(met, away / reach, 0.0)
    error /= np.maximum(support, 1.0)
    kept: list[int] = []
    left = np.ones(len(found), dtype=np.bool_)
    for k in np.lexsort((error, -support)):
        if left[k] and len(kept) < count:
            kept.append(int(k))
            near = np.abs(found.points - found.points[k]).max(axis=1) <= found.tolerance[k]
            left &= ~near
    return found.select(np.array(kept, dtype=np.intp))


def _point_triples(
    problem: SearchProblem, found: TriangulatedPoints, reach: float
) -> Iterator[Indices]:
    """Batches of triples (K, 3) of points that share no ray, the most promising first."""
    size = problem.budget.batch
    rays = found.sensors * (found.rays.max(initial=0) + 1) + found.rays
    first = min(len(found), problem.budget.max_prosac_points)
    triples = _combinations(first)
    if first < len(found):
        triples = np.concatenate([triples, _near_triples(problem, found.points, reach)])
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
    first = rng.choice(crowded, problem.budget.random_triples)
    begin = (np.cumsum(counts) - counts)[first]
    second, third = (
        pairs[begin + (rng.random(len(first)) * counts[first]).astype(np.intp), 1] for _ in range(2)
    )
    return np.asarray(np.stack([first, second, third], axis=1)[second != third])


def _sides(points: Floats, triples: Indices) -> Floats:
    sides = points[triples[:, _FIRST]] - points[triples[:, _SECOND]]
    return np.asarray(np.linalg.norm(sides, axis=2))


def _is_wide(sides: Floats, min_height: float) -> NDArray[np.bool_]:
    """Whether triangles with sides (K, 3) have a height, as a share of the longest side."""
    a, b, c = np.sort(sides, axis=1).T
    # Heron's formula; twice the area is height times longest side
    area4 = np.maximum((a + b + c) * (a + b - c) * (a - b + c) * (b + c - a), 0.0)
    return np.asarray(np.sqrt(area4) / 2 > min_height * c * c)
