"""Ranges whose features overlap: the likelihood of a pose over all associations.

In one coordinate the features of a body lie close together against their errors, and what a range
belongs to remains in doubt whatever the pose.  The matched objective asks how well densities agree;
where errors are as large as distances of features that wastes information.  Its remedy is the
likelihood itself: with n features in view and M detections of one sensor, every association λ gives
each feature at most one detection and each detection at most one feature,

    L = Σ_λ  Π_met P_D N(offset; 0, s²)  Π_missed (1 − P_D)  Π_rest c/W,

c being the number of false detections to be expected and W the room they have.  The pose of a frame
before is a Gaussian prior, as wide as it was uncertain and as the body may have moved since.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import TYPE_CHECKING

import numpy as np

from mixpose.body import Body
from mixpose.constants import constant
from mixpose.fit import Fit, NormalPrior, blur_schedule
from mixpose.judgement import (
    Case,
    DetectionModel,
    RememberedNoise,
    ScoredPose,
    judge,
    nearest_alike,
)
from mixpose.matching import Noise
from mixpose.objective import Quadratic, View, project_body
from mixpose.optimise import Ascent, NewtonOptions, ascend
from mixpose.records import PointPattern
from mixpose.rigid import Floats, perturb

if TYPE_CHECKING:
    from mixpose.tracking.likelihood import FrameData, Likelihood, Start

_OPTIONS = NewtonOptions(iterations=30, tolerance=1e-7)
_STEP = 0.01  # of σ_ε: by how much ranges differ for second derivatives, half of their digits
_MIN_INFORMATION = 1e-18  # per squared length or radian: less is as good as none


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
    """The likelihood over all associations in all sensors, at H poses."""

    log_odds: Floats  # (H,), logarithm of the likelihood, over that of mere clutter
    gradient: Floats  # (H, 6), of it, by the twist of the pose
    information: Floats  # (H, 6, 6), what the ranges would say if their labels were known
    met: Floats  # (H,), expected number of detections that belong to features
    squares: Floats  # (H,), expected sum of their squared offsets, in σ_ε²


def sum_associations(
    views: Sequence[View],
    body: Body,
    poses: Floats,
    noise: float = 1.0,
    detection: DetectionModel = DetectionModel(),
) -> AssociationSum:
    """Sum the likelihood over all associations at poses (H, 4, 4).

    For views `are_associated` holds, none has an empty observation; `noise` is the standard
    deviation of offsets, in σ_ε.
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

    Exact: from the first detection to the last, the odds of each subset of features being taken by
    the detections so far; and the same backwards.
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


def noise_ratio(noise: Noise, rules: RangeRules) -> float:
    """Standard deviation of ranges in σ_ε, as residuals of earlier frames show it."""
    stated = Noise(rules.stated_degrees, rules.stated_degrees).joined(noise)
    return max(1.0, float(np.sqrt(stated.variance)))


