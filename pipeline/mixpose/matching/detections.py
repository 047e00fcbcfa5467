"""Detections of all sensors side by side, and how they lie around a body."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from mixpose.density import DRAWING, Observation
from mixpose.matching.rules import AssociationRules
from mixpose.objective import MatchedObjective
from mixpose.records import Floats, Mask, PointPattern

_FAR = 1e12  # sensor units: where detections are filled up that a sensor does not have


class Detections(NamedTuple):
    """Detections of L sensors side by side, M at most."""

    points: Floats  # (L, M, 2)
    sigmas: Floats  # (L,) σ_ε
    number: Floats  # (L,)
    crowd: Floats  # (L,) per m-th power of σ_ε, in the region of all
    region: Floats  # (L, 1) what the side of a region counts at least, sensor units
    is_grid: tuple[bool, ...]
    is_flat: tuple[bool, ...]  # of one coordinate


@lru_cache(maxsize=8)
def side_by_side(observations: tuple[Observation, ...], rules: AssociationRules) -> Detections:
    """Detections of one frame, by all that looks at them."""
    patterns = [one.pattern for one in observations]
    points = [p.points if isinstance(p, PointPattern) else np.zeros((0, 2)) for p in patterns]
    sigmas = np.array([one.sigma for one in observations])
    side = np.full((len(points), max(map(len, points)), 2), _FAR)
    crowd, region = np.zeros(len(points)), rules.min_region * sigmas
    for k, some in enumerate(points):
        m = some.shape[1]
        side[k, : len(some), :m], side[k, : len(some), m:] = some, 0.0
        if len(some):
            extent = np.maximum(np.ptp(some, axis=0), region[k])
            crowd[k] = len(some) / float(extent.prod()) * sigmas[k] ** m
    return Detections(
        side,
        sigmas,
        np.array([float(len(some)) for some in points]),
        crowd,
        region[:, None],
        tuple([one.cell is not None for one in observations]),
        tuple([one.dimension == 1 for one in observations]),
    )


@dataclass(frozen=True, eq=False)
class Surroundings:
    """What L sensors have around a body."""

    count: Floats  # (L,) number of detections
    crowd: Floats  # (L,) of them per m-th power of σ_ε, in its box or in all, where they are denser
    unmatched: Floats  # (L,) no feature's, in its box and as far around as a grid may slip
    finest: Floats  # (L,) narrowest blur, in σ_ε, at which its box can be drawn


def surroundings(
    objective: MatchedObjective,
    y: Floats,
    seen: Mask,
    shares: Floats,
    detections: Detections,
    rules: AssociationRules,
) -> Surroundings:
    """Look around features at places y (L, n, 2), in view of a sensor or not, met by shares."""
    blind = ~seen.any(axis=1)
    lower, upper = y.min(axis=1), y.max(axis=1)
    if not seen.all():
        lower = np.where(seen[..., None], y, np.inf).min(axis=1)
        upper = np.where(seen[..., None], y, -np.inf).max(axis=1)
        lower[blind], upper[blind] = 0.0, 0.0
    size, middle = upper - lower, (lower + upper) / 2
    sigmas = detections.sigmas
    sides, flat = np.maximum(size, detections.region), list(detections.is_flat)
    away = np.abs(detections.points - middle[:, None])
    inside = np.count_nonzero((away <= sides[:, None] / 2).all(axis=2), axis=1)
    scaled = sides / sigmas[:, None]
    if any(flat):
        scaled[flat, 1] = 1.0
    dense = inside / (scaled[:, 0] * scaled[:, 1]) if rules.crowded else 0.0
    count, crowd = detections.number, np.maximum(detections.crowd, dense)
    unmatched = np.zeros(len(sides))
    missing = (seen & (shares == 0)).any(axis=1)
    if missing.any():
        half = size / 2 + rules.slip * size.max(axis=1, keepdims=True)
        near = np.count_nonzero((away <= half[:, None]).all(axis=2), axis=1) - shares.sum(axis=1)
        unmatched = np.where(missing & ~np.array(flat), np.maximum(near, 0.0), 0.0)
    finest = size.max(axis=1) / (DRAWING.widest * sigmas)
    if any(detections.is_grid):
        count, crowd = _of_grids(objective, count, crowd, rules)
        blind |= np.array(detections.is_grid)
    finest[blind] = 1.0
    return Surroundings(count, crowd, unmatched, finest)


def _of_grids(
    objective: MatchedObjective, count: Floats, crowd: Floats, rules: AssociationRules
) -> tuple[Floats, Floats]:
    """The same of grey values: as many equal features as would give their energy."""
    count, equal = count.copy(), (objective.tops / objective.energies)[:, 0]
    for k, view in enumerate(objective.views):
        if view.observation.cell is not None:
            near, far = (corner / view.observation.sigma for corner in view.observation.extent)
            count[k] = equal[k]
            crowd[k] = equal[k] / float(np.maximum(far - near, rules.min_region).prod())
    return count, crowd


def crowding(points: Floats, lower: Floats, upper: Floats, smallest: float) -> Floats:
    """Detections (H,) per unit of a sensor's coordinates, in all or in boxes where they are denser.

    Parameters
    ----------
    points : (M, m) array
        Of the detections.
    lower, upper : (H, m) array
        Boxes around the predicted features of H poses.
    smallest : float
        What the side of a region counts at least.
    """
    overall = len(points) / np.maximum(np.ptp(points, axis=0), smallest).prod()
    sides = np.maximum(upper - lower, smallest)
    middle = (lower + upper) / 2
    away = np.abs(points - middle[:, None])
    inside = (away <= sides[:, None] / 2).all(axis=2).sum(axis=1)
    return np.asarray(np.maximum(overall, inside / sides.prod(axis=1)))
