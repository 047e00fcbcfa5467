"""What one frame says of a pose: how to fit it near a start, and how to judge it.

Matched densities, or, for single ranges of small bodies, the sum over all associations: where
errors are as large as distances of features, densities waste information.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TypeAlias

import numpy as np

from mixpose.fit import Fit, blur_schedule, fit_near
from mixpose.judgement import RememberedNoise, ScoredPose, judge, nearest_alike
from mixpose.objective import NormalPrior
from mixpose.optimise import Ascent, NewtonOptions, Quadratic, Sum, Term, ascend
from mixpose.records import Floats
from mixpose.rigid import perturb
from mixpose.tracking.associations import (
    AssociationTerm,
    are_associated,
    noise_ratio,
    sum_associations,
)
from mixpose.tracking.frame import Frame, given
from mixpose.tracking.in_motion import fit_in_motion, with_motion_unknown
from mixpose.tracking.track import Prediction


@dataclass(frozen=True)
class Start:
    """Where a fit begins."""

    T_world_object: Floats  # (4, 4)
    uncertainty: Floats | None = None  # (6,), standard deviations; None: the pose is there already
    prediction: Prediction | None = None  # that it comes from
    left_out: Mapping[str, str] = field(default_factory=dict)  # sensors, and why
    T_moved: Floats | None = None  # a pose that has moved as this must have, and was as likely
    blur: float = 1.0  # in σ_ε, that the fit begins at


class MatchedLikelihood:
    """Matched densities of all sensors."""

    def __init__(self, frame: Frame) -> None:
        self.frame = frame
        # whether each feature's detection is known, so that one may be left out
        self.knows_detections = frame.options.objective == "matched"
        self._climbed: dict[frozenset[str], list[Fit]] = {}  # by sensors left out

    def fit(self, start: Start, begun: Ascent | None = None) -> Fit:
        """Ascend the session's objective through narrowing blurs; `begun` at σ_ε already."""
        uncertainty = start.uncertainty
        if uncertainty is None:
            return Fit(start.T_world_object)
        frame, known = self.frame.without(start.left_out), self.frame.begun
        if known is not None and known.fit and start.prediction is frame.predictions[0]:
            return known.fit
        timed, model = frame.is_timed, frame.rules.judgement
        climbed = self._climbed.setdefault(frozenset(start.left_out), [])
        spread = given(frame, start.T_world_object) if self.knows_detections else 0.0

        def climb(seen: Frame, T_start: Floats, beside: float = 0.0) -> Fit:
            return fit_near(
                seen.views,
                seen.body,
                T_start,
                uncertainty,
                seen.options,
                seen.samples,
                finest=seen.finest,
                begun=begun,
                climbed=None if timed else climbed,
                blur=start.blur,
                noise=seen.noise,
                beside=max(beside, spread),
                errors=model.noise.errors,
                association=model.association,
                rules=seen.rules.fit,
            )

        if timed:
            return fit_in_motion(frame, start.T_world_object, climb)
        return climb(frame, start.T_world_object)

    def judge(self, fit: Fit, start: Start) -> ScoredPose:
        """Judge a pose by matched densities at σ_ε, and take what is left out for missed."""
        begun, frame, motion = self.frame.begun, self.frame, fit.motion
        if begun is not None and fit is begun.fit and begun.judged is not None:
            return begun.judged
        T = nearest_alike(fit.T_world_object, frame.body, frame.T_reference)
        if frame.is_timed:
            motion = motion or frame.expected(T).at(T)
            frame = frame.in_motion(motion)
        prior = frame.prior(T if start.T_moved is None else start.T_moved)
        is_seen = T is fit.T_world_object and motion is None and not start.left_out
        judged = judge(
            frame.finest,
            T,
            frame.free,
            frame.rules.judgement,
            before=frame.track.residuals,
            prior=prior,
            left_out=start.left_out,
            matches=fit.matches if is_seen else None,
            noise=fit.noise if is_seen else None,
        )
        return judged if motion is None else with_motion_unknown(judged, frame, motion)


