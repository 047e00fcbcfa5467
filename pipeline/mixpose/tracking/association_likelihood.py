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
from mixpose.objective import View, project_body
from mixpose.records import PointPattern

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
    """The likelihood over all associations in all sensors, at H poses.

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
    patterns = [view.observation.pattern for view in views]
    ranges = [one.points[one.weights > 0, 0] for one in patterns if isinstance(one, PointPattern)]
    counts = np.array([len(one) for one in ranges])
    there = np.arange(counts.max()) < counts[:, None]
    detected = np.zeros(there.shape)  # those that never were make widths alike
    detected[there] = np.concatenate(ranges)
    sigma = np.array([[view.observation.sigma] for view in views])
    at = project_body(tuple(view.sensor for view in views), body).project(poses)
    J, away = at.J[..., 0, :], detected[:, None, None] - at.y[..., :1]
    probability, found = detection.probability, counts[:, None]
    expected = at.seen.sum(axis=2)
    false = np.maximum(found - probability * expected, 1 - probability)
    room = np.maximum(2 * detection.room * body.radius, 20 * sigma)
    missed = expected * np.log(1 - probability) + found * np.log(false / found) + found - false
    error = (noise * sigma)[..., None, None]
    odds = np.exp(-0.5 * (away / error) ** 2) / (np.sqrt(2 * np.pi) * error)
    odds *= (probability / (1 - probability) * room / false)[..., None, None]
    odds *= at.seen[..., None] & there[:, None, None]
    total, shares = _summed(odds.reshape(-1, *odds.shape[2:]))
    shares = shares.reshape(odds.shape)
    weights = shares / error**2
    return AssociationSum(
        log_odds=(missed + np.log(total).reshape(missed.shape)).sum(axis=0),
        gradient=np.einsum("lhnj,lhnj,lhnk->hk", weights, away, J),
        information=np.einsum("lhnj,lhnk,lhnq->hkq", weights, J, J),
        met=shares.sum(axis=(0, 2, 3)),
        squares=noise**2 * (weights * away**2).sum(axis=(0, 2, 3)),
    )


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
