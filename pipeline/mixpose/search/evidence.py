"""How unlikely it is that a pose explains its detections by chance.

A pose that meets K detections uses up half of its free directions' number of them; every other
one fell by chance within s of a prediction with a probability of about ``ρ (2π s²)^(m/2)``, ρ
being how densely detections lie.  The errors' own size s is estimated, up to σ_ε: four
detections met to a tenth of a pixel are better evidence than five met to a pixel
(a-contrario model selection, Moisan and Stival, IJCV 2004).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from mixpose.body import Body
from mixpose.rigid import transform
from mixpose.search.budget import EvidenceOptions
from mixpose.search.detections import SensorDetections
from mixpose.sensors import facing

Floats: TypeAlias = NDArray[np.float64]


def evidence(
    detections: Sequence[SensorDetections],
    body: Body,
    poses: Floats,
    free: NDArray[np.bool_],
    options: EvidenceOptions,
) -> Floats:
    """Log-likelihood ratio (H,) of poses (H, 4, 4) against chance, in nats.

    Sensors without detections (range profiles) do not take part.
    """
    chance, squared, coordinates, missed = np.zeros((4, len(poses)))
    for each in detections:
        if not len(each.points):
            continue
        m = each.points.shape[1]
        met, errors, seen, by_chance = _matches(each, body, poses, options)
        missed += seen - met
        coordinates += m * met
        squared += errors
        chance += by_chance
    spare = np.maximum(coordinates - free.sum(), 0.0)
    s2 = np.clip(squared / np.maximum(spare, 1e-9), options.sharpest**2, 1.0)
    share = spare / np.maximum(coordinates, 1.0)
    gain = -share * chance - 0.5 * spare * np.log(s2) - 0.5 * squared / s2
    return np.asarray(np.where(spare > 0, gain + options.missed * missed, 0.0))


def _matches(
    seen: SensorDetections, body: Body, poses: Floats, options: EvidenceOptions
) -> tuple[Floats, Floats, Floats, Floats]:
    """Detections met, their squared errors in σ_ε², features in view, log-chances: (H,) each."""
    sensor, points = seen.view.sensor, seen.points
    world = transform(poses, body.means)
    y, visible = sensor.project(world)
    visible = visible & facing(sensor, poses, world, body.normals)
    tree = cKDTree(points)
    pose, _ = np.nonzero(visible)
    gate = options.gate * seen.sigma
    away, detection = tree.query(y[visible], distance_upper_bound=gate)
    inside = np.isfinite(away)
    # a detection is met by the nearest of the features to which it is the nearest
    squared = np.full(len(poses) * len(points), np.inf)
    key = pose[inside] * len(points) + detection[inside]
    np.minimum.at(squared, key, (away[inside] / seen.sigma) ** 2)
    by_detection = squared.reshape(len(poses), len(points))
    met = np.isfinite(by_detection)
    errors = np.where(met, by_detection, 0.0).sum(axis=1)
    by_chance = met @ _log_chances(seen, tree, options)
    return met.sum(axis=1).astype(float), errors, visible.sum(axis=1).astype(float), by_chance


def _log_chances(seen: SensorDetections, tree: cKDTree, options: EvidenceOptions) -> Floats:
    """Logarithms (M,) of the chance that a point falls within σ_ε of a detection.

    Where detections crowd, one of them is met more easily.
    """
    sensor, points = seen.view.sensor, seen.points
    M, m = points.shape
    sides = np.maximum(np.ptp(points, axis=0), 10 * seen.sigma)
    whole = sensor.upper - sensor.lower
    sides = np.where(np.isfinite(whole), whole, sides)
    bell = (np.sqrt(2 * np.pi) * seen.sigma) ** m
    density = np.full(M, M / np.prod(sides))
    k = options.neighbours
    if m == 2 and k < M:
        away, _ = tree.query(points, k=[k + 1])
        reach = np.maximum(away[:, 0], 10 * seen.sigma)
        density = np.maximum(density, k / (np.pi * reach**2))
    return np.asarray(np.minimum(np.log(density * bell), -0.1))
