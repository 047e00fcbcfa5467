"""Very many poses judged at once, by the evidence that every pose is judged by in the end."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from mixpose.body import Body
from mixpose.density import AssociationRules, ErrorRules
from mixpose.judgement import DetectionModel, SensorMatches, odds_of, paid_by_count
from mixpose.rigid import transform
from mixpose.search.detections import SensorDetections
from mixpose.sensors import facing

Floats: TypeAlias = NDArray[np.float64]

_DETECTION, _ERRORS, _ASSOCIATION = DetectionModel(), ErrorRules(), AssociationRules()


def evidence(
    detections: Sequence[SensorDetections],
    body: Body,
    poses: Floats,
    free: NDArray[np.bool_],
    gate: float,
) -> tuple[Floats, Floats]:
    """Log odds (H,) of poses against clutter, paid by count, and shares (H,) of the body met.

    Parameters
    ----------
    detections : sequence of SensorDetections
        Sensors without detections (range profiles) do not take part.
    body : Body
    poses : (H, 4, 4) array
    free : (6,) bool
    gate : float
        Within which a detection is met, in σ_ε.
    """
    matches = [_matches_of(one, body, poses, gate) for one in detections if len(one.points)]
    squares, coordinates, met = np.zeros((3, len(poses)))
    for one in matches:
        squares += (one.offsets**2).sum(axis=(1, 2))
        found = one.shares.sum(axis=1)
        coordinates += one.offsets.shape[2] * found
        met += found / np.maximum(one.weights.sum(axis=1), 1.0) / len(matches)
    spare = np.maximum(coordinates - free.sum(), 0.0)
    degrees = _ERRORS.typical_degrees
    variance = degrees * _ERRORS.typical**2 + np.where(spare > 0, squares, 0.0)
    variance /= degrees + spare
    odds = odds_of(matches, variance, 2 * body.radius, _DETECTION)
    return paid_by_count(odds, matches, free), met


def _matches_of(seen: SensorDetections, body: Body, poses: Floats, gate: float) -> SensorMatches:
    sensor, points, sigma = seen.view.sensor, seen.points, seen.sigma
    world = transform(poses, body.means)
    y, by_world, visible = sensor.linearise(world)
    visible = visible & facing(sensor, poses, world, body.normals)
    pose, feature = np.nonzero(visible)
    away, nearest = cKDTree(points).query(y[pose, feature], distance_upper_bound=gate * sigma)
    # a detection is met by the nearest of the features to which it is the nearest
    near = np.flatnonzero(np.isfinite(away))
    key = pose[near] * len(points) + nearest[near]
    order = np.lexsort((away[near], key))
    first = near[order[np.unique(key[order], return_index=True)[1]]]
    pose, feature, found = pose[first], feature[first], points[nearest[first]]
    shares, offsets = np.zeros(visible.shape), np.zeros(y.shape)
    shares[pose, feature] = 1.0
    offsets[pose, feature] = (found - y[pose, feature]) / sigma
    crowd = _crowd(points, y, visible, sigma) * sigma ** y.shape[-1]
    return SensorMatches(
        visible.astype(float), shares, offsets, by_world / sigma, crowd, float(len(points))
    )


def _crowd(points: Floats, y: Floats, visible: NDArray[np.bool_], sigma: float) -> Floats:
    """Detections (H,) per unit of the sensor's coordinates, everywhere or around the body."""
    smallest = _ASSOCIATION.min_region * sigma
    overall = len(points) / np.maximum(np.ptp(points, axis=0), smallest).prod()
    lower = np.where(visible[..., None], y, np.inf).min(axis=1)
    upper = np.where(visible[..., None], y, -np.inf).max(axis=1)
    empty = ~visible.any(axis=1)
    lower[empty], upper[empty] = 0.0, 0.0
    half = np.maximum(upper - lower, smallest) / 2
    middle = (lower + upper) / 2
    inside = (np.abs(points - middle[:, None]) <= half[:, None]).all(axis=2).sum(axis=1)
    return np.asarray(np.maximum(overall, inside / (2 * half).prod(axis=1)))
