"""Very many poses judged at once, by the evidence that every pose is judged by in the end."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial import cKDTree

from mixpose.density import crowding
from mixpose.judgement import Matches, odds_of, paid_by_count
from mixpose.objective import Projected, project_body
from mixpose.records import Floats
from mixpose.search.detections import SensorDetections
from mixpose.search.problem import SearchProblem


def evidence(problem: SearchProblem, poses: Floats) -> tuple[Floats, Floats]:
    """Log odds (H,) of poses (H, 4, 4) against clutter, paid by count, and shares of the body met.

    Sensors without detections (range profiles) do not take part.
    """
    body, free, rules = problem.body, problem.free, problem.rules
    seen = [one for one in problem.detections if len(one.points)]
    at = project_body(tuple(one.view.sensor for one in seen), body).project(poses)
    found = _matches_of(problem, seen, at)
    met = found.shares.sum(axis=2)
    coordinates = (met @ found.dimensions)[:, None]
    # of each sensor: what one that is covered meets by chance tells nothing of the others
    spare = met * found.dimensions * np.maximum(1 - free.sum() / np.maximum(coordinates, 1.0), 0.0)
    squares = np.where(spare > 0, (found.offsets**2).sum(axis=(2, 3)), 0.0)
    errors = rules.noise.errors
    degrees = errors.typical_degrees
    variances = (degrees * errors.typical**2 + squares) / (degrees + spare)
    odds = odds_of(found, variances, np.full(len(poses), 2 * body.radius), rules.detection)
    shares = met / np.maximum(found.weights.sum(axis=2), 1.0)
    return paid_by_count(odds, found, free), shares.mean(axis=1)


def _matches_of(problem: SearchProblem, seen: Sequence[SensorDetections], at: Projected) -> Matches:
    """What sensors have at the places where they are predicted to see the body."""
    association = problem.rules.association
    sigmas = np.array([one.sigma for one in seen])[:, None, None, None]
    shares, offsets = np.zeros(at.seen.shape), np.zeros(at.y.shape)
    crowd = []
    for k, one in enumerate(seen):
        points, m = one.points, one.points.shape[1]
        y, visible = at.y[k, ..., :m], at.seen[k]
        pose, feature = np.nonzero(visible)
        reach = problem.reach(one)
        away, nearest = cKDTree(points).query(y[pose, feature], distance_upper_bound=reach)
        # a detection is met by the nearest of the features to which it is the nearest
        near = np.flatnonzero(np.isfinite(away))
        key = pose[near] * len(points) + nearest[near]
        order = np.lexsort((away[near], key))
        first = near[order[np.unique(key[order], return_index=True)[1]]]
        pose, feature, found = pose[first], feature[first], points[nearest[first]]
        shares[k, pose, feature] = 1.0
        offsets[k, pose, feature, :m] = (found - y[pose, feature]) / one.sigma
        empty = ~visible.any(axis=1)
        lower = np.where(visible[..., None], y, np.inf).min(axis=1)
        upper = np.where(visible[..., None], y, -np.inf).max(axis=1)
        lower[empty], upper[empty] = 0.0, 0.0
        if not association.crowded:
            lower[:], upper[:] = points.min(axis=0), points.max(axis=0)
        smallest = association.min_region * one.sigma
        crowd.append(crowding(points, lower, upper, smallest) * one.sigma**m)
    return Matches(
        dimensions=np.array([one.points.shape[1] for one in seen]),
        weights=at.seen.swapaxes(0, 1).astype(np.float64),
        shares=shares.swapaxes(0, 1),
        places=at.y.swapaxes(0, 1),
        offsets=offsets.swapaxes(0, 1),
        J=(at.J / sigmas[..., None]).swapaxes(0, 1),
        crowd=np.stack(crowd, axis=1),
        count=np.tile([float(len(one.points)) for one in seen], (len(shares[0]), 1)),
        unseen=np.count_nonzero(at.faced & ~at.seen, axis=2).T,
    )
