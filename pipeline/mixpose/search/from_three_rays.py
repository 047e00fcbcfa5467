"""Guesses of one camera: three detections as three features, in all ways or many of them."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import combinations, islice, permutations
from math import comb, perm
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from mixpose.search.alignment import align_triples
from mixpose.search.budget import SearchBudget
from mixpose.search.p3p import SIDES, depths
from mixpose.search.spread import far_apart
from mixpose.sensors import Rays

Floats: TypeAlias = NDArray[np.float64]
Indices: TypeAlias = NDArray[np.intp]


def from_three_rays(
    rays: Rays,
    features: Floats,
    most: int,
    budget: SearchBudget,
    rng: np.random.Generator,
    skipped: int = 0,
) -> Iterator[Floats]:
    """Poses (K, 4, 4) from triples of one camera's rays, chunk by chunk.

    Parameters
    ----------
    rays : Rays
    features : (n, 3) array
        Of the body.
    most : int
        Problems solved.
    budget : SearchBudget
    rng : numpy Generator
        Order of the triples.
    skipped : int
        Chunks left out, as they were tried before.
    """
    if len(rays) < 3 or len(features) < 3:
        return
    solve = _perspective if rays.central else _orthographic
    for detections, corners in islice(_problems(rays, features, most, budget, rng), skipped, None):
        yield solve(rays, features, detections, corners, budget.min_pixels)


def _problems(
    rays: Rays, features: Floats, most: int, budget: SearchBudget, rng: np.random.Generator
) -> Iterator[tuple[Indices, Indices]]:
    """Chunks of problems: three detections (3, K) as three features (3, K).

    All, where they can be tried; else of detections and features those far apart first, which
    fix a pose best, unless most detections are false: the outermost are the body's no more.  Then
    near detections as features that are near each other, at random.
    """
    n, M = len(features), len(rays)
    if comb(M, 3) * perm(n, 3) <= most:
        yield from _all_problems(np.arange(M), np.arange(n), most, budget, rng)
        return
    if budget.crowded * n >= M:
        most //= 2
        spread_rays = far_apart(rays.pixels, int(1.5 * budget.exhaustive))
        yield from _all_problems(
            spread_rays, far_apart(features, budget.exhaustive), most, budget, rng
        )
    near_rays, near_features = _nearest(rays.pixels), _nearest(features)
    for k in range(most // budget.chunk):
        crowd = (*budget.crowds, M)[k % (len(budget.crowds) + 1)]
        yield (
            _drawn(near_rays, min(crowd, M), budget.chunk, rng),
            _drawn(near_features, min(max(crowd // 2, 3), n), budget.chunk, rng),
        )


def _all_problems(
    detections: Indices,
    features: Indices,
    most: int,
    budget: SearchBudget,
    rng: np.random.Generator,
) -> Iterator[tuple[Indices, Indices]]:
    by_detection = np.array(list(combinations(detections, 3)), dtype=np.intp).T
    by_feature = np.array(list(permutations(features, 3)), dtype=np.intp).T
    total = by_detection.shape[1] * by_feature.shape[1]
    order = rng.permutation(total)[:most]
    for start in range(0, len(order), budget.chunk):
        a, b = np.divmod(order[start : start + budget.chunk], by_feature.shape[1])
        yield by_detection[:, a], by_feature[:, b]


def _nearest(points: Floats) -> Indices:
    """Indices (n, n) of points, from each of them to its farthest."""
    return np.argsort(np.linalg.norm(points[:, None] - points, axis=2), axis=1)


def _drawn(nearest: Indices, crowd: int, count: int, rng: np.random.Generator) -> Indices:
    """Random triples (3, count): a point, and two of the `crowd - 1` nearest to it."""
    first = rng.integers(0, len(nearest), count)
    chosen = np.argsort(rng.random((count, crowd - 1)), axis=1)[:, :2].T + 1
    return np.stack([first, *nearest[first, chosen]])


def _perspective(
    rays: Rays, features: Floats, detections: Indices, corners: Indices, min_pixels: float
) -> Floats:
    distance2 = ((features[:, None] - features) ** 2).sum(axis=-1)
    between = rays.directions @ rays.directions.T
    cosines = np.array([between[detections[i], detections[j]] for i, j in SIDES])
    squared = np.array([distance2[corners[i], corners[j]] for i, j in SIDES])
    distances, which = depths(cosines, squared)
    # smaller than this in the image, nothing is told apart
    largest = np.sqrt(squared.max(axis=0))[which]
    near = largest > min_pixels * rays.slope * distances.min(axis=0)
    distances, which = distances[:, near], which[near]
    directions = np.array([rays.directions.T[:, each] for each in detections[:, which]])
    body = np.array([features.T[:, each] for each in corners[:, which]])
    return align_triples(body, rays.origins[0][:, None] + directions * distances[:, None])


def _orthographic(
    rays: Rays, features: Floats, detections: Indices, corners: Indices, min_pixels: float
) -> Floats:
    """Three parallel rays: the sides' lengths give depth differences, which must add up.

    The depth of the whole is not seen; the middle is put on the sensor's plane.
    """
    body = features.T[:, corners].transpose(1, 0, 2)
    seen = rays.origins.T[:, detections].transpose(1, 0, 2)
    tolerance = 3 * min_pixels * rays.offset
    rise = []
    for i, j in SIDES:
        side, flat = body[j] - body[i], seen[j] - seen[i]
        length2, flat2 = (side * side).sum(axis=0), (flat * flat).sum(axis=0)
        possible = np.sqrt(flat2) <= np.sqrt(length2) + tolerance
        rise.append(np.where(possible, np.sqrt(np.maximum(length2 - flat2, 0.0)), np.nan))
    direction = rays.directions[0][:, None]
    poses = []
    for sign in (1.0, -1.0):
        off = np.abs(np.abs(rise[1] - sign * rise[0]) - rise[2])
        good = np.flatnonzero(off <= tolerance)
        for mirror in (1.0, -1.0):
            world = seen[:, :, good].copy()
            world[1] += mirror * sign * rise[0][good] * direction
            world[2] += mirror * rise[1][good] * direction
            world -= ((world - seen[:, :, good]) * direction).sum(axis=1).mean(axis=0) * direction
            poses.append(align_triples(body[:, :, good], world))
    return np.concatenate(poses)
