"""Kinds of guesses from rays, and slips along a grid of features."""

from __future__ import annotations

import numpy as np

from mixpose.body import Body
from mixpose.records import Floats
from mixpose.rigid import from_parts
from mixpose.search.from_point_and_rays import from_point_and_rays
from mixpose.search.from_point_triples import by_promise, from_point_triples
from mixpose.search.from_three_rays import from_three_rays
from mixpose.search.problem import Kind, SearchProblem
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


def from_slips(body: Body, pose: Floats) -> Floats:
    """A pose with the body shifted by the way from any feature to any other (n (n - 1), 4, 4).

    On a grid of features a pose that is a step off explains most of them.
    """
    i, j = np.nonzero(~np.eye(len(body), dtype=np.bool_))
    return pose @ from_parts(np.eye(3), body.means[i] - body.means[j])
