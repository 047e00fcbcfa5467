"""Order the pairings of three detections of one camera with three features of the body.

Where there are few, all are tried; else those that lead soonest to a pose, or fix it best.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache
from itertools import combinations, permutations
from math import comb, perm

import numpy as np

from mixpose.body import Body
from mixpose.records import Floats, Indices
from mixpose.search.problem import SearchProblem, is_pointlike
from mixpose.sensors import Rays

_FACING, _SIDE = 0.5, 0.9  # least cosines of normals seen together, and of normals of one side
_TURNED_AWAY = -0.99  # cosine of normals: a camera sees both only within 4° of their faces' planes
_ORDERS = list(permutations(range(3)))


def ray_triples(problem: SearchProblem, rays: Rays) -> Iterator[tuple[Indices, Indices]]:
    """Yield batches of three detections (3, K) to be taken as three features (3, K).

    All are tried if they are few enough.  Else, unless most detections are false, the first are
    neighbours as neighbours, which are soon right, and detections far apart as features of a side
    far apart, which fix a pose best; then random detections near each other as such features.
    """
    budget, body, cameras = problem.budget, problem.body, len(problem.cameras)
    rng, n, M = np.random.default_rng(problem.seed), len(body), len(rays)
    batch, limit = budget.batch, budget.max_problems
    if cameras > 1:  # a hit of one camera is enough; half as many would miss 1 body in 24
        limit //= 4 * cameras
    if comb(M, 3) * perm(n, 3) <= limit:
        yield from _shuffled(_triples(np.arange(M)), _seen_together(body), limit, batch, rng)
        return
    if budget.crowded * n >= M:  # in a crowd the outermost detections are not the body's
        limit //= 4
        near = _neighbour_triples(rays.pixels), _neighbour_features(body)
        outer = far_apart(rays.pixels, 3 * budget.sample // 2)
        for detections, corners in (near, (_triples(outer), _far_features(body, budget.sample))):
            yield from _shuffled(detections, corners, limit, batch, rng)
        limit *= 2
    # by point, the indices of all points from the nearest to the farthest
    near_rays, near_features = (
        np.argsort(np.linalg.norm(p[:, None] - p, axis=2), axis=1)
        for p in (rays.pixels, body.means)
    )
    # the size of the body in the image is unknown, so that crowds vary
    crowds = [budget.sample, 2 * budget.sample, 4 * budget.sample, M]
    for k in range(limit // batch):
        crowd = crowds[k % len(crowds)]
        few = min(max(crowd // 2, 3), n)
        yield _draw(near_rays, min(crowd, M), batch, rng), _draw(near_features, few, batch, rng)


def _shuffled(
    detections: Indices, corners: Indices, limit: int, batch: int, rng: np.random.Generator
) -> Iterator[tuple[Indices, Indices]]:
    """Yield batches of detections (3, C) with corners (3, P), `limit` at most, in random order."""
    order = rng.permutation(detections.shape[1] * corners.shape[1])[:limit]
    for start in range(0, len(order), batch):
        a, b = np.divmod(order[start : start + batch], corners.shape[1])
        yield detections[:, a], corners[:, b]


def _triples(numbers: Indices) -> Indices:
    """Return all triples (3, K) of numbers, in their order."""
    return np.array(list(combinations(numbers.tolist(), 3)), dtype=np.intp).reshape(-1, 3).T


def _in_all_orders(triples: Indices) -> Indices:
    """Return triples (3, K) in all orders of their numbers, (3, 6 K) at most, without repeats."""
    return np.unique(np.concatenate([triples[list(order)] for order in _ORDERS], axis=1), axis=1)


def _neighbour_triples(points: Floats) -> Indices:
    """Return triples (3, K) of points (n, d): every point with two of the three nearest to it."""
    distances = np.linalg.norm(points[:, None] - points, axis=2)
    nearest = np.argsort(distances, axis=1, kind="stable")[:, :4]
    pairs = combinations(range(1, nearest.shape[1]), 2)
    triples = np.concatenate([nearest[:, [0, *pair]] for pair in pairs])
    return np.unique(np.sort(triples, axis=1), axis=0).T


@lru_cache(maxsize=32)
def _neighbour_features(body: Body) -> Indices:
    """Return the `_neighbour_triples` (3, P) of the features of each side, in all orders."""
    sides = [side for side in _sides(body) if len(side) > 2]
    triples = [side[_neighbour_triples(body.means[side])] for side in sides]
    return _in_all_orders(np.concatenate([np.zeros((3, 0), dtype=np.intp), *triples], axis=1))


@lru_cache(maxsize=32)
def _far_features(body: Body, count: int) -> Indices:
    """Return triples (3, P), in all orders, of `count` features far apart on each side."""
    selected = [side[far_apart(body.means[side], count)] for side in _sides(body)]
    # sides with less than three features have no triples
    return _in_all_orders(np.concatenate([_triples(np.sort(side)) for side in selected], axis=1))


@lru_cache(maxsize=32)
def _seen_together(body: Body) -> Indices:
    """Return triples (3, P), in all orders, without two features that no camera sees together.

    Such features face away from each other, and neither is in front of the other's face.
    """
    triples = _triples(np.arange(len(body)))
    if body.normals is not None:
        turned_away = body.normals @ body.normals.T < _TURNED_AWAY
        arms = body.means - body.means[:, None]
        behind = np.vecdot(arms, body.normals[:, None]) <= 0
        is_unseen = turned_away & behind & behind.T
        pairs = combinations(triples, 2)
        triples = triples[:, ~np.any([is_unseen[a, b] for a, b in pairs], axis=0)]
    return _in_all_orders(triples)


def far_apart(points: Floats, count: int) -> Indices:
    """Return indices of points that are far from one another, beginning with the outermost."""
    distance, chosen = np.linalg.norm(points - points.mean(axis=0), axis=1), list[int]()
    for k in range(min(count, len(points))):
        chosen.append(int(distance.argmax()))
        from_last = np.linalg.norm(points - points[chosen[-1]], axis=1)
        distance = np.minimum(distance, from_last) if k else from_last
    return np.array(chosen)


@lru_cache(maxsize=32)
def thinned(body: Body, count: int) -> Body:
    """Return the body with only `count` of its features, far from one another; itself if fewer."""
    if len(body) <= count or not is_pointlike(body):
        return body
    selected = far_apart(body.means, count)
    normals = None if body.normals is None else body.normals[selected]
    return Body(body.name, tuple(body.features[k] for k in selected), normals, body.gravity)


@lru_cache(maxsize=32)
def _sides(body: Body) -> list[Indices]:
    """Group the features into sides, which face about the same way; all are on at least one."""
    if body.normals is None:
        return [np.arange(len(body))]
    cosines, sides = body.normals @ body.normals.T, list[Indices]()
    is_unassigned = np.ones(len(body), dtype=np.bool_)
    while is_unassigned.any():
        cosine = cosines[is_unassigned.argmax()]
        sides.append(np.flatnonzero(cosine > _FACING))
        is_unassigned &= cosine < _SIDE
    return sides


def _draw(nearest: Indices, crowd: int, count: int, rng: np.random.Generator) -> Indices:
    """Draw random triples (3, count): a point, and two of the `crowd - 1` nearest to it."""
    first = rng.integers(0, len(nearest), count)
    # the two lowest of random numbers, by a partition: sorting thousands would take most time
    chosen = np.argpartition(rng.random((count, crowd - 1)), 1, axis=1)[:, :2].T + 1
    return np.stack([first, *nearest[first, chosen]])
