"""All kinds of guesses, from the sharpest to the bluntest."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from mixpose.body import Body
from mixpose.search.budget import SearchBudget
from mixpose.search.constraint import Constraint
from mixpose.search.detections import SensorDetections
from mixpose.search.from_point_and_rays import from_point_and_rays
from mixpose.search.from_point_triples import by_promise, from_point_triples
from mixpose.search.from_three_rays import from_three_rays
from mixpose.search.placement import centres, place
from mixpose.search.refinement import Stage
from mixpose.search.spread import far_apart, spread_turns
from mixpose.search.triangulation import triangulate

Floats: TypeAlias = NDArray[np.float64]
Kind: TypeAlias = Callable[[int], Iterator[Floats]]


def kinds_of_guesses(
    detections: Sequence[SensorDetections], body: Body, budget: SearchBudget, seed: int
) -> list[Kind]:
    """Kinds of guesses from rays, the quickest first.

    Points in space; one such point and two rays, in crowds at last; three rays of one camera.

    Returns
    -------
    list of callable
        Each takes a number of batches to skip, and yields poses (K, 4, 4) batch by batch, always
        the same.
    """
    seen = [each for each in detections if each.rays is not None and len(each.rays)]
    rays = [each.rays for each in seen if each.rays is not None]
    gates = [budget.gate * each.sigma for each in seen]
    rng = partial(np.random.default_rng, seed)
    kinds: list[Kind] = []
    most = budget.max_problems
    if len(rays) > 1:
        most = budget.max_shared_problems // len(rays)
        found = triangulate(rays, gates, budget.min_sine)
        found = by_promise(found, seen, budget.gate, budget.max_points)
        few = body.means[far_apart(body.means, budget.subsample)]
        kinds.append(partial(from_point_triples, found, body, budget, rng()))
        kinds.append(partial(from_point_and_rays, found, rays, gates, few, budget))
    kinds += [partial(from_three_rays, each, body.means, most, budget, rng()) for each in rays]
    if len(rays) > 1 and sum(map(len, rays)) > budget.crowded * len(body) * len(rays):
        kinds.append(kinds.pop(1))  # of the points tried, and of the rays near them, few are right
    return kinds


def from_spread_orientations(
    detections: Sequence[SensorDetections],
    body: Body,
    constraint: Constraint,
    budget: SearchBudget,
) -> tuple[Floats, list[Stage]]:
    """All orientations, placed by the middle of what is seen, and how to descend from them."""
    turns = spread_turns(constraint.turns, budget.orientation_step)
    rotations = turns @ constraint.T_reference[:3, :3]
    poses = [
        place(detections, body, rotations, centre, constraint, budget.turn_steps)
        for centre in centres(detections, body, constraint, budget)
    ]
    wide = [max(budget.orientation_blur * each.spread / each.sigma, 1.0) for each in detections]
    stages = [
        Stage(tuple(max(w**share, 1.0) for w in wide), steps, survivors)
        for share, steps, survivors in budget.orientation_stages
    ]
    return np.concatenate(poses) if poses else np.zeros((0, 4, 4)), stages


def from_slips(body: Body, pose: Floats) -> Floats:
    """A pose with the body shifted by the way from any feature to any other (n (n - 1), 4, 4).

    On a grid of features a pose that is a step off explains most of them.
    """
    n = len(body)
    i, j = np.nonzero(~np.eye(n, dtype=np.bool_))
    shifts = np.tile(np.eye(4), (len(i), 1, 1))
    shifts[:, :3, 3] = body.means[i] - body.means[j]
    return pose @ shifts
