"""Make guesses from several cameras: points where their rays meet are taken as features.

Three points are matched with triangles of features by the lengths of their sides.  Where cameras
see different features, few points are known: a feature at a known distance from one of them lies
where its ray cuts a sphere, and two such features must be as far apart as they are on the body.
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
from mixpose.rigid import cross, transform
from mixpose.search.problem import THOROUGH, SearchBudget, SearchProblem
from mixpose.search.three_points import (
    FIRST,
    SECOND,
    Guesses,
    align_triples,
    corners_of,
    from_three_rays,
)
from mixpose.search.triples import far_apart
from mixpose.sensors import Rays

_AT_ONCE = 40_000  # pairs of rays: their numbers stay in the cache


class TriangulatedPoints(NamedTuple):
    """Points where a ray of one sensor comes close to a ray of another."""

    points: Floats  # (P, 3) in the world
    tolerance: Floats  # (P,) largest error of the point, length units
    gap: Floats  # (P,) distance between the two rays as a share of what the gates allow, 0 to 1
    sensors: Indices  # (P, 2) the two sensors, ascending
    rays: Indices  # (P, 2) the ray of each of the two


def generators_of(problem: SearchProblem) -> list[Guesses]:
    """Return the generators of guesses from rays, the quickest first.

    Triples of points in space; a point and two rays, or in crowds last; three rays of one camera.
    """
    budget, rays = problem.budget, [rays for _, rays in problem.cameras]
    reaches = [problem.reach(sensor) for sensor, _ in problem.cameras]
    generators = [from_three_rays(problem, *pair) for pair in zip(reaches, rays, strict=True)]
    if len(rays) < 2:
        return generators
    points = sort_by_support(problem, triangulate(rays, reaches, budget))
    crowded = sum(map(len, rays)) > budget.crowded * len(problem.body) * len(rays)
    # in a crowd few of the points tried, and of the rays near them, are right
    place = len(generators) if crowded else 0
    generators.insert(place, from_point_and_rays(problem, points))
    return [from_point_triples(problem, points), *generators]


def triangulate(
    rays: Sequence[Rays], gates: Sequence[float], budget: SearchBudget = THOROUGH
) -> TriangulatedPoints:
    """Return a point for each pair of rays of two sensors that meet within the detections' errors.

    `gates` are the largest errors in px, one per sensor.  Most errors are far smaller, so that the
    error of a point is estimated by the gap between its rays.
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
    """Yield points where rays of sensors 0 and 1 meet, in chunks of the rays of the first.

    The distance of lines a and b is |(o_b - o_a) . (d_a x d_b)| / |d_a x d_b|; the numerator is a
    product of their Pluecker coordinates, so that points are computed only of pairs that meet.
    """
    step = max(_AT_ONCE // max(len(b), 1), 1)
    ones = np.ones((len(b), 1))
    origins_b = b.origins - a.origins[:1].sum(axis=0)  # near zero, as products would lose digits
    moments_b = np.hstack([cross(b.directions.T, origins_b.T).T, -b.directions])
    along_b = np.hstack([(origins_b * b.directions).sum(axis=1, keepdims=True), -b.directions])
    for start in range(0, max(len(a), 1), step):
        u = a.directions[start : start + step]
        o = a.origins[start : start + step] - a.origins[:1].sum(axis=0)
        cosine = u @ b.directions.T
        sine2 = np.maximum(1 - cosine**2, 1e-300)
        to_a = np.hstack([u, -(o * u).sum(axis=1, keepdims=True)]) @ np.hstack([origins_b, ones]).T
        to_b = np.hstack([np.ones((len(o), 1)), o]) @ along_b.T
        s = (to_a - cosine * to_b) / sine2
        t = (cosine * to_a - to_b) / sine2
        gap = np.abs(np.hstack([u, cross(o.T, u.T).T]) @ moments_b.T) / np.sqrt(sine2)
        tolerance = np.hypot(
            gates[0] * (a.offset + a.slope * np.abs(s)), gates[1] * (b.offset + b.slope * np.abs(t))
        )
        good = (gap <= tolerance) & (sine2 > budget.min_sine**2)
        good &= ~((a.central & (s <= 0)) | (b.central & (t <= 0)))
        if a.cloud is not None and a.cloud is b.cloud:  # rays of one cloud point are known pairs
            good &= np.eye(len(u), len(b), k=start, dtype=np.bool_)
        pairs, allowed = np.argwhere(good) + np.array([start, 0]), tolerance[good]
        i, j = pairs.T
        on_a = a.origins[i] + s[good][:, None] * a.directions[i]
        on_b = b.origins[j] + t[good][:, None] * b.directions[j]
        share = gap[good] / allowed
        off = np.clip(budget.by_gap * share, budget.least_off, 1.0) * allowed / np.sqrt(sine2[good])
        sensors = np.broadcast_to([0, 1], pairs.shape)
        yield TriangulatedPoints((on_a + on_b) / 2, off, share, sensors, pairs)


def sort_by_support(problem: SearchProblem, points: TriangulatedPoints) -> TriangulatedPoints:
    """Sort points by the number of sensors that confirm them, then by errors; drop duplicates.

    Guesses combine them in this order (PROSAC, Chum and Matas, CVPR 2005).
    """
    places, most = points.points, problem.budget.max_triples // 40  # one of 40 triples
    first = np.argsort(points.gap, kind="stable")[:most]
    if len(problem.cameras) > 2:  # two cameras give no duplicates
        (support, error), chosen = np.zeros((2, len(places))), list[int]()
        for sensor, _ in problem.cameras:
            y, seen = sensor.view.sensor.project(places)
            distances, _ = cKDTree(sensor.points).query(y)
            is_met = seen & (distances < problem.reach(sensor))
            support += is_met
            error[is_met] += distances[is_met] / problem.reach(sensor)
        is_unused = np.ones(len(places), dtype=np.bool_)
        duplicates = cKDTree(places).query_ball_point(places, points.tolerance, p=np.inf)
        for k in np.lexsort((error, -support)):
            if is_unused[k] and len(chosen) < most:
                chosen.append(k)
                is_unused[duplicates[k]] = False
        first = np.array(chosen, dtype=np.intp)
    return TriangulatedPoints._make(array[first] for array in points)


def from_point_triples(problem: SearchProblem, points: TriangulatedPoints) -> Guesses:
    """Yield batches of poses from triples of points, the most promising first."""
    budget = problem.budget
    triangles = feature_triangles(problem.body, 6 * budget.sample, budget.min_sine)
    for triples in point_triples(problem, points) if len(triangles[0]) else ():
        yield partial(poses_of_triples, problem, points, triangles, triples)


@lru_cache(maxsize=16)
def feature_triangles(body: Body, count: int, min_sine: float) -> tuple[Indices, cKDTree]:
    """Return ordered triples (K, 3) of features that span a triangle, and a tree of their sides.

    They are of `count` features far apart.  Left out are triangles of less height over longest
    side than `min_sine`, and all but the first of those that symmetries map to each other.
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
    """Yield batches of triples (K, 3) of points that share no ray, the most promising first."""
    rays = points.sensors * (points.rays.max(initial=0) + 1) + points.rays
    # so that n (n - 1) (n - 2) / 6 triples are about `max_triples`
    limit = int(np.cbrt(6 * problem.budget.max_triples)) + 1
    k, i, j = np.ogrid[(slice(min(len(rays), limit)),) * 3]
    triples = np.argwhere((i < j) & (j < k))[:, [1, 2, 0]]
    # each triple leads to `2 * sample` triangles at most; batches grow to eight times the first
    size, end = problem.budget.batch // 32, 0
    while end < len(triples):
        start, end = end, end + min(max(end, size), 8 * size)
        batch = triples[start:end]
        six = np.sort(rays[batch].reshape(-1, 6), axis=1)
        yield batch[(np.diff(six, axis=1) > 0).all(axis=1)]


def poses_of_triples(
    problem: SearchProblem,
    points: TriangulatedPoints,
    triangles: tuple[Indices, cKDTree],
    triples: Indices,
) -> Floats:
    """Return poses that bring triangles of features onto those of triples (K, 3) of points."""
    budget, body, (corners, tree) = problem.budget, problem.body, triangles
    if not (len(triples) and len(corners)):  # features on a line have no triangles
        return np.zeros((0, 4, 4))
    # error of a side between two features that give way
    bending = problem.rules.noise.errors.met * np.sqrt(2) * body.spread
    sides, is_wide = _sides(points.points, triples, budget.min_sine)
    slack = 2 * points.tolerance[triples].max(axis=1) + bending
    is_possible = is_wide & (sides.max(axis=1) < tree.data.max() + slack)
    triples, sides = triples[is_possible], sides[is_possible]
    squares = points.tolerance[triples] ** 2
    allowed = np.sqrt(squares[:, FIRST] + squares[:, SECOND] + bending**2)
    distances, index = tree.query(
        sides,
        k=np.arange(1, min(2 * budget.sample, len(corners)) + 1),
        distance_upper_bound=float(allowed.max(initial=0.0)) * np.sqrt(3),
    )
    which, rank = np.nonzero(np.isfinite(distances))
    chosen = index[which, rank]
    is_alike = (np.abs(sides[which] - tree.data[chosen]) <= allowed[which]).all(axis=1)
    features, world = corners[chosen[is_alike]], triples[which[is_alike]]
    return align_triples(corners_of(body.means, features.T), corners_of(points.points, world.T))


def _sides(points: Floats, triples: Indices, min_sine: float) -> tuple[Floats, Mask]:
    """Return sides (K, 3) of triangles, and whether height over longest side exceeds `min_sine`."""
    sides = np.linalg.norm(points[triples[:, FIRST]] - points[triples[:, SECOND]], axis=2)
    a, b, c = np.sort(sides, axis=1).T
    # Heron's formula; twice the area is height times longest side
    area4 = np.maximum((a + b + c) * (a + b - c) * (a - b + c) * (b + c - a), 0.0)
    return sides, np.sqrt(area4) / 2 > min_sine * c * c


def from_point_and_rays(problem: SearchProblem, points: TriangulatedPoints) -> Guesses:
    """Yield batches of poses with one point in space as a feature, the most promising first."""
    for p in range(min(len(points.points), 2 * problem.budget.sample)):
        yield partial(_poses_of_point, problem, points, p)


def _poses_of_point(problem: SearchProblem, points: TriangulatedPoints, p: int) -> Floats:
    """Return poses with a point as each feature and two others where rays cut their spheres."""
    means, budget = problem.body.means, problem.budget
    features = means[far_apart(means, budget.sample)]
    distances = np.linalg.norm(features[:, None] - features, axis=-1)
    origins, directions, across, along, error, start = _rays_near(problem, points, p)
    limit, body, world = budget.batch // len(features), [], []
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
        errors = np.abs(cdist(places, places) - distances[np.ix_(feature, feature)])
        allowed = np.sqrt(0.5) * error[ray]
        a, b = np.nonzero(errors <= allowed + allowed[:, None])
        is_distinct = (a < b) & (ray[a] != ray[b]) & (feature[a] != feature[b])
        a, b = a[is_distinct], b[is_distinct]
        best = np.argsort(errors[a, b], kind="stable")[:limit]
        a, b = a[best], b[best]
        body.append(features[np.stack([np.full(len(a), i), feature[a], feature[b]])])
        world.append(np.stack([np.full((len(a), 3), points.points[p]), places[a], places[b]]))
    return align_triples(*(np.concatenate(parts, axis=1).swapaxes(1, 2) for parts in (body, world)))


def _rays_near(problem: SearchProblem, points: TriangulatedPoints, p: int) -> tuple[Floats, ...]:
    """Return the rays that pass nearest to a point, without those that made it.

    The arrays are origins (R, 3), directions (R, 3), and (R,) each: distances of the point across
    and along the ray, the largest error of a place on it, and where it starts.
    """
    parts = []
    for k, (sensor, rays) in enumerate(problem.cameras):
        made_by = points.rays[p, points.sensors[p] == k]
        other = rays.select(np.delete(np.arange(len(rays)), made_by))
        arm = points.points[p] - other.origins
        along = (arm * other.directions).sum(axis=1)
        across = np.linalg.norm(arm - along[:, None] * other.directions, axis=1)
        error = np.hypot(
            problem.reach(sensor) * (other.offset + other.slope * abs(along)), points.tolerance[p]
        )
        start = np.full(len(other), 0.0 if other.central else -np.inf)
        parts.append((other.origins, other.directions, across, along, error, start))
    columns = [np.concatenate(column) for column in zip(*parts, strict=True)]
    nearest = np.argsort(columns[2], kind="stable")[: 3 * problem.budget.sample]
    return tuple(column[nearest] for column in columns)
