"""The matched objective of many poses at once, with its slope and curvature.

The same formulas as in `mixpose.objective.matched`, batched: S = Σ_l ω_l ⟨g,h⟩² / (⟨g,g⟩ ⟨h,h⟩).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from mixpose.body import Body
from mixpose.density import peak
from mixpose.objective.base import facing
from mixpose.rigid import transform
from mixpose.search.levels import Level

Floats: TypeAlias = NDArray[np.float64]

_MOST_CELLS = 2_000_000  # of pairs of predicted features in memory at once
_TINY = np.finfo(np.float64).tiny


@dataclass(frozen=True)
class Slope:
    """Values (H,), gradients (H, 6) and curvatures (H, 6, 6) of an objective at H poses."""

    value: Floats
    gradient: Floats
    curvature: Floats


def scores(levels: Sequence[Level], body: Body, poses: Floats, *, whole: bool = False) -> Floats:
    """Matched objective per sensor (L, H) at poses (H, 4, 4).

    Parameters
    ----------
    levels : sequence of Level
    body : Body
    poses : (H, 4, 4) array
    whole : bool
        Whether features out of view count as predicted and not met.  Else a pose gains by moving
        features that meet nothing out of the picture.
    """
    n = len(body.nodes.points)
    rows = max(_MOST_CELLS // (n * n), 1)
    parts = [
        np.array([_share(level, body, poses[start : start + rows], whole) for level in levels])
        for start in range(0, len(poses), rows)
    ]
    return np.concatenate(parts, axis=1) if parts else np.zeros((len(levels), 0))


def _share(level: Level, body: Body, poses: Floats, whole: bool) -> Floats:
    points = transform(poses, body.nodes.points)
    y, seen = level.sensor.project(points)
    seen = seen & facing(level.sensor, poses, points, body.node_normals)
    weights = np.where(seen, body.nodes.weights, 0.0)
    C, _ = level.sample(y)
    product = (weights * C).sum(axis=1)
    norm = _overlaps(y, weights, level.variance)[1]
    if whole:
        unseen = np.where(seen, 0.0, body.nodes.weights)
        norm = norm + (unseen**2).sum(axis=1) * peak(level.variance, y.shape[2])
    return np.asarray(level.weight * product**2 / (level.energy * norm))


def _overlaps(y: Floats, weights: Floats, variance: float) -> tuple[Floats, Floats]:
    """Overlap (H, n, n) of any two predicted features, and their sum ⟨h, h⟩ (H,)."""
    squared = np.zeros((*y.shape[:2], y.shape[1]))
    for k in range(y.shape[2]):
        away = y[:, :, None, k] - y[:, None, :, k]
        squared += away * away
    bells = np.exp(squared * (-0.5 / variance)) * peak(variance, y.shape[2])
    bells *= weights[:, :, None] * weights[:, None, :]
    return bells, np.maximum(bells.sum(axis=(1, 2)), _TINY)


def slopes(levels: Sequence[Level], body: Body, poses: Floats) -> Slope:
    """Second-order models of the matched objective at poses (H, 4, 4).

    For cameras the curvature is that of mean-shift: each feature is drawn to where the
    detections around it lie, and a feature that meets none does not hold the others back.
    For ranges, where features overlap, it is Gauss-Newton's of the residual g − a h.
    """
    value, gradient = np.zeros(len(poses)), np.zeros((len(poses), 6))
    curvature = np.zeros((len(poses), 6, 6))
    points = transform(poses, body.nodes.points)
    arms = points - poses[:, None, :3, 3]
    for level in levels:
        y, by_world, seen = level.sensor.linearise(points)
        seen = seen & facing(level.sensor, poses, points, body.node_normals)
        weights = np.where(seen, body.nodes.weights, 0.0)
        J = _by_pose(by_world, arms).reshape(len(poses), -1, 6)
        C, pull = level.sample(y)
        product = (weights * C).sum(axis=1)
        bells, norm = _overlaps(y, weights, level.variance)
        amplitude = product / norm
        scale = level.weight / level.energy * amplitude
        own = -np.stack(
            [
                (bells * (y[:, :, None, k] - y[:, None, :, k])).sum(axis=2) / level.variance
                for k in range(y.shape[2])
            ],
            axis=-1,
        )
        drawn = weights[..., None] * pull - amplitude[:, None, None] * own
        value += scale * product
        gradient += 2 * scale[:, None] * _applied(J, drawn)
        if y.shape[2] == 1:
            gram = _gram(J, y, bells, level.variance) * amplitude[:, None, None]
            along = _applied(J, own)
            gram -= (amplitude / norm)[:, None, None] * along[:, :, None] * along[:, None, :]
        else:
            met = np.repeat(weights * C, y.shape[2], axis=1) / level.variance
            gram = np.swapaxes(J, 1, 2) @ (J * met[..., None])
        curvature += 2 * scale[:, None, None] * gram
    return Slope(value, gradient, curvature)


def _applied(J: Floats, forces: Floats) -> Floats:
    """Jᵀ f for J (H, n m, 6) and f (H, n, m)."""
    return np.asarray(np.einsum("hak,ha->hk", J, forces.reshape(len(J), -1)))


def _gram(J: Floats, y: Floats, bells: Floats, variance: float) -> Floats:
    """⟨∂h, ∂h⟩ (H, 6, 6) of ranges."""
    away = y[:, :, None, 0] - y[:, None, :, 0]
    kernel = bells * (1 / variance - away * away / variance**2)
    return np.asarray(np.swapaxes(J, 1, 2) @ (kernel @ J))


def _by_pose(by_world: Floats, arms: Floats) -> Floats:
    """Jacobians (H, n, m, 6) by the twist, of those (H, n, m, 3) by world points."""
    J = np.empty((*by_world.shape[:-1], 6))
    x, y, z = arms[..., 0, None], arms[..., 1, None], arms[..., 2, None]
    a, b, c = by_world[..., 0], by_world[..., 1], by_world[..., 2]
    J[..., :3] = by_world
    J[..., 3] = y * c - z * b
    J[..., 4] = z * a - x * c
    J[..., 5] = x * b - y * a
    return J
