"""The pose of a frame of ranges: the most probable one over all labellings.

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
from mixpose.estimation.annealing import ladder
from mixpose.estimation.assessment import MEMORY, Assessment
from mixpose.estimation.evidence import Noise, Prior, enlargement
from mixpose.estimation.labelling import label
from mixpose.estimation.track import Prediction
from mixpose.objective import Quadratic, View
from mixpose.optimise import NewtonOptions, ascend
from mixpose.rigid import perturb, twist_between

Floats: TypeAlias = NDArray[np.float64]

_OPTIONS = NewtonOptions(iterations=30, tolerance=1e-7)
_STEP = 0.01  # of σ_ε: by how much ranges differ for second derivatives
_LEAST_INFORMATION = 1e-18  # per squared length or radian: less is as good as none
_LEAST_SHARE = 0.02  # of the information of known labels: what a pose has in any direction
_STATED = 20.0  # degrees of freedom that σ_ε counts as, where residuals say otherwise


@dataclass(frozen=True)
class Ranged:
    """A pose found from ranges.

    Attributes
    ----------
    T_world_object : (4, 4) float64
    log_odds : float
        Of the frame's likelihood against clutter, without what was known before.
    information : (6, 6) float64
        Minus the second derivative of the log posterior; zero where not free.
    noise : Noise
        Residuals of the frame.
    """

    T_world_object: Floats
    log_odds: float
    information: Floats
    noise: Noise


def noise_ratio(noise: Noise) -> float:
    """Standard deviation of ranges in σ_ε, as residuals of earlier frames show it."""
    stated = Noise(_STATED, _STATED).joined(noise)
    return max(1.0, float(np.sqrt(stated.squares / stated.degrees)))


def fit_ranges(
    views: Sequence[View],
    body: Body,
    T_start: Floats,
    free: NDArray[np.bool_],
    noise: float,
    prior: Prediction | None = None,
) -> Ranged:
    """Climb the posterior of all labellings.

    Parameters
    ----------
    views : sequence of View
        For which `are_labelled` holds.
    body : Body
    T_start : (4, 4) array
        Where to begin.
    free : (6,) bool
    noise : float
        Standard deviation of ranges, in σ_ε.
    prior : Prediction or None
        What was known before; None: nothing.
    """
    widths = [noise]
    if prior is not None:
        levels = ladder(views, body, T_start, np.where(free, prior.uncertainty, 0.0))
        ratios = [max(s / v.observation.sigma for s, v in zip(level, views)) for level in levels]
        widths = [ratio for ratio in ratios if ratio > noise] + widths
    T = T_start
    for width in widths:
        posterior = _Posterior(views, body, free, width, prior)
        T = ascend(posterior.linearise, perturb, T, free, _OPTIONS).state
    here = posterior.linearise(T)
    found = label(views, body, T[None], noise)
    degrees = max(float(found.met[0]) - int(free.sum()), 0.0)
    return Ranged(
        T,
        float(found.log_odds[0]),
        _definite(here, free),
        Noise(float(found.squares[0]) if degrees else 0.0, degrees),
    )


@dataclass(frozen=True)
class _Posterior:
    """Logarithm of the likelihood over all labellings, with the prior."""

    views: Sequence[View]
    body: Body
    free: NDArray[np.bool_]
    noise: float
    prior: Prediction | None

    def linearise(self, T_world_object: Floats) -> Quadratic:
        """Second-order model; the second derivatives are differences of gradients."""
        scale = self._steps()
        steps = scale[:, None] * np.eye(6)[self.free]
        twists = np.vstack([np.zeros(6), steps, -steps])
        found = label(self.views, self.body, perturb(T_world_object, twists), self.noise)
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
    judged: Assessment, found: Ranged, free: NDArray[np.bool_], before: Noise, prior: Prior
) -> Assessment:
    """Replace covariance, evidence and residuals of an assessment by those of the labellings."""
    inner = np.ix_(free, free)
    noise = before.joined(found.noise, MEMORY)
    covariance = np.zeros((6, 6))
    # a direction that the data leave open is as uncertain as before
    anywhere = np.diag(1 / prior.spread[free] ** 2)
    covariance[inner] = np.linalg.inv(found.information[inner] + anywhere)
    volume = 0.5 * np.linalg.slogdet(2 * np.pi * covariance[inner])[1]
    return replace(
        judged,
        covariance=covariance * enlargement(int(free.sum()), _STATED + before.degrees),
        log_evidence=found.log_odds + prior.log_density + float(volume),
        noise=noise,
    )


def _definite(here: Quadratic, free: NDArray[np.bool_]) -> Floats:
    """Minus the Hessian where it is definite; in directions where it is not, next to nothing."""
    assert here.hessian is not None
    inner = np.ix_(free, free)
    information = np.zeros((6, 6))
    scale = 1 / np.sqrt(np.maximum(np.diagonal(here.curvature)[free], _LEAST_INFORMATION))
    values, vectors = np.linalg.eigh(here.hessian[inner] * scale * scale[:, None])
    bounded = (vectors * np.maximum(values, _LEAST_SHARE)) @ vectors.T
    information[inner] = bounded / scale / scale[:, None]
    return information
