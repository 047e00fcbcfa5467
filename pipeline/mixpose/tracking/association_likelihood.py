"""Ranges whose features overlap: the likelihood of a pose over all associations.

In one coordinate the features of a body lie close together against their errors, and what a range
belongs to remains in doubt whatever the pose.  The matched objective asks how well densities agree;
where errors are as large as distances of features that wastes information.  Its remedy is the
likelihood itself, the sum over all associations.  The pose of a frame before is a normal prior, as
wide as it was uncertain and as the body may have moved since.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from mixpose.body import Body
from mixpose.constants import constant
from mixpose.fit import Fit, blur_schedule
from mixpose.judgement import RememberedNoise, ScoredPose, judge, nearest_alike
from mixpose.objective import NormalPrior, View
from mixpose.optimise import NewtonOptions, Quadratic, Sum, Term, ascend
from mixpose.records import Floats, PointPattern
from mixpose.rigid import perturb
from mixpose.tracking.association_sum import AssociationTerm, sum_associations

if TYPE_CHECKING:
    from mixpose.tracking.likelihood import FrameData, Likelihood, Start


@dataclass(frozen=True)
class RangeRules:
    """What is believed of single ranges."""

    max_features: int = constant(
        8, "of a body, up to which associations are summed: their subsets double with each"
    )
    stated_degrees: float = constant(
        20.0, "degrees of freedom that σ_ε counts as, where residuals say otherwise"
    )
    tolerance: float = constant(1e-7, "share of the logarithm that may be left to be gained")
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


def noise_ratio(noise: Floats, rules: RangeRules) -> float:
    """Standard deviation of ranges in σ_ε, by squares and degrees of freedom (2,) so far."""
    squares, degrees = noise + rules.stated_degrees
    return max(1.0, float(np.sqrt(squares / degrees)))


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
        states, options = T[None], NewtonOptions(tolerance=data.rules.ranges.tolerance)
        for width in widths:
            end = ascend(self._posterior(prior, width), states, perturb, data.free, options)
            states = end.states
        return Fit.of(end, data.views, np.outer(widths, data.sigmas).tolist())

    def judge(self, fit: Fit, start: Start) -> ScoredPose:
        """Judge a pose by the sum over all associations, with the prior of the start."""
        data, T, free, model = self.data, fit.T_world_object, self.data.free, self.data.rules
        judged = judge(data.finest, T, free, model.judgement)
        views, detection = data.views, model.judgement.detection
        found = sum_associations(views, data.body, T[None], self.noise, detection)
        before, memory = data.track.residuals.total, model.judgement.noise.memory
        count = int(free.sum())
        degrees = max(float(found.met[0]) - count, 0.0)
        squares = float(found.squares[0]) if degrees else 0.0
        inner = np.ix_(free, free)
        # a direction that the data leave open is as uncertain as anywhere; the posterior holds
        # the prediction already
        posterior = self._posterior(self._prior(start), self.noise)
        information = self._definite(posterior.linearise(T[None]))
        information += np.diag(1 / data.anywhere.spread[free] ** 2)
        covariance = np.zeros((6, 6))
        covariance[inner] = np.linalg.inv(information)
        volume = 0.5 * np.linalg.slogdet(2 * np.pi * covariance[inner])[1]
        known = model.ranges.stated_degrees + float(before[1])
        covariance *= model.judgement.noise.enlargement(count, known)
        log_odds = float(found.log_odds[0])
        return replace(
            judged,
            covariance=covariance,
            log_evidence=log_odds + data.prior(T).log_density + float(volume),
            noise=RememberedNoise(
                ("",), memory * data.track.residuals.of(("",)) + [[squares], [degrees]]
            ),
            spread=np.sqrt(np.diag(covariance)),
        )

    def _prior(self, start: Start) -> NormalPrior | None:
        """What frames before said of a start as surely as this one will."""
        expected = start.prediction
        if expected is None or not expected.is_prior:
            return None
        return NormalPrior(expected.T_world_object, expected.uncertainty, self.data.free)

    def _posterior(self, prior: NormalPrior | None, noise: float) -> Term:
        """Likelihood and prior, with ranges that err by so much, in σ_ε."""
        data, detection = self.data, self.data.rules.judgement.detection
        term = AssociationTerm(data.views, data.body, data.free, noise, detection)
        return term if prior is None else Sum((term, prior))

    def _definite(self, here: Quadratic) -> Floats:
        """Minus the Hessian (k, k) where definite; in directions where not, next to nothing."""
        assert here.hessian is not None
        free, least = self.data.free, self.data.rules.ranges.min_information
        scale = 1 / np.sqrt(
            np.maximum(np.diagonal(here.curvature[0])[free], np.finfo(np.float64).eps)
        )
        hessian = here.hessian[0][np.ix_(free, free)]
        values, vectors = np.linalg.eigh(hessian * scale * scale[:, None])
        bounded = (vectors * np.maximum(values, least)) @ vectors.T
        return np.asarray(bounded / scale / scale[:, None])
