"""The objective around a pose: along each direction, and over pairs of directions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from mixpose.body import Body
from mixpose.fit import EstimatorOptions, free_mask
from mixpose.objective import View, build_objective, pose_jacobian
from mixpose.records import Floats
from mixpose.rigid import perturb, transform

_WIDE = 1.5  # widest blurs to either side of a slice
_NARROW = 5.0  # finest blurs to either side of a map
_LEAST_WIDE = 8.0  # finest blurs to either side of a slice
_POINTS = 241
_SIDE = 41
_MAPS = 3
_BATCH = 512  # poses that are projected at once
_SAMPLES = 200  # per feature: enough to look at


@dataclass(frozen=True)
class Slice:
    """The objective along one direction."""

    direction: int  # of `mixpose.rigid.TWIST_NAMES`
    offsets: Floats  # (n,) lengths or radians from the pose
    values: Floats  # (levels, n) per level of blur, the largest of each level 1


@dataclass(frozen=True)
class Map:
    """The objective at the finest blur over two directions."""

    directions: tuple[int, int]  # across and up
    offsets: tuple[Floats, Floats]  # (n,), (n,)
    values: Floats  # (n, n), rows along the second direction; the largest is 1


def objective_around(
    views: Sequence[View],
    body: Body,
    T_world_object: Floats,
    covariance: Floats | None,
    options: EstimatorOptions,
    levels: Sequence[Sequence[float]],
) -> tuple[list[Slice], list[Map]]:
    """Cut the objective along every free direction, and over the pairs that depend most.

    There is at least one view, and none with an empty observation. Pairs are chosen by their
    correlation in the covariance (6, 6); without it they are the first. `levels` are the blurs per
    level and view, coarse to fine.
    """
    free = np.flatnonzero(free_mask(options)).tolist()
    unit = _one_blur(views, body, T_world_object, levels[-1])
    widest = max(w / f for w, f in zip(levels[0], levels[-1], strict=True))
    wide = max(_LEAST_WIDE, _WIDE * widest)
    samples = body.sample(min(options.samples, _SAMPLES), seed=options.seed)

    def values(sigmas: Sequence[float], twists: Floats) -> Floats:
        objective = build_objective(options.objective, views, body, samples, sigmas, T_world_object)
        poses = perturb(T_world_object, twists)
        parts = [objective.value(poses[k : k + _BATCH]) for k in range(0, len(poses), _BATCH)]
        found = np.nan_to_num(np.concatenate(parts))
        return np.asarray(found / max(float(found.max()), 1e-300))

    slices = []
    for k in free:
        offsets = _half_width(wide * unit[k], k) * np.linspace(-1, 1, _POINTS)
        twists = offsets[:, None] * np.eye(6)[k]
        curves = np.array([values(sigmas, twists) for sigmas in levels])
        slices.append(Slice(k, offsets, curves))
    maps = []
    for i, j in _pairs(free, covariance):
        across, up = (_half_width(_NARROW * unit[k], k) * np.linspace(-1, 1, _SIDE) for k in (i, j))
        grid = np.stack(np.meshgrid(across, up), axis=-1).reshape(-1, 2)
        surface = values(levels[-1], grid @ np.eye(6)[[i, j]])
        maps.append(Map((i, j), (across, up), surface.reshape(_SIDE, _SIDE)))
    return slices, maps


def _half_width(offset: float, direction: int) -> float:
    """An offset, but for turns half a turn at most."""
    return min(offset, np.pi) if direction >= 3 else offset


def _one_blur(
    views: Sequence[View], body: Body, T_world_object: Floats, sigmas: Sequence[float]
) -> Floats:
    """By how much each direction moves the features by one finest blur, in the keenest sensor."""
    points = body.nodes.points
    keenest = np.zeros(6)
    for view, sigma in zip(views, sigmas, strict=True):
        _, by_world, seen = view.sensor.linearise(transform(T_world_object, points))
        if seen.any():
            J = pose_jacobian(by_world, points @ T_world_object[:3, :3].T)[seen] / sigma
            keenest = np.maximum(keenest, (J**2).sum(axis=1).mean(axis=0))
    usual = np.repeat([0.02 * body.radius, np.radians(1.0)], 3)
    return np.where(keenest > 0, 1 / np.sqrt(np.maximum(keenest, 1e-300)), usual)


def _pairs(free: Sequence[int], covariance: Floats | None) -> list[tuple[int, int]]:
    """The pairs of directions that depend on each other most."""
    pairs = list(combinations(free, 2))
    if covariance is not None and np.isfinite(covariance).all():
        deviations = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
        related = np.abs(covariance / deviations / deviations[:, None])
        pairs.sort(key=lambda pair: -related[pair])
    return pairs[:_MAPS]