class AssociationLikelihood:
    """All associations of single ranges with the features of a small body.

    The pose of a frame before is a normal prior, widened as the body may have moved since.
    """

    knows_detections = False

    def __init__(self, frame: Frame) -> None:
        self.frame = frame
        self._noise = noise_ratio(frame.track.residuals.total, frame.rules.ranges)  # in σ_ε

    def fit(self, start: Start) -> Fit:
        """Climb the posterior, at first with ranges that err as far as the prior may."""
        T, frame, known, widths = start.T_world_object, self.frame, start.prediction, [self._noise]
        if known is None or not known.is_prior:  # nothing is known: matched densities lead there
            T = MatchedLikelihood(frame).fit(start).T_world_object
            T = nearest_alike(T, frame.body, frame.T_reference)
        else:
            uncertainty = np.where(frame.free, known.uncertainty, 0.0)
            levels = blur_schedule(frame.views, frame.body, T, uncertainty)
            ratios = [max(np.divide(level, frame.sigmas).tolist()) for level in levels]
            widths = [ratio for ratio in ratios if ratio > self._noise] + widths
        states, options = T[None], NewtonOptions(tolerance=1e-7)
        for width in widths:
            end = ascend(self._posterior(start, width), states, perturb, frame.free, options)
            states = end.states
        return Fit.of(end, frame.views, np.outer(widths, frame.sigmas).tolist())

    def judge(self, fit: Fit, start: Start) -> ScoredPose:
        """Judge a pose by the sum over all associations, with the prior of the start."""
        frame, T, free, rules = self.frame, fit.T_world_object, self.frame.free, self.frame.rules
        model, before = rules.judgement, frame.track.residuals
        found = sum_associations(frame.views, frame.body, T[None], self._noise, model.detection)
        count, inner = int(free.sum()), np.ix_(free, free)
        degrees = max(float(found.met[0]) - count, 0.0)
        squares = float(found.squares[0]) if degrees else 0.0
        remembered = model.noise.memory * before.of(("",)) + [[squares], [degrees]]
        # a direction that all of it leaves open is as uncertain as anywhere
        information = self._definite(self._posterior(start, self._noise).linearise(T[None]))
        information += np.diag(1 / frame.anywhere.spread[free] ** 2)
        covariance = np.zeros((6, 6))
        covariance[inner] = np.linalg.inv(information)
        volume = 0.5 * np.linalg.slogdet(2 * np.pi * covariance[inner])[1]
        degrees = rules.ranges.stated_degrees + float(before.total[1])
        covariance *= model.noise.enlargement(count, degrees)
        log_density = frame.prior(T).log_density
        return replace(
            judge(frame.finest, T, free, model),
            covariance=covariance,
            log_evidence=float(found.log_odds[0]) + log_density + float(volume),
            noise=RememberedNoise(("",), remembered),
            spread=np.sqrt(np.diag(covariance)),
        )

    def _posterior(self, start: Start, noise: float) -> Sum:
        """Likelihood and prior, of ranges that err by so much in σ_ε."""
        frame, known, detection = self.frame, start.prediction, self.frame.rules.judgement.detection
        terms: list[Term] = [AssociationTerm(frame.views, frame.body, frame.free, noise, detection)]
        if known is not None and known.is_prior:
            terms.append(NormalPrior(known.T_world_object, known.uncertainty, frame.free))
        return Sum(tuple(terms))

    def _definite(self, here: Quadratic) -> Floats:
        """Minus the Hessian (k, k) where definite; in directions where not, next to nothing."""
        assert here.hessian is not None
        free, least = self.frame.free, self.frame.rules.ranges.min_information
        diagonal = np.diagonal(here.curvature[0])[free]
        scale = 1 / np.sqrt(np.maximum(diagonal, np.finfo(np.float64).eps))
        hessian = here.hessian[0][np.ix_(free, free)]
        values, vectors = np.linalg.eigh(hessian * scale * scale[:, None])
        bounded = (vectors * np.maximum(values, least)) @ vectors.T
        return np.asarray(bounded / scale / scale[:, None])


Likelihood: TypeAlias = MatchedLikelihood | AssociationLikelihood


def likelihood_of(frame: Frame) -> Likelihood:
    """The likelihood for a frame."""
    is_matched = frame.options.objective == "matched"
    if is_matched and are_associated(frame.views, frame.body, frame.rules.ranges):
        return AssociationLikelihood(frame)
    return MatchedLikelihood(frame)
