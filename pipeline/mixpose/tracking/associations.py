"""Ranges whose features overlap: the likelihood of a pose over all associations.

What a range belongs to remains in doubt whatever the pose.  With n features in view and M
detections of one sensor, every association λ gives each feature at most one detection and the
reverse,

    L = Σ_λ  Π_met P_D N(offset; 0, s²)  Π_missed (1 − P_D)  Π_rest c/W,

c being the number of false detections to be expected and W the room they have.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from mixpose.body import Body
from mixpose.constants import constant
from mixpose.judgement import DetectionModel
from mixpose.objective import View, project_body
from mixpose.optimise import Quadratic
from mixpose.records import Floats, Mask, PointPattern
from mixpose.rigid import perturb


@dataclass(frozen=True)
class RangeRules:
    """What is believed of single ranges."""

    max_features: int = constant(8, "of a body: the subsets that are summed double with each")
    stated_degrees: float = constant(20.0, "degrees of freedom that σ_ε counts as, as stated")
    min_information: float = constant(0.02, "of that of known labels, which any direction has")


def are_associated(views: Sequence[View], body: Body, rules: RangeRules = RangeRules()) -> bool:
    """Whether all sensors gave single ranges, of a body of few points."""
    return (
        len(body.nodes.points) == len(body) <= rules.max_features
        and all(view.sensor.dimension == 1 for view in views)
        and all(isinstance(view.observation.pattern, PointPattern) for view in views)
    )


def noise_ratio(noise: Floats, rules: RangeRules) -> float:
    """Standard deviation of ranges in σ_ε, by squares and degrees of freedom (2,) so far."""
    squares, degrees = noise + rules.stated_degrees
    return max(1.0, float(np.sqrt(squares / degrees)))


class AssociationSum(NamedTuple):
    """The likelihood over all associations in all sensors, at H poses."""

    log_odds: Floats  # (H,), logarithm of the likelihood, over that of mere clutter
    gradient: Floats  # (H, 6), of it, by the twist of the pose
    information: Floats  # (H, 6, 6), what the ranges would say if their labels were known
    met: Floats  # (H,), expected number of detections that belong to features
    squares: Floats  # (H,), expected sum of their squared offsets, in σ_ε²


def sum_associations(
    views: Sequence[View],  # `are_associated`, none with an empty observation
    body: Body,
    poses: Floats,  # (H, 4, 4)
    noise: float = 1.0,  # standard deviation of offsets, in σ_ε
    detection: DetectionModel = DetectionModel(),
) -> AssociationSum:
    """Sum the likelihood over all associations at poses."""
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

    From the first detection to the last, the odds of each subset of features being taken so far;
    and the same backwards.
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


@dataclass(frozen=True, eq=False)
class AssociationTerm:
    """Logarithm of `sum_associations`, whose second derivatives are differences of gradients."""

    views: Sequence[View]
    body: Body
    free: Mask
    noise: float
    detection: DetectionModel

    def linearise(self, poses: Floats) -> Quadratic:
        """Second-order models at poses (H, 4, 4)."""
        free, count = self.free, len(poses)
        error = self.noise * min(view.observation.sigma for view in self.views)
        arm = float(np.linalg.norm(self.body.means, axis=1).max())
        # steps that move ranges by a hundredth of their error: half of the digits are left
        scale = 0.01 * np.repeat([error, error / max(arm, error)], 3)[free]
        steps = scale[:, None] * np.eye(6)[free]
        twists = np.vstack([np.zeros(6), steps, -steps])
        around = perturb(poses[:, None], twists).reshape(-1, 4, 4)
        found = sum_associations(self.views, self.body, around, self.noise, self.detection)
        gradients = found.gradient.reshape(count, -1, 6)
        here, ahead, behind = np.split(gradients, [1, 1 + len(steps)], axis=1)
        H = np.zeros((count, 6, 6))
        H[:, free] = (behind - ahead) / (2 * scale[:, None])
        at = slice(None, None, len(twists))
        H = (H + H.swapaxes(1, 2)) / 2
        return Quadratic(found.log_odds[at], here[:, 0], found.information[at], H)
