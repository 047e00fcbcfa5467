"""Which three detections of a camera are tried as which three features, and in what order.

All, where there are few of both; else those that lead soonest to a pose, or fix it best.
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

_FACING, _SIDE = 0.5, 0.9  # cosines of normals that are seen together, and of one side
_TURNED_AWAY = -0.99  # cosine of normals: a camera sees both within 4° from along their faces
_ORDERS = list(permutations(range(3)))


def ray_triples(problem: SearchProblem, rays: Rays) -> Iterator[tuple[Indices, Indices]]:
    """Batches of problems: three detections (3, K) as three features (3, K).

    All, where they can be tried.  Else, unless most detections are false, neighbours as neighbours,
    which are soon the right ones, and those far apart of detections and of a side, which fix a pose
    best; then near detections as features that are near each other, at random.
    """
    budget, body, cameras = problem.budget, problem.body, len(problem.cameras)
    rng, n, M = np.random.default_rng(problem.seed), len(body), len(rays)
    batch, most = budget.batch, budget.max_problems
    if cameras > 1:  # a hit of one is enough: of half as many, one of two misses 1 body in 24
        most //= 4 * cameras
    if comb(M, 3) * perm(n, 3) <= most:
        yield from _shuffled(_combined(np.arange(M)), _seen_together(body), most, batch, rng)
        return
    if budget.crowded * n >= M:  # else the outermost are the body's no more
        most //= 4
        near = _neighbours(rays.pixels), _neighbouring(body)
        outer = far_apart(rays.pixels, 3 * budget.sample // 2)
        for detections, corners in (near, (_combined(outer), _of_sides(body, budget.sample))):
            yield from _shuffled(detections, corners, most, batch, rng)
        most *= 2
    # indices of points, from each of them to its farthest
    near_rays, near_features = (
        np.argsort(np.linalg.norm(p[:, None] - p, axis=2), axis=1)
        for p in (rays.pixels, body.means)
    )
    # a body is seen in one place, larger or smaller
    crowds = [budget.sample, 2 * budget.sample, 4 * budget.sample, M]
    for k in range(most // batch):
        crowd = crowds[k % len(crowds)]
        few = min(max(crowd // 2, 3), n)
        yield _drawn(near_rays, min(crowd, M), batch, rng), _drawn(near_features, few, batch, rng)


def _shuffled(
    detections: Indices, corners: Indices, most: int, batch: int, rng: np.random.Generator
) -> Iterator[tuple[Indices, Indices]]:
    """Batches of detections (3, C) as corners (3, P), so many at most, in a random order."""
    order = rng.permutation(detections.shape[1] * corners.shape[1])[:most]
    for start in range(0, len(order), batch):
        a, b = np.divmod(order[start : start + batch], corners.shape[1])
        yield detections[:, a], corners[:, b]


def _combined(some: Indices) -> Indices:
    """Triples (3, K) of some numbers, in their order."""
    return np.array(list(combinations(some.tolist(), 3)), dtype=np.intp).reshape(-1, 3).T


def _in_all_orders(triples: Indices) -> Indices:
    """Triples (3, 6 K) with the numbers of each (3, K) in all orders, each of them once."""
    return np.unique(np.concatenate([triples[list(order)] for order in _ORDERS], axis=1), axis=1)


def _neighbours(points: Floats) -> Indices:
    """Triples (3, K) of points (n, d): each of them with two of the three nearest to it."""
    away = np.linalg.norm(points[:, None] - points, axis=2)
    nearest = np.argsort(away, axis=1, kind="stable")[:, :4]
    pairs = combinations(range(1, nearest.shape[1]), 2)
    each = np.concatenate([nearest[:, [0, *pair]] for pair in pairs])
    return np.unique(np.sort(each, axis=1), axis=0).T


@lru_cache(maxsize=32)
def _neighbouring(body: Body) -> Indices:
    """Triples (3, P), in all orders, of features of a side, each with two of the three nearest."""
    sides = [side for side in _sides(body) if len(side) > 2]
    own = [side[_neighbours(body.means[side])] for side in sides]
    return _in_all_orders(np.concatenate([np.zeros((3, 0), dtype=np.intp), *own], axis=1))


@lru_cache(maxsize=32)
def _of_sides(body: Body, count: int) -> Indices:
    """Triples (3, P), in all orders, of `count` features of each side that are far apart."""
    few = [side[far_apart(body.means[side], count)] for side in _sides(body)]
    # of sides with less than three features there are none
    return _in_all_orders(np.concatenate([_combined(np.sort(side)) for side in few], axis=1))


@lru_cache(maxsize=32)
def _seen_together(body: Body) -> Indices:
    """Triples (3, P), in all orders, of all features but those that no camera sees together.

    These face away from each other, and neither is in front of the other's face.
    """
    triples = _combined(np.arange(len(body)))
    if body.normals is not None:
        turned_away = body.normals @ body.normals.T < _TURNED_AWAY
        away = body.means - body.means[:, None]
        behind = np.vecdot(away, body.normals[:, None]) <= 0
        apart = turned_away & behind & behind.T
        pairs = combinations(triples, 2)
        triples = triples[:, ~np.any([apart[a, b] for a, b in pairs], axis=0)]
    return _in_all_orders(triples)


def far_apart(points: Floats, count: int) -> Indices:
    """Indices of points that are far from one another, starting at the outermost."""
    distance, chosen = np.linalg.norm(points - points.mean(axis=0), axis=1), list[int]()
    for k in range(min(count, len(points))):
        chosen.append(int(distance.argmax()))
        from_last = np.linalg.norm(points - points[chosen[-1]], axis=1)
        distance = np.minimum(distance, from_last) if k else from_last
    return np.array(chosen)


@lru_cache(maxsize=32)
def sparse(body: Body, count: int) -> Body:
    """A body with `count` of its features, far from one another; itself where it has no more."""
    if len(body) <= count or not is_pointlike(body):
        return body
    few = far_apart(body.means, count)
    normals = None if body.normals is None else body.normals[few]
    return Body(body.name, tuple(body.features[k] for k in few), normals, body.gravity)


@lru_cache(maxsize=32)
def _sides(body: Body) -> list[Indices]:
    """Features that face about the same way as one of them, until each is among those of a side."""
    if body.normals is None:
        return [np.arange(len(body))]
    cosines, sides = body.normals @ body.normals.T, list[Indices]()
    left = np.ones(len(body), dtype=np.bool_)
    while left.any():
        own = cosines[left.argmax()]
        sides.append(np.flatnonzero(own > _FACING))
        left &= own < _SIDE
    return sides


def _drawn(nearest: Indices, crowd: int, count: int, rng: np.random.Generator) -> Indices:
    """Random triples (3, count): a point, and two of the `crowd - 1` nearest to it."""
    first = rng.integers(0, len(nearest), count)
    # the two that are drawn lowest: among thousands, to sort them all is most of a search
    chosen = np.argpartition(rng.random((count, crowd - 1)), 1, axis=1)[:, :2].T + 1
    return np.stack([first, *nearest[first, chosen]])
