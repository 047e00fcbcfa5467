"""Evidence of very many poses at once, as every pose is judged by in the end."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from mixpose.judgement import odds_of, paid_by_count
from mixpose.matching import Matches, crowding
from mixpose.objective import Match, project_body
from mixpose.records import Floats, Indices
from mixpose.search.detections import SensorDetections
from mixpose.search.problem import SearchProblem


def evidence(problem: SearchProblem, poses: Floats) -> tuple[Floats, Floats]:
    """Log odds (H,) of poses (H, 4, 4) against clutter, paid by count, and shares of the body met.

    Sensors without detections (range profiles) do not take part.
    """
    body, free, rules = problem.body, problem.free, problem.rules
    sensors = [sensor for sensor in problem.detections if len(sensor.points)]
    projected = project_body(tuple(s.view.sensor for s in sensors), body).project(poses)
    matches = _matches_of(problem, sensors, projected)
    met = matches.shares.sum(axis=2)
    coordinates = (met @ matches.dimensions)[:, None]
    # of each sensor: what one that is covered meets by chance tells nothing of the others
    spare = (
        met * matches.dimensions * np.maximum(1 - free.sum() / np.maximum(coordinates, 1.0), 0.0)
    )
    squares = np.where(spare > 0, (matches.offsets**2).sum(axis=(2, 3)), 0.0)
    errors = rules.noise.errors
    degrees = errors.typical_degrees
    variances = (degrees * errors.typical**2 + squares) / (degrees + spare)
    odds = odds_of(matches, variances, np.full(len(poses), 2 * body.radius), rules.detection)
    shares = met / np.maximum(matches.weights.sum(axis=2), 1.0)
    return paid_by_count(odds, matches, free), shares.mean(axis=1)


def _matches_of(
    problem: SearchProblem, sensors: Sequence[SensorDetections], projected: Match
) -> Matches:
    """Detections that sensors have where they are predicted to see the features of K poses."""
    association, visible = problem.rules.association, projected.seen
    shares: Floats = np.zeros(visible.shape)
    offsets: Floats = np.zeros(projected.y.shape)
    crowd = []
    for k, sensor in enumerate(sensors):
        points, sigma, m = sensor.points, sensor.sigma, sensor.points.shape[1]
        y = projected.y[k, ..., :m]
        pose, feature, detection = _pairs(y, visible[k], points, problem.reach(sensor))
        shares[k, pose, feature] = 1.0
        offsets[k, pose, feature, :m] = (points[detection] - y[pose, feature]) / sigma
        lower, upper = points.min(axis=0)[None], points.max(axis=0)[None]
        if association.crowded:
            inside, empty = visible[k][..., None], ~visible[k].any(axis=1)[:, None]
            lower = np.where(empty, 0.0, np.where(inside, y, np.inf).min(axis=1))
            upper = np.where(empty, 0.0, np.where(inside, y, -np.inf).max(axis=1))
        crowding_here = crowding(points, lower, upper, association.min_region * sigma)
        crowd.append(np.broadcast_to(crowding_here * sigma**m, len(y)))
    sigmas = np.array([sensor.sigma for sensor in sensors])
    count = np.tile([float(len(sensor.points)) for sensor in sensors], (visible.shape[1], 1))
    by_sensor = {
        "weights": visible.astype(np.float64),
        "shares": shares,
        "places": projected.y,
        "offsets": offsets,
        "J": projected.J / sigmas[:, None, None, None, None],
        "detections": np.full(visible.shape, -1),
        "unseen": np.count_nonzero(projected.faced & ~visible, axis=2),
    }
    return Matches(
        names=tuple(sensor.view.name for sensor in sensors),
        dimensions=np.array([sensor.points.shape[1] for sensor in sensors]),
        sigmas=sigmas,
        explained=np.zeros_like(count),
        merged=np.zeros(count.shape, dtype=np.intp),
        count=count,
        crowd=np.stack(crowd, axis=1),
        unmatched_nearby=np.zeros_like(count),
        finest=np.ones_like(count),
        **{name: array.swapaxes(0, 1) for name, array in by_sensor.items()},
    )


def _pairs(
    y: Floats, visible: NDArray[np.bool_], points: Floats, reach: float
) -> tuple[Indices, Indices, Indices]:
    """Poses, features and detections (C,) of places (K, N, m) that are met within reach.

    A detection is met by the nearest of the features to which it is the nearest.
    """
    pose, feature = np.nonzero(visible)
    away, nearest = cKDTree(points).query(y[pose, feature], distance_upper_bound=reach)
    near = np.flatnonzero(np.isfinite(away))
    key = pose[near] * len(points) + nearest[near]
    order = np.lexsort((away[near], key))
    first = near[order[np.unique(key[order], return_index=True)[1]]]
    return pose[first], feature[first], nearest[first]
