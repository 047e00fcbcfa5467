"""The pose of a frame of ranges: the most probable one over all associations.

Ranges err by about as much as the features of a body are apart, so that one frame alone says little
about how the body is turned.  Where frames before it gave a pose, that pose is a Gaussian prior, as
wide as it was uncertain and as the body may have moved since (a Kalman filter whose model of motion
is that the body stays).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from mixpose.body import Body
from mixpose.density import Noise
from mixpose.fit import NormalPrior, blur_schedule
from mixpose.judgement import DetectionModel, Judged, NoiseModel, Prior, Residuals
from mixpose.objective import Quadratic, View
from mixpose.optimise import Ascent, NewtonOptions, ascend
from mixpose.rigid import perturb
from mixpose.tracking.association_likelihood import AssociationSum, RangeRules, sum_associations

Floats: TypeAlias = NDArray[np.float64]

_OPTIONS = NewtonOptions(iterations=30, tolerance=1e-7)
_STEP = 0.01  # of σ_ε: by how much ranges differ for second derivatives, half of their digits
_MIN_INFORMATION = 1e-18  # per squared length or radian: less is as good as none


def noise_ratio(noise: Noise, rules: RangeRules) -> float:
    """Standard deviation of ranges in σ_ε, as residuals of earlier frames show it."""
    stated = Noise(rules.stated_degrees, rules.stated_degrees).joined(noise)
    return max(1.0, float(np.sqrt(stated.variance)))


@dataclass(frozen=True)
class Posterior:
    """Logarithm of the likelihood over all associations, with the prior.

    Attributes
    ----------
    views : sequence of View
        For which `are_associated` holds.
    body : Body
    free : (6,) bool
    noise : float
        Standard deviation of ranges, in σ_ε.
    prior : NormalPrior or None
        What was known before; None: nothing.
    detection : DetectionModel
    """

    views: Sequence[View]
    body: Body
    free: NDArray[np.bool_]
    noise: float
    prior: NormalPrior | None
    detection: DetectionModel

    def climbed(self, T_start: Floats) -> Ascent[Floats]:
        """Climb from a pose (4, 4), at first with ranges that err as far as the prior may."""
        widths = [self.noise]
        if self.prior is not None:
            uncertainty = np.where(self.free, self.prior.uncertainty, 0.0)
            levels = blur_schedule(self.views, self.body, T_start, uncertainty)
            sigmas = [view.observation.sigma for view in self.views]
            ratios = [max(np.divide(level, sigmas).tolist()) for level in levels]
            widths = [ratio for ratio in ratios if ratio > self.noise] + widths
        ascent = Ascent(T_start, 0.0, False, 0)
        for width in widths:
            posterior = replace(self, noise=width)
            ascent = ascend(posterior.linearise, perturb, ascent.state, self.free, _OPTIONS)
        return ascent

    def sums(self, poses: Floats) -> AssociationSum:
        """The likelihood at poses (H, 4, 4)."""
        return sum_associations(self.views, self.body, poses, self.noise, self.detection)

    def linearise(self, T_world_object: Floats) -> Quadratic:
        """Second-order model; the second derivatives are differences of gradients."""
        scale = self._steps()
        steps = scale[:, None] * np.eye(6)[self.free]
        found = self.sums(perturb(T_world_object, np.vstack([np.zeros(6), steps, -steps])))
        here, ahead, behind = np.split(found.gradient, [1, 1 + len(steps)])
        H = np.zeros((6, 6))
        H[self.free] = (behind - ahead) / (2 * scale[:, None])
        value, C = float(found.log_odds[0]), found.information[0]
        model = Quadratic(value, here[0], C, (H + H.T) / 2)
        return model if self.prior is None else self.prior.joined(model, T_world_object)

    def _steps(self) -> Floats:
        """Twists that move ranges by a small part of their error."""
        sigma = self.noise * min(view.observation.sigma for view in self.views)
        arm = float(np.linalg.norm(self.body.means, axis=1).max())
        return np.repeat([_STEP * sigma, _STEP * sigma / max(arm, sigma)], 3)[self.free]


def judge_ranges(
    judged: Judged,
    posterior: Posterior,
    before: Noise,
    known: Prior,
    model: NoiseModel,
    rules: RangeRules,
) -> Judged:
    """Replace covariance, evidence and residuals of a judged pose by those of the associations.

    Parameters
    ----------
    judged : Judged
    posterior : Posterior
        That was climbed to the pose.
    before : Noise
    known : Prior
        What was known of the pose.
    model : NoiseModel
    rules : RangeRules
    """
    T, free = judged.T_world_object, posterior.free
    found = posterior.sums(T[None])
    degrees = max(float(found.met[0]) - int(free.sum()), 0.0)
    noise = Noise(float(found.squares[0]) if degrees else 0.0, degrees)
    inner = np.ix_(free, free)
    information = _definite(posterior.linearise(T), free, rules)
    covariance = np.zeros((6, 6))
    # a direction that the data leave open is as uncertain as before
    covariance[inner] = np.linalg.inv(information[inner] + np.diag(1 / known.spread[free] ** 2))
    volume = 0.5 * np.linalg.slogdet(2 * np.pi * covariance[inner])[1]
    covariance *= model.enlargement(int(free.sum()), rules.stated_degrees + before.degrees)
    return replace(
        judged,
        covariance=covariance,
        log_evidence=float(found.log_odds[0]) + known.log_density + float(volume),
        residuals=Residuals({"": before.faded(model.memory).joined(noise)}),
        spread=np.sqrt(np.diag(covariance)),
        value=float(found.log_odds[0]),
    )


def _definite(here: Quadratic, free: NDArray[np.bool_], rules: RangeRules) -> Floats:
    """Minus the Hessian where it is definite; in directions where it is not, next to nothing."""
    assert here.hessian is not None
    inner = np.ix_(free, free)
    information = np.zeros((6, 6))
    scale = 1 / np.sqrt(np.maximum(np.diagonal(here.curvature)[free], _MIN_INFORMATION))
    values, vectors = np.linalg.eigh(here.hessian[inner] * scale * scale[:, None])
    bounded = (vectors * np.maximum(values, rules.min_information)) @ vectors.T
    information[inner] = bounded / scale / scale[:, None]
    return information