@dataclass(frozen=True, eq=False)
class AssociationLikelihood:
    """All associations of single ranges with the features of a small body."""

    data: FrameData
    matched: Callable[[FrameData], Likelihood]  # leads from starts of which nothing is known

    @property
    def knows_detections(self) -> bool:
        """Whether each feature's detection is known, so that one may be left out."""
        return False

    @cached_property
    def noise(self) -> float:
        """Standard deviation of ranges, in σ_ε."""
        return noise_ratio(self.data.track.residuals.total, self.data.rules.ranges)

    def fit(self, start: Start) -> Fit:
        """Climb the posterior, at first with ranges that err as far as the prior may."""
        T, data, prior, widths = start.T_world_object, self.data, self._prior(start), [self.noise]
        if prior is None:
            T = self.matched(data).fit(start).T_world_object
            T = nearest_alike(T, data.body, data.T_reference)
        else:
            uncertainty = np.where(data.free, prior.uncertainty, 0.0)
            levels = blur_schedule(data.views, data.body, T, uncertainty)
            ratios = [max(np.divide(level, data.sigmas).tolist()) for level in levels]
            widths = [ratio for ratio in ratios if ratio > self.noise] + widths
        found = Ascent(T, 0.0, False, 0)
        for width in widths:
            posterior = partial(self._posterior, prior, width)
            found = ascend(posterior, perturb, found.state, data.free, _OPTIONS)
        return Fit.of(found, data.views, np.outer(widths, data.sigmas).tolist())

    def judge(self, fit: Fit, start: Start) -> ScoredPose:
        """Judge a pose by the sum over all associations, with the prior of the start."""
        data, T, free, model = self.data, fit.T_world_object, self.data.free, self.data.rules
        judged = judge(Case(data.finest, T), free, model.judgement)
        views, detection = data.views, model.judgement.detection
        found = sum_associations(views, data.body, T[None], self.noise, detection)
        before, memory = data.track.residuals.total, model.judgement.noise.memory
        count = int(free.sum())
        degrees = max(float(found.met[0]) - count, 0.0)
        noise = Noise(float(found.squares[0]) if degrees else 0.0, degrees)
        inner = np.ix_(free, free)
        # a direction that the data leave open is as uncertain as anywhere; the posterior holds
        # the prediction already
        information = self._definite(self._posterior(self._prior(start), self.noise, T))
        information += np.diag(1 / data.anywhere.spread[free] ** 2)
        covariance = np.zeros((6, 6))
        covariance[inner] = np.linalg.inv(information)
        volume = 0.5 * np.linalg.slogdet(2 * np.pi * covariance[inner])[1]
        degrees = model.ranges.stated_degrees + before.degrees
        covariance *= model.judgement.noise.enlargement(count, degrees)
        log_odds = float(found.log_odds[0])
        return replace(
            judged,
            covariance=covariance,
            log_evidence=log_odds + data.prior(T).log_density + float(volume),
            noise=RememberedNoise(
                ("",), memory * data.track.residuals.of(("",)) + [[noise.squares], [noise.degrees]]
            ),
            spread=np.sqrt(np.diag(covariance)),
        )

    def _prior(self, start: Start) -> NormalPrior | None:
        """What frames before said of a start as surely as this one will."""
        expected = start.prediction
        if expected is None or not expected.is_prior:
            return None
        return NormalPrior(expected.T_world_object, expected.uncertainty, self.data.free)

    def _posterior(
        self, prior: NormalPrior | None, noise: float, T_world_object: Floats
    ) -> Quadratic:
        """Second-order model; the second derivatives are differences of gradients.

        Steps move ranges by a small part of their error.
        """
        data, free, sigma = self.data, self.data.free, noise * min(self.data.sigmas)
        arm = float(np.linalg.norm(data.body.means, axis=1).max())
        scale = np.repeat([_STEP * sigma, _STEP * sigma / max(arm, sigma)], 3)[free]
        steps = scale[:, None] * np.eye(6)[free]
        poses = perturb(T_world_object, np.vstack([np.zeros(6), steps, -steps]))
        detection = data.rules.judgement.detection
        found = sum_associations(data.views, data.body, poses, noise, detection)
        here, ahead, behind = np.split(found.gradient, [1, 1 + len(steps)])
        H = np.zeros((6, 6))
        H[free] = (behind - ahead) / (2 * scale[:, None])
        value, C = float(found.log_odds[0]), found.information[0]
        model = Quadratic(value, here[0], C, (H + H.T) / 2)
        return model if prior is None else prior.joined(model, T_world_object)

    def _definite(self, here: Quadratic) -> Floats:
        """Minus the Hessian (k, k) where definite; in directions where not, next to nothing."""
        assert here.hessian is not None
        free, least = self.data.free, self.data.rules.ranges.min_information
        scale = 1 / np.sqrt(np.maximum(np.diagonal(here.curvature)[free], _MIN_INFORMATION))
        values, vectors = np.linalg.eigh(here.hessian[np.ix_(free, free)] * scale * scale[:, None])
        bounded = (vectors * np.maximum(values, least)) @ vectors.T
        return np.asarray(bounded / scale / scale[:, None])
