"""Guesses of one camera: three detections as three features, in all ways or many of them."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from itertools import combinations, permutations
from math import comb, perm
from typing import TypeAlias

import numpy as np

from mixpose.records import Floats, Indices
from mixpose.search.problem import Generator, SearchProblem
from mixpose.search.spread import far_apart
from mixpose.search.three_points import FIRST, SECOND, align_triples, depths, gathered
from mixpose.sensors import Rays

Triples: TypeAlias = tuple[Indices, Indices]  # (3, K) detections, and the features they may be


def from_three_rays(problem: SearchProblem, reach: float, rays: Rays) -> Generator:
    """Poses from triples of one camera's rays, whose detections err by `reach` px at most."""
    solve = _perspective if rays.central else _orthographic
    chunks = _problems(problem, rays) if min(len(rays), len(problem.body)) > 2 else []
    return Generator("three rays", chunks, partial(solve, problem.body.means, reach, rays))


def _problems(problem: SearchProblem, rays: Rays) -> Iterator[Triples]:
    """Chunks of problems: three detections (3, K) as three features (3, K).

    All, where they can be tried; else of detections and features those far apart first, which
    fix a pose best, unless most detections are false: the outermost are the body's no more.  Then
    near detections as features that are near each other, at random.
    """
    budget, features = problem.budget, problem.body.means
    rng = np.random.default_rng(problem.seed)
    n, M, batch = len(features), len(rays), budget.batch
    most = budget.problems_for(len(problem.cameras))
    all_tried = comb(M, 3) * perm(n, 3) <= most
    if all_tried or budget.crowded * n >= M:
        detections, corners = np.arange(M), np.arange(n)
        if not all_tried:
            most //= 2
            detections = far_apart(rays.pixels, 3 * budget.sample // 2)
            corners = far_apart(features, budget.sample)
        by_detection = np.array(list(combinations(detections, 3)), dtype=np.intp).T
        by_feature = np.array(list(permutations(corners, 3)), dtype=np.intp).T
        order = rng.permutation(by_detection.shape[1] * by_feature.shape[1])[:most]
        for start in range(0, len(order), batch):
            a, b = np.divmod(order[start : start + batch], by_feature.shape[1])
            yield by_detection[:, a], by_feature[:, b]
    if all_tried:
        return
    near_rays, near_features = _nearest(rays.pixels), _nearest(features)
    # a body is seen in one place, larger or smaller
    crowds = (*(budget.sample * np.array([1, 2, 4])).tolist(), M)
    for k in range(most // batch):
        crowd = crowds[k % len(crowds)]
        yield (
            _drawn(near_rays, min(crowd, M), batch, rng),
            _drawn(near_features, min(max(crowd // 2, 3), n), batch, rng),
        )


def _nearest(points: Floats) -> Indices:
    """Indices (n, n) of points, from each of them to its farthest."""
    return np.argsort(np.linalg.norm(points[:, None] - points, axis=2), axis=1)


def _drawn(nearest: Indices, crowd: int, count: int, rng: np.random.Generator) -> Indices:
    """Random triples (3, count): a point, and two of the `crowd - 1` nearest to it."""
    first = rng.integers(0, len(nearest), count)
    chosen = np.argsort(rng.random((count, crowd - 1)), axis=1)[:, :2].T + 1
    return np.stack([first, *nearest[first, chosen]])


def _perspective(features: Floats, reach: float, rays: Rays, triples: Triples) -> Floats:
    """Rays that meet in one centre."""
    detections, corners = triples
    distance2 = ((features[:, None] - features) ** 2).sum(axis=-1)
    between = rays.directions @ rays.directions.T
    cosines = between[detections[FIRST], detections[SECOND]]
    squared = distance2[corners[FIRST], corners[SECOND]]
    distances, which = depths(cosines, squared)
    # smaller than the error in the image, nothing is told apart
    largest = np.sqrt(squared.max(axis=0))[which]
    near = largest > reach * rays.slope * distances.min(axis=0)
    distances, which = distances[:, near], which[near]
    directions = gathered(rays.directions, detections[:, which])
    world = rays.origins[0][:, None] + directions * distances[:, None]
    return align_triples(gathered(features, corners[:, which]), world)


def _orthographic(features: Floats, reach: float, rays: Rays, triples: Triples) -> Floats:
    """Three parallel rays: the sides' lengths give depth differences, which must add up.

    The depth of the whole is not seen; the middle is put on the sensor's plane.
    """
    detections, corners = triples
    body, seen = gathered(features, corners), gathered(rays.origins, detections)
    tolerance = 2 * reach * rays.offset
    length, flat = (np.linalg.norm(p[SECOND] - p[FIRST], axis=1) for p in (body, seen))
    rise = np.sqrt(np.maximum(length**2 - flat**2, 0.0))
    rise[flat > length + tolerance] = np.nan
    direction = rays.directions[0][:, None]
    poses = []
    for sign in (1.0, -1.0):
        good = np.abs(np.abs(rise[1] - sign * rise[0]) - rise[2]) <= tolerance
        for mirror in (1.0, -1.0):
            depth = mirror * np.array([0 * rise[0], sign * rise[0], rise[1]])[:, None, good]
            world = seen[..., good] + (depth - depth.mean(axis=0)) * direction
            poses.append(align_triples(body[..., good], world))
    return np.concatenate(poses)
