"""All kinds of guesses, from the sharpest to the bluntest."""

from __future__ import annotations

import numpy as np

from mixpose.body import Body
from mixpose.records import Floats
from mixpose.search.from_point_and_rays import from_point_and_rays
from mixpose.search.from_point_triples import by_promise, from_point_triples
from mixpose.search.from_three_rays import from_three_rays
from mixpose.search.placement import centres, place
from mixpose.search.problem import Kind, SearchProblem
from mixpose.search.refinement import Stage
from mixpose.search.spread import spread_turns
from mixpose.search.triangulation import triangulate


def kinds_of_guesses(problem: SearchProblem) -> list[Kind]:
    """Kinds of guesses from rays, the quickest first.

    Points in space; one such point and two rays, in crowds at last; three rays of one camera.
    """
    budget, rays = problem.budget, [one for _, one in problem.cameras]
    kinds = [from_three_rays(problem, one) for one in rays]
    if len(rays) < 2:
        return kinds
    gates = [problem.reach(seen) for seen, _ in problem.cameras]
    found = by_promise(problem, triangulate(rays, gates, budget.min_sine))
    crowded = sum(map(len, rays)) > budget.crowded * len(problem.body) * len(rays)
    # of the points tried in a crowd, and of the rays near them, few are right
    kinds.insert(len(kinds) if crowded else 0, from_point_and_rays(problem, found))
    return [from_point_triples(problem, found), *kinds]


def from_spread_orientations(problem: SearchProblem) -> tuple[Floats, list[Stage]]:
    """All orientations, placed by the middle of what is seen, and how to descend from them."""
    budget = problem.budget
    turns = spread_turns(problem.free[3:], budget.orientation_step)
    rotations = turns @ problem.T_reference[:3, :3]
    poses = [place(problem, rotations, centre) for centre in centres(problem)]
    wide = [
        max(budget.orientation_blur * each.spread / each.sigma, 1.0) for each in problem.detections
    ]
    stages = [
        Stage(tuple(w**share for w in wide), steps, survivors)
        for share, steps, survivors in budget.orientation_stages
    ]
    return np.concatenate(poses) if poses else np.zeros((0, 4, 4)), stages


def from_slips(body: Body, pose: Floats) -> Floats:
    """A pose with the body shifted by the way from any feature to any other (n (n - 1), 4, 4).

    On a grid of features a pose that is a step off explains most of them.
    """
    i, j = np.nonzero(~np.eye(len(body), dtype=np.bool_))
    shifts = np.tile(np.eye(4), (len(i), 1, 1))
    shifts[:, :3, 3] = body.means[i] - body.means[j]
    return pose @ shifts
