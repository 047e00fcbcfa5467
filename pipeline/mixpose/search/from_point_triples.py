"""Guesses of several cameras: three triangulated points as three features of the body.

Triangles of features are put into a tree by the lengths of their sides, once for a body; three
points find the triangles of the same shape in it.  The points that most cameras confirm, and where
the rays pass each other most closely, are combined first (PROSAC, Chum and Matas, CVPR 2005).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import combinations, islice
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from mixpose.body import Body
from mixpose.search.alignment import align_triples
from mixpose.search.budget import SearchBudget
from mixpose.search.detections import SensorDetections
from mixpose.search.triangulation import TriangulatedPoints

Floats: TypeAlias = NDArray[np.float64]
Indices: TypeAlias = NDArray[np.intp]

_SIDES = ((0, 1), (0, 2), (1, 2))


@dataclass(frozen=True)
class FeatureTriangles:
    """Ordered triples of features that span a triangle.

    Attributes
    ----------
    corners : (K, 3) int
    sides : (K, 3) float64
        Lengths between corners 0 and 1, 0 and 2, 1 and 2.
    tree : cKDTree
        Of the sides.
    """

    corners: Indices
    sides: Floats
    tree: cKDTree


@lru_cache(maxsize=16)
def feature_triangles(body: Body, count: int, min_height: float) -> FeatureTriangles:
    """All ordered triples of a body's features, or as many at random.

    Parameters
    ----------
    body : Body
    count : int
        Most triangles.
    min_height : float
        Of a triangle, as a share of its longest side.
    """
    n = len(body)
    if n * (n - 1) * (n - 2) <= count:
        corners = np.stack(np.meshgrid(*[np.arange(n)] * 3, indexing="ij"), -1).reshape(-1, 3)
    else:
        corners = np.random.default_rng(0).integers(0, n, (count, 3))
    sides = _sides(body.means, corners)
    wide = _is_wide(sides, min_height)
    corners, sides = corners[wide], sides[wide]
    return FeatureTriangles(corners, sides, cKDTree(sides.reshape(-1, 3)))


def from_point_triples(
    found: TriangulatedPoints,
    body: Body,
    budget: SearchBudget,
    rng: np.random.Generator,
    skipped: int = 0,
) -> Iterator[Floats]:
    """Poses (K, 4, 4) of triples of points, batch by batch.

    Parameters
    ----------
    found : TriangulatedPoints
        Most promising first.
    body : Body
    budget : SearchBudget
    rng : numpy Generator
        Draws among the triples of all points where they are too many.
    skipped : int
        Batches left out, as they were tried before.
    """
    triangles = feature_triangles(body, budget.max_triangles, budget.min_height)
    if not len(triangles.corners) or len(found) < 3:
        return
    longest = float(triangles.sides.max())
    bent = budget.gate * np.sqrt(2) * body.spread  # of a side between two features that give way
    for drawn in islice(_point_triples(found, longest, budget, rng), skipped, None):
        sides = _sides(found.points, drawn)
        slack = 2 * found.tolerance[drawn].max(axis=1) + bent
        possible = _is_wide(sides, budget.min_height) & (sides.max(axis=1) < longest + slack)
        triples, sides = drawn[possible], sides[possible]
        tolerance = found.tolerance[triples]
        squares = np.stack([tolerance[:, i] ** 2 + tolerance[:, j] ** 2 for i, j in _SIDES], axis=1)
        allowed = np.sqrt(squares + bent**2)
        k = min(budget.triangles_alike, len(triangles.corners))
        away, index = triangles.tree.query(
            sides,
            k=np.arange(1, k + 1),
            distance_upper_bound=float(allowed.max(initial=0.0)) * np.sqrt(3),
        )
        which, rank = np.nonzero(np.isfinite(away))
        chosen = index[which, rank]
        off = np.abs(sides[which] - triangles.sides[chosen])
        alike = (off <= allowed[which]).all(axis=1)
        which, chosen = which[alike], chosen[alike]
        world = found.points[triples[which]].transpose(1, 2, 0)
        features = body.means[triangles.corners[chosen]].transpose(1, 2, 0)
        yield align_triples(features, world)


def by_promise(
    found: TriangulatedPoints, detections: Sequence[SensorDetections], gate: float, count: int
) -> TriangulatedPoints:
    """The points that most sensors confirm, the closest first, each place once.

    Parameters
    ----------
    found : TriangulatedPoints
    detections : sequence of SensorDetections
        Of the sensors with rays.
    gate : float
        Largest error of a detection in σ_ε.
    count : int
        Most points.
    """
    support, error = np.zeros(len(found)), found.gap.copy()
    if len(detections) > 2:
        error[:] = 0.0
        for each in detections:
            y, seen = each.view.sensor.project(found.points)
            reach = gate * each.sigma
            away, _ = cKDTree(each.points).query(y, distance_upper_bound=reach)
            met = seen & np.isfinite(away)
            support += met
            error += np.where(met, away / reach, 0.0)
        error /= np.maximum(support, 1.0)
    order = np.lexsort((error, -support))
    if len(detections) == 2:  # every feature once
        return found.select(order[:count])
    kept: list[int] = []
    left = np.ones(len(found), dtype=np.bool_)
    for k in order:
        if left[k]:
            kept.append(int(k))
            if len(kept) == count:
                break
            near = np.abs(found.points - found.points[k]).max(axis=1) <= found.tolerance[k]
            left &= ~near
    return found.select(np.array(kept, dtype=np.intp))


def _point_triples(
    found: TriangulatedPoints, reach: float, budget: SearchBudget, rng: np.random.Generator
) -> Iterator[Indices]:
    """Batches of triples (K, 3) of points that share no ray, the most promising first."""
    first = min(len(found), budget.max_prosac_points)
    triples = _combinations(first)
    if first < len(found):
        triples = np.concatenate([triples, _near_triples(found.points, reach, budget, rng)])
    end = 0
    while end < len(triples):
        start, end = end, min(end + max(end, budget.batch), end + 8 * budget.batch)
        batch = triples[start:end]
        shared = [_share_a_ray(found, batch[:, i], batch[:, j]) for i, j in _SIDES]
        yield batch[~np.any(shared, axis=0)]


@lru_cache(maxsize=64)
def _combinations(count: int) -> Indices:
    """Triples (K, 3) of numbers below `count`, those of the first numbers first."""
    triples = np.array(list(combinations(range(count), 3)), dtype=np.intp).reshape(-1, 3)
    return triples[np.argsort(triples[:, 2], kind="stable")]


def _near_triples(
    points: Floats, reach: float, budget: SearchBudget, rng: np.random.Generator
) -> Indices:
    """Triples (K, 3) drawn among points (P, 3) that are within reach of the first of them."""
    pairs = cKDTree(points).query_pairs(reach, output_type="ndarray")
    pairs = np.concatenate([pairs, pairs[:, ::-1]])
    pairs = pairs[np.argsort(pairs[:, 0], kind="stable")]
    counts = np.bincount(pairs[:, 0], minlength=len(points))
    crowded = np.flatnonzero(counts > 1)
    if not len(crowded):
        return np.zeros((0, 3), dtype=np.intp)
    first = rng.choice(crowded, budget.random_triples)
    begin = (np.cumsum(counts) - counts)[first]
    second, third = (
        pairs[begin + (rng.random(len(first)) * counts[first]).astype(np.intp), 1] for _ in range(2)
    )
    return np.asarray(np.stack([first, second, third], axis=1)[second != third])


def _share_a_ray(found: TriangulatedPoints, i: Indices, j: Indices) -> NDArray[np.bool_]:
    """Whether points share a ray: then at most one of them is a feature."""
    same = [
        (found.sensors[i, a] == found.sensors[j, b]) & (found.rays[i, a] == found.rays[j, b])
        for a in range(2)
        for b in range(2)
    ]
    return np.asarray(np.any(same, axis=0))


def _sides(points: Floats, triples: Indices) -> Floats:
    corners = points[triples]
    sides = [np.linalg.norm(corners[:, i] - corners[:, j], axis=1) for i, j in _SIDES]
    return np.stack(sides, axis=1)


def _is_wide(sides: Floats, min_height: float) -> NDArray[np.bool_]:
    """Whether triangles with sides (K, 3) have a height, as a share of the longest side."""
    a, b, c = np.sort(sides, axis=1).T
    # Heron's formula; twice the area is height times longest side
    area4 = np.maximum((a + b + c) * (a + b - c) * (a - b + c) * (b + c - a), 0.0)
    return np.asarray(np.sqrt(area4) / 2 > min_height * c * c)
