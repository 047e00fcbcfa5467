"""Ranges whose features overlap: the likelihood of a pose over all associations.

In one coordinate the features of a body lie close together against their errors, and what a range
belongs to remains in doubt whatever the pose.  The matched objective asks how well densities agree;
where errors are as large as distances of features that wastes information.  Its remedy is the
likelihood itself: with n features in view and M detections of one sensor, every association λ gives
each feature at most one detection and each detection at most one feature,

    L = Σ_λ  Π_met P_D N(offset; 0, s²)  Π_missed (1 − P_D)  Π_rest c/W,

c being the number of false detections to be expected and W the room they have.  The sum over all
associations runs over subsets of features, detection by detection, so that it is exact.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from mixpose.body import Body
from mixpose.constants import constant
from mixpose.judgement import DetectionModel
from mixpose.objective import View, pose_jacobian
from mixpose.records import PointPattern
from mixpose.rigid import transform
from mixpose.sensors import facing

Floats: TypeAlias = NDArray[np.float64]


@dataclass(frozen=True)
class RangeRules:
    """What is believed of single ranges."""

    max_features: int = constant(
        8, "of a body, up to which associations are summed: their subsets double with each"
    )
    stated_degrees: float = constant(
        20.0, "degrees of freedom that σ_ε counts as, where residuals say otherwise"
    )
    min_information: float = constant(
        0.02, "of the information of known labels: what a pose has in any direction"
    )


def are_associated(views: Sequence[View], body: Body, rules: RangeRules = RangeRules()) -> bool:
    """Whether all sensors gave single ranges, of a body of few points."""
    return (
        len(body.nodes.points) == len(body) <= rules.max_features
        and all(view.sensor.dimension == 1 for view in views)
        and all(isinstance(view.observation.pattern, PointPattern) for view in views)
    )


@dataclass(frozen=True)
class AssociationSum:
    """AssociationSums of all sensors, summed at H poses.

    Attributes
    ----------
    log_odds : (H,) float64
        Logarithm of the likelihood, over that of mere clutter.
    gradient : (H, 6) float64
        Of it, by the twist of the pose.
    information : (H, 6, 6) float64
        What the ranges would say if their labels were known.
    met : (H,) float64
        Expected number of detections that belong to features.
    squares : (H,) float64
        Expected sum of their squared offsets, in σ_ε.
    """

    log_odds: Floats
    gradient: Floats
    information: Floats
    met: Floats
    squares: Floats


def sum_associations(
    views: Sequence[View],
    body: Body,
    poses: Floats,
    noise: float = 1.0,
    detection: DetectionModel = DetectionModel(),
) -> AssociationSum:
    """Sum the likelihood over all associations.

    Parameters
    ----------
    views : sequence of View
        For which `are_associated` holds, none with an empty observation.
    body : Body
    poses : (H, 4, 4) array
    noise : float
        Standard deviation of offsets, in σ_ε.
    detection : DetectionModel
    """
    ranges = [_detections(view) for view in views]
    width = max(len(one) for one in ranges)
    world = transform(poses, body.means)
    parts = [_pairs(view, body, poses, world, noise, width, detection) for view in views]
    log_odds, odds, away, J, sigma = (np.stack(column, axis=1) for column in zip(*parts))
    total, shares = _summed(odds.reshape(-1, *odds.shape[2:]))
    shares = shares.reshape(odds.shape)
    weights = shares / (noise * sigma[..., None, None]) ** 2
    known = weights.sum(axis=3)
    return AssociationSum(
        log_odds=(log_odds + np.log(total).reshape(log_odds.shape)).sum(axis=1),
        gradient=np.einsum("hlnj,hlnj,hlnk->hk", weights, away, J),
        information=np.einsum("hln,hlnk,hlnq->hkq", known, J, J),
        met=shares.sum(axis=(1, 2, 3)),
        squares=noise**2 * (weights * away**2).sum(axis=(1, 2, 3)),
    )


def _pairs(
    view: View,
    body: Body,
    poses: Floats,
    world: Floats,
    noise: float,
    width: int,
    detection: DetectionModel,
) -> tuple[Floats, Floats, Floats, Floats, Floats]:
    """One sensor at H poses, with detections that never were for a width alike in all sensors.

    Returns
    -------
    (H,) array
        Logarithm of the odds where every feature is missed.
    (H, n, width) array
        Odds of each feature having each detection, against both being by themselves.
    (H, n, width) array
        Detected minus predicted ranges.
    (H, n, 6) array
        Jacobian of the predicted ranges.
    (H,) array
        σ_ε.
    """
    detections, sigma = _detections(view), view.observation.sigma
    y, by_world, seen = view.sensor.linearise(world)
    seen = seen & facing(view.sensor, poses, world, body.normals)
    J = pose_jacobian(by_world, world - poses[:, None, :3, 3])[..., 0, :]
    probability = detection.probability
    found, expected = len(detections), seen.sum(axis=1)
    false = np.maximum(found - probability * expected, 1 - probability)
    room = max(2 * detection.room * body.radius, 20 * sigma)
    away = np.zeros((*y.shape[:2], width))
    away[..., :found] = detections - y
    odds = np.exp(-0.5 * (away / (noise * sigma)) ** 2) / (np.sqrt(2 * np.pi) * noise * sigma)
    odds *= (probability / (1 - probability) * room / false)[:, None, None]
    odds[~seen] = 0.0
    odds[..., found:] = 0.0
    missed = expected * np.log(1 - probability) + found * np.log(false / found) + found - false
    return missed, odds, away, J, np.full(len(poses), sigma)


def _detections(view: View) -> Floats:
    """Ranges (M,) of one sensor."""
    pattern = view.observation.pattern
    assert isinstance(pattern, PointPattern)
    return np.asarray(pattern.points[pattern.weights > 0, 0])


def _summed(odds: Floats) -> tuple[Floats, Floats]:
    """Sum over associations (H,) and how probable each pair is (H, n, M), of odds (H, n, M).

    From the first detection to the last, the odds of each subset of features being taken by the
    detections so far; and the same backwards.
    """
    count, n, M = odds.shape
    subsets = np.arange(2**n)
    without = [subsets[(subsets >> i) & 1 == 0] for i in range(n)]
    taken = np.zeros((M + 1, count, 2**n))
    taken[0, :, 0] = 1.0
    for j in range(M):
        taken[j + 1] = taken[j]
        for i, rest in enumerate(without):
            taken[j + 1][:, rest | 1 << i] += odds[:, i, j, None] * taken[j][:, rest]
    left, shares = np.ones((count, 2**n)), np.zeros_like(odds)
    total = taken[M].sum(axis=1)
    for j in range(M - 1, -1, -1):
        before = left.copy()
        for i, rest in enumerate(without):
            then = odds[:, i, j, None] * left[:, rest | 1 << i]
            shares[:, i, j] = (taken[j][:, rest] * then).sum(axis=1) / total
            before[:, rest] += then
        left = before
    return total, shares
