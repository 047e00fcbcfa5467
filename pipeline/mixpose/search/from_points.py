"""Guesses of several cameras: points in space where their rays meet, as features of the body.

Three points find triangles of features by the lengths of their sides.  Where cameras see different
features, few points are known: seen from one of them, a feature at a known distance lies where its
ray cuts a sphere, and two such features must be as far apart as they are on the body.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import lru_cache, partial
from itertools import combinations
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

from mixpose.body import Body
from mixpose.records import Floats, Indices, Mask
from mixpose.rigid import transform
from mixpose.search.problem import THOROUGH, SearchBudget, SearchProblem
from mixpose.search.three_points import (
    FIRST,
    SECOND,
    Guesses,
    align_triples,
    from_three_rays,
    gathered,
)
from mixpose.search.triples import far_apart
from mixpose.sensors import Rays

_AT_ONCE = 40_000  # pairs of rays: their numbers stay in the cache of a processor


class TriangulatedPoints(NamedTuple):
    """Points where a ray of one sensor comes close to a ray of another."""

    points: Floats  # (P, 3) in the world
    tolerance: Floats  # (P,) how far off the point may be, in length units
    gap: Floats  # (P,) distance of the two rays as a share of what the gates allow, 0 to 1
    sensors: Indices  # (P, 2) the two sensors, first before second
    rays: Indices  # (P, 2) the ray of either sensor


def generators_of(problem: SearchProblem) -> list[Guesses]:
    """Ways to make guesses from rays, the quickest first.

    Points in space; one such point and two rays, in crowds at last; three rays of one camera.
    """
    budget, rays = problem.budget, [rays for _, rays in problem.cameras]
    reaches = [problem.reach(sensor) for sensor, _ in problem.cameras]
    generators = [from_three_rays(problem, *pair) for pair in zip(reaches, rays, strict=True)]
    if len(rays) < 2:
        return generators
    points = by_promise(problem, triangulate(rays, reaches, budget))
    crowded = sum(map(len, rays)) > budget.crowded * len(problem.body) * len(rays)
    # of the points tried in a crowd, and of the rays near them, few are right
    place = len(generators) if crowded else 0
    generators.insert(place, from_point_and_rays(problem, points))
    return [from_point_triples(problem, points), *generators]


def triangulate(
    rays: Sequence[Rays], gates: Sequence[float], budget: SearchBudget = THOROUGH
) -> TriangulatedPoints:
    """All pairs of rays of two sensors or more that meet within the error of the detections.

    That is a gate in px, one per sensor, which most are far from erring by: rays that meet more
    closely put a point more exactly.
    """
    meetings = [
        met._replace(sensors=np.broadcast_to([first, second], met.rays.shape))
        for first, second in combinations(range(len(rays)), 2)
        for met in _meetings(rays[first], rays[second], (gates[first], gates[second]), budget)
    ]
    return TriangulatedPoints(*map(np.concatenate, zip(*meetings, strict=True)))


def _meetings(
    a: Rays, b: Rays, gates: tuple[float, float], budget: SearchBudget
) -> Iterator[TriangulatedPoints]:
    """Points where rays of sensors 0 and 1 meet, for some rays of the first after the other.

    Lines a and b pass at |(o_b - o_a) . (d_a x d_b)| / |d_a x d_b|; the numerator is a product of
    their Pluecker coordinates, so that only pairs that meet have to be looked at in space.
    """
    step = max(_AT_ONCE // max(len(b), 1), 1)
    one = np.ones((len(b), 1))
    origins_b = b.origins - a.origins[:1].sum(axis=0)  # near zero, lest products lose digits
    of_b = np.hstack([np.cross(b.directions, origins_b), -b.directions])
    along_b = np.hstack([(origins_b * b.directions).sum(axis=1, keepdims=True), -b.directions])
    for start in range(0, max(len(a), 1), step):
        u = a.directions[start : start + step]
        o = a.origins[start : start + step] - a.origins[:1].sum(axis=0)
        cosine = u @ b.directions.T
        sine2 = np.maximum(1 - cosine**2, 1e-300)
        to_a = np.hstack([u, -(o * u).sum(axis=1, keepdims=True)]) @ np.hstack([origins_b, one]).T
        to_b = np.hstack([np.ones((len(o), 1)), o]) @ along_b.T
        s = (to_a - cosine * to_b) / sine2
        t = (cosine * to_a - to_b) / sine2
        gap = np.abs(np.hstack([u, np.cross(o, u)]) @ of_b.T) / np.sqrt(sine2)
        tolerance = np.hypot(
            gates[0] * (a.offset + a.slope * np.abs(s)), gates[1] * (b.offset + b.slope * np.abs(t))
        )
        good = (gap <= tolerance) & (sine2 > budget.min_sine**2)
        good &= ~((a.central & (s <= 0)) | (b.central & (t <= 0)))
        if a.cloud is not None and a.cloud is b.cloud:  # which belong together is known
            good &= np.eye(len(u), len(b), k=start, dtype=np.bool_)
        pairs, allowed = np.argwhere(good) + np.array([start, 0]), tolerance[good]
        i, j = pairs.T
        on_a = a.origins[i] + s[good][:, None] * a.directions[i]
        on_b = b.origins[j] + t[good][:, None] * b.directions[j]
        apart = gap[good] / allowed
        off = np.clip(budget.by_gap * apart, budget.least_off, 1.0) * allowed / np.sqrt(sine2[good])
        sensors = np.broadcast_to([0, 1], pairs.shape)
        yield TriangulatedPoints((on_a + on_b) / 2, off, apart, sensors, pairs)


def by_promise(problem: SearchProblem, points: TriangulatedPoints) -> TriangulatedPoints:
    """The points that most sensors confirm, the closest first, each place once.

    They are combined in this order (PROSAC, Chum and Matas, CVPR 2005).
    """
    places, most = points.points, problem.budget.max_triples // 40  # the first of forty triples
    first = np.argsort(points.gap, kind="stable")[:most]
    if len(problem.cameras) > 2:  # else every feature is there once
        (support, error), kept = np.zeros((2, len(places))), list[int]()
        for sensor, _ in problem.cameras:
            y, seen = sensor.view.sensor.project(places)
            away, _ = cKDTree(sensor.points).query(y)
            met = seen & (away < problem.reach(sensor))
            support += met
            error[met] += away[met] / problem.reach(sensor)
        left = np.ones(len(places), dtype=np.bool_)
        beside = cKDTree(places).query_ball_point(places, points.tolerance, p=np.inf)
        for k in np.lexsort((error, -support)):
            if left[k] and len(kept) < most:
                kept.append(k)
                left[beside[k]] = False
        first = np.array(kept, dtype=np.intp)
    return TriangulatedPoints._make(array[first] for array in points)


def from_point_triples(problem: SearchProblem, points: TriangulatedPoints) -> Guesses:
    """Poses of triples of points, the most promising first."""
    budget = problem.budget
    triangles = feature_triangles(problem.body, 6 * budget.sample, budget.min_sine)
    for triples in point_triples(problem, points) if len(triangles[0]) else ():
        yield partial(of_triples, problem, points, triangles, triples)


@lru_cache(maxsize=16)
def feature_triangles(body: Body, count: int, min_sine: float) -> tuple[Indices, cKDTree]:
    """Ordered triples (K, 3) of features that span a triangle, and a tree of their sides (K, 3).

    Of `count` features far apart.  Left out are triangles whose height is a smaller share of the
    longest side than `min_sine`, and all but the first of those that symmetries map to each other.
    """
    few = np.sort(far_apart(body.means, count))
    corners = np.stack(np.meshgrid(few, few, few, indexing="ij"), axis=-1).reshape(-1, 3)
    if len(body.symmetries) > 1:
        mapped = transform(body.symmetries, body.means)
        turned = cKDTree(body.means).query(mapped)[1][:, corners]
        numbers = turned @ [len(body) ** 2, len(body), 1]
        corners = corners[numbers[body.identity] == numbers.min(axis=0)]
    sides, is_wide = _sides(body.means, corners, min_sine)
    return corners[is_wide], cKDTree(sides[is_wide].reshape(-1, 3))


def point_triples(problem: SearchProblem, points: TriangulatedPoints) -> Iterator[Indices]:
    """Batches of triples (K, 3) of points that share no ray, the most promising first."""
    rays = points.sensors * (points.rays.max(initial=0) + 1) + points.rays
    # n (n - 1) (n - 2) / 6 triples are `max_triples` or less
    most = int(np.cbrt(6 * problem.budget.max_triples)) + 1
    k, i, j = np.ogrid[(slice(min(len(rays), most)),) * 3]
    triples = np.argwhere((i < j) & (j < k))[:, [1, 2, 0]]
    # as many triangles are alike as `2 * sample` at most; later ones twice as many, up to eight
    size, end = problem.budget.batch // 32, 0
    while end < len(triples):
        start, end = end, end + min(max(end, size), 8 * size)
        batch = triples[start:end]
        six = np.sort(rays[batch].reshape(-1, 6), axis=1)
        yield batch[(np.diff(six, axis=1) > 0).all(axis=1)]


def of_triples(
    problem: SearchProblem,
    points: TriangulatedPoints,
    triangles: tuple[Indices, cKDTree],
    triples: Indices,
) -> Floats:
    """Poses that bring triangles of features onto those of triples (K, 3) of points."""
    budget, body, (corners, tree) = problem.budget, problem.body, triangles
    if not (len(triples) and len(corners)):  # features on a line have no triangles
        return np.zeros((0, 4, 4))
    # of a side between two features that give way
    bent = problem.rules.noise.errors.met * np.sqrt(2) * body.spread
    sides, is_wide = _sides(points.points, triples, budget.min_sine)
    slack = 2 * points.tolerance[triples].max(axis=1) + bent
    possible = is_wide & (sides.max(axis=1) < tree.data.max() + slack)
    triples, sides = triples[possible], sides[possible]
    squares = points.tolerance[triples] ** 2
    allowed = np.sqrt(squares[:, FIRST] + squares[:, SECOND] + bent**2)
    away, index = tree.query(
        sides,
        k=np.arange(1, min(2 * budget.sample, len(corners)) + 1),
        distance_upper_bound=float(allowed.max(initial=0.0)) * np.sqrt(3),
    )
    which, rank = np.nonzero(np.isfinite(away))
    chosen = index[which, rank]
    alike = (np.abs(sides[which] - tree.data[chosen]) <= allowed[which]).all(axis=1)
    features, world = corners[chosen[alike]], triples[which[alike]]
    return align_triples(gathered(body.means, features.T), gathered(points.points, world.T))


def _sides(points: Floats, triples: Indices, min_sine: float) -> tuple[Floats, Mask]:
    """Sides (K, 3) of triangles, and whether their heights are such a share of the longest."""
    sides = np.linalg.norm(points[triples[:, FIRST]] - points[triples[:, SECOND]], axis=2)
    a, b, c = np.sort(sides, axis=1).T
    # Heron's formula; twice the area is height times longest side
    area4 = np.maximum((a + b + c) * (a + b - c) * (a - b + c) * (b + c - a), 0.0)
    return sides, np.sqrt(area4) / 2 > min_sine * c * c


def from_point_and_rays(problem: SearchProblem, points: TriangulatedPoints) -> Guesses:
    """Poses with one point in space as each feature, point by point, the most promising first."""
    for p in range(min(len(points.points), 2 * problem.budget.sample)):
        yield partial(_of_point, problem, points, p)


def _of_point(problem: SearchProblem, points: TriangulatedPoints, p: int) -> Floats:
    """For a point as each feature, where rays cut the spheres on which the others lie."""
    means, budget = problem.body.means, problem.budget
    features = means[far_apart(means, budget.sample)]
    distances = np.linalg.norm(features[:, None] - features, axis=-1)
    origins, directions, across, along, error, start = _rays_near(problem, points, p)
    most, body, world = budget.batch // len(features), [], []
    for i, distance in enumerate(distances):
        half2 = distance**2 - across[:, None] ** 2
        cuts = (half2 >= 0) | (np.abs(across[:, None] - distance) <= error[:, None])
        cuts[:, i] = False
        half = np.sqrt(np.maximum(half2[cuts], 0.0))
        ray, feature = np.tile(np.nonzero(cuts), 2)
        depth = along[ray] + np.concatenate([half, np.where(half > 0, -half, -np.inf)])
        ahead = depth > start[ray]
        ray, feature, depth = ray[ahead], feature[ahead], depth[ahead]
        places = origins[ray] + depth[:, None] * directions[ray]
        off = np.abs(cdist(places, places) - distances[np.ix_(feature, feature)])
        allowed = np.sqrt(0.5) * error[ray]
        a, b = np.nonzero(off <= allowed + allowed[:, None])
        apart = (a < b) & (ray[a] != ray[b]) & (feature[a] != feature[b])
        a, b = a[apart], b[apart]
        best = np.argsort(off[a, b], kind="stable")[:most]
        a, b = a[best], b[best]
        body.append(features[np.stack([np.full(len(a), i), feature[a], feature[b]])])
        world.append(np.stack([np.full((len(a), 3), points.points[p]), places[a], places[b]]))
    return align_triples(*(np.concatenate(one, axis=1).swapaxes(1, 2) for one in (body, world)))


def _rays_near(problem: SearchProblem, points: TriangulatedPoints, p: int) -> tuple[Floats, ...]:
    """Rays that pass nearest to a point, without those that made it.

    Origins (R, 3), directions (R, 3), distances of the point across and along them, by how much a
    place on them may be off, and where they start (R,).
    """
    parts = []
    for k, (sensor, rays) in enumerate(problem.cameras):
        rest = rays.select(np.delete(np.arange(len(rays)), points.rays[p, points.sensors[p] == k]))
        away = points.points[p] - rest.origins
        along = (away * rest.directions).sum(axis=1)
        across = np.linalg.norm(away - along[:, None] * rest.directions, axis=1)
        error = np.hypot(
            problem.reach(sensor) * (rest.offset + rest.slope * np.abs(along)), points.tolerance[p]
        )
        start = np.full(len(rest), 0.0 if rest.central else -np.inf)
        parts.append((rest.origins, rest.directions, across, along, error, start))
    columns = [np.concatenate(column) for column in zip(*parts, strict=True)]
    nearest = np.argsort(columns[2], kind="stable")[: 3 * problem.budget.sample]
    return tuple(column[nearest] for column in columns)
