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

from mixpose.body import Body
from mixpose.objective.base import facing
from mixpose.records import PointPattern
from mixpose.rigid import transform
from mixpose.search.sightings import Sighting

Floats: TypeAlias = NDArray[np.float64]

_GATE = 3.0  # σ_ε within which a detection is met
_NEIGHBOURS = int(__import__("os").environ.get("KN", "3"))
_SHARPEST = 0.1  # of σ_ε: errors are not believed to be smaller
_MISSED = np.log(0.3)  # a feature in view without a detection; half as many are common


def evidence(
    sightings: Sequence[Sighting], body: Body, poses: Floats, free: NDArray[np.bool_]
) -> Floats:
    """Log-likelihood ratio (H,) of poses (H, 4, 4) against chance, in nats.

    Sensors without detections (range profiles) do not take part.
    """
    count = len(poses)
    met, chance, squared = np.zeros(count), np.zeros(count), np.zeros(count)
    coordinates, missed = np.zeros(count), np.zeros(count)
    for sighting in sightings:
        pattern = sighting.view.observation.pattern
        if not isinstance(pattern, PointPattern):
            continue
        rarity = _log_chance(sighting, pattern.points)
        own, errors, seen, by_chance = _pairs(sighting, pattern.points, rarity, body, poses)
        m = pattern.points.shape[1]
        met += own
        missed += seen - own
        coordinates += m * own
        squared += errors
        chance += by_chance
    spare = np.maximum(coordinates - free.sum(), 0.0)
    s2 = np.clip(squared / np.maximum(spare, 1e-9), _SHARPEST**2, 1.0)
    share = spare / np.maximum(coordinates, 1.0)
    gain = -share * chance - 0.5 * spare * np.log(s2) - 0.5 * squared / s2
    return np.asarray(np.where(spare > 0, gain + _MISSED * missed, 0.0))


def _pairs(
    sighting: Sighting, points: Floats, rarity: Floats, body: Body, poses: Floats
) -> tuple[Floats, Floats, Floats, Floats]:
    """Detections that are met, their squared errors in σ_ε², features in view, log-chances."""
    sensor = sighting.view.sensor
    world = transform(poses, body.means)
    y, seen = sensor.project(world)
    seen = seen & facing(sensor, poses, world, body.normals)
    away2 = ((y[:, :, None] - points) ** 2).sum(axis=-1) / sighting.sigma**2
    away2 = np.where(seen[:, :, None], away2, np.inf)
    detection = away2.argmin(axis=2)
    feature = away2.argmin(axis=1)
    mutual = np.take_along_axis(feature, detection, axis=1) == np.arange(y.shape[1])
    nearest = np.take_along_axis(away2, detection[..., None], axis=2)[..., 0]
    met = mutual & (nearest <= _GATE**2)
    errors = np.where(met, nearest, 0.0).sum(axis=1)
    by_chance = np.where(met, rarity[detection], 0.0).sum(axis=1)
    return met.sum(axis=1).astype(float), errors, seen.sum(axis=1).astype(float), by_chance


def _log_chance(sighting: Sighting, points: Floats) -> Floats:
    """Logarithms (M,) of the chance that a point falls within σ_ε of a detection.

    Where detections crowd, one of them is met more easily.
    """
    sensor, m = sighting.view.sensor, points.shape[1]
    sides = np.maximum(np.ptp(points, axis=0), 10 * sighting.sigma)
    whole = sensor.upper - sensor.lower
    sides = np.where(np.isfinite(whole), whole, sides)
    bell = (np.sqrt(2 * np.pi) * sighting.sigma) ** m
    density = np.full(len(points), len(points) / np.prod(sides))
    k = _NEIGHBOURS
    if m == 2 and len(points) > k:
        away = np.linalg.norm(points[:, None] - points, axis=-1)
        reach = np.maximum(np.sort(away, axis=1)[:, k], 10 * sighting.sigma)
        density = np.maximum(density, k / (np.pi * reach**2))
    return np.asarray(np.minimum(np.log(density * bell), -0.1))
