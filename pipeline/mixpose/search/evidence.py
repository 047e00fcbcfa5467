"""Very many poses judged at once, by the evidence that every pose is judged by in the end."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from mixpose.density import AssociationRules, ErrorRules, crowding
from mixpose.judgement import DetectionModel, SensorMatches, odds_of, paid_by_count
from mixpose.objective import project_body
from mixpose.records import Floats
from mixpose.search.detections import SensorDetections
from mixpose.search.problem import SearchProblem

_DETECTION, _ERRORS, _ASSOCIATION = DetectionModel(), ErrorRules(), AssociationRules()


def evidence(problem: SearchProblem, poses: Floats) -> tuple[Floats, Floats]:
    """Log odds (H,) of poses (H, 4, 4) against clutter, paid by count, and shares of the body met.

    Sensors without detections (range profiles) do not take part.
    """
    body, free = problem.body, problem.free
    seen = [one for one in problem.detections if len(one.points)]
    at = project_body(tuple(one.view.sensor for one in seen), body).project(poses)
    parts = zip(seen, at.y, at.J, at.seen, strict=True)
    matches = [_matches_of(problem.reach(one), one, y, J, visible) for one, y, J, visible in parts]
    found = np.array([one.shares.sum(axis=1) for one in matches])
    met = found / np.maximum([one.weights.sum(axis=1) for one in matches], 1.0)
    squares = np.array([(one.offsets**2).sum(axis=(1, 2)) for one in matches])
    sizes = np.array([[one.offsets.shape[2]] for one in matches])
    coordinates = (sizes * found).sum(axis=0)
    # of each sensor: what one that is covered meets by chance tells nothing of the others
    spare = found * sizes * np.maximum(1 - free.sum() / np.maximum(coordinates, 1.0), 0.0)
    degrees = _ERRORS.typical_degrees
    variance = degrees * _ERRORS.typical**2 + np.where(spare > 0, squares, 0.0)
    variance /= degrees + spare
    matches = [one.in_units_of(np.sqrt(v)) for one, v in zip(matches, variance, strict=True)]
    odds = odds_of(matches, np.full(len(poses), 2 * body.radius), _DETECTION)
    unseen = np.count_nonzero(at.faced & ~at.seen, axis=(0, 2)) * _DETECTION.log_unseen
    return paid_by_count(odds, matches, free) + unseen, met.mean(axis=0)


def _matches_of(
    reach: float, seen: SensorDetections, y: Floats, J: Floats, visible: NDArray[np.bool_]
) -> SensorMatches:
    """What a sensor has at places (H, n, 2), with the Jacobians (H, n, 2, 6) by the pose."""
    points, sigma, m = seen.points, seen.sigma, seen.points.shape[1]
    y = y[..., :m]
    pose, feature = np.nonzero(visible)
    away, nearest = cKDTree(points).query(y[pose, feature], distance_upper_bound=reach)
    # a detection is met by the nearest of the features to which it is the nearest
    near = np.flatnonzero(np.isfinite(away))
    key = pose[near] * len(points) + nearest[near]
    order = np.lexsort((away[near], key))
    first = near[order[np.unique(key[order], return_index=True)[1]]]
    pose, feature, found = pose[first], feature[first], points[nearest[first]]
    shares, offsets = np.zeros(visible.shape), np.zeros(y.shape)
    shares[pose, feature] = 1.0
    offsets[pose, feature] = (found - y[pose, feature]) / sigma
    empty = ~visible.any(axis=1)
    lower = np.where(visible[..., None], y, np.inf).min(axis=1)
    upper = np.where(visible[..., None], y, -np.inf).max(axis=1)
    lower[empty], upper[empty] = 0.0, 0.0
    weights, by_world = visible.astype(np.float64), J[..., :m, :3] / sigma
    crowd = crowding(points, lower, upper, _ASSOCIATION.min_region * sigma) * sigma**m
    count = np.full(len(y), float(len(points)))
    return SensorMatches(weights, shares, offsets, by_world, crowd, count)
