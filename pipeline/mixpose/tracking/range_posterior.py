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
from mixpose.fit import blur_schedule
from mixpose.judgement import DetectionModel, Judged, NoiseModel, Prior, Residuals
from mixpose.objective import Quadratic, View
from mixpose.optimise import Ascent, NewtonOptions, ascend
from mixpose.rigid import perturb, twist_between
from mixpose.tracking.association_likelihood import RangeRules, sum_associations
from mixpose.tracking.track import Prediction

Floats: TypeAlias = NDArray[np.float64]

_OPTIONS = NewtonOptions(iterations=30, tolerance=1e-7)
_STEP = 0.01  # of σ_ε: by how much ranges differ for second derivatives, half of their digits
_MIN_INFORMATION = 1e-18  # per squared length or radian: less is as good as none


def noise_ratio(noise: Noise, rules: RangeRules) -> float:
    """Standard deviation of ranges in σ_ε, as residuals of earlier frames show it."""
    stated = Noise(rules.stated_degrees, rules.stated_degrees).joined(noise)
    return max(1.0, float(np.sqrt(stated.variance)))


def fit_ranges(
    views: Sequence[View],
    body: Body,
    T_start: Floats,
    free: NDArray[np.bool_],
    noise: float,
    prior: Prediction | None,
    detection: DetectionModel,
) -> Ascent[Floats]:
    """Climb the posterior of all associations.

    Parameters
    ----------
    views : sequence of View
        For which `are_associated` holds.
    body : Body
    T_start : (4, 4) array
        Where to begin.
    free : (6,) bool
    noise : float
        Standard deviation of ranges, in σ_ε.
    prior : Prediction or None
        What was known before; None: nothing.
    detection : DetectionModel
    """
    widths = [noise]
    if prior is not None:
        levels = blur_schedule(views, body, T_start, np.where(free, prior.uncertainty, 0.0))
        ratios = [max(s / v.observation.sigma for s, v in zip(level, views)) for level in levels]
        widths = [ratio for ratio in ratios if ratio > noise] + widths
    ascent = Ascent(T_start, 0.0, False, 0)
    for width in widths:
        posterior = Posterior(views, body, free, width, prior, detection)
        ascent = ascend(posterior.linearise, perturb, ascent.state, free, _OPTIONS)
    return ascent


@dataclass(frozen=True)
class Posterior:
    """Logarithm of the likelihood over all associations, with the prior."""

    views: Sequence[View]
    body: Body
    free: NDArray[np.bool_]
    noise: float
    prior: Prediction | None
    detection: DetectionModel

    def linearise(self, T_world_object: Floats) -> Quadratic:
        """Second-order model; the second derivatives are differences of gradients."""
        scale = self._steps()
        steps = scale[:, None] * np.eye(6)[self.free]
        twists = np.vstack([np.zeros(6), steps, -steps])
        poses = perturb(T_world_object, twists)
        found = sum_associations(self.views, self.body, poses, self.noise, self.detection)
        here, ahead, behind = np.split(found.gradient, [1, 1 + len(steps)])
        H = np.zeros((6, 6))
        H[self.free] = (behind - ahead) / (2 * scale[:, None])
        H = (H + H.T) / 2
        value, gradient, curvature = found.log_odds[0], here[0], found.information[0]
        if self.prior is not None:
            P = np.diag(np.where(self.free, 1 / np.maximum(self.prior.uncertainty, 1e-12) ** 2, 0))
            away = twist_between(self.prior.T_world_object, T_world_object)
            value, gradient = value - 0.5 * away @ P @ away, gradient - P @ away
            curvature, H = curvature + P, H + P
        return Quadratic(float(value), gradient, curvature, H)

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
    found = sum_associations(
        posterior.views, posterior.body, T[None], posterior.noise, posterior.detection
    )
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
