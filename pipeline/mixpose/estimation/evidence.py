"""How sure a pose is: covariance, and evidence that the body is there at all.

Noise.  Offsets of met features from their prediction, in units of each sensor's σ_ε, have one
unknown common variance φ².  It is estimated from the frame's residuals and those of frames before
it.  With ν degrees of freedom the estimate itself is uncertain: the covariance is enlarged so
that its 95 % ellipsoid is that of the F distribution with (d, ν) degrees, d directions being
free.  For many degrees of freedom nothing is added.

Evidence.  Either the body is there at this pose, or everything seen is clutter.  The log of the
odds is a sum over the features in view,

    met:      ln P_D + ln N(offset; 0, s²) − ln ρ,       missed:   ln (1 − P_D),

with the probability of detection P_D and the density ρ of observed features.  A pose is chosen to
fit, and pays for that freedom in one of two ways; the cheaper counts.

* By volume: the odds are integrated over the pose by Laplace's method, + ½ ln det(2π Cov)
  + ln p(pose).  The prior p is flat over everything that can be seen, or Gaussian around what a
  track predicts.
* By count: a pose is fixed by as many features as it has coordinates (three in a camera).  These
  fit whatever they are, so they earn nothing, and the logarithm of the number of ways to choose
  them among what was observed is taken off.

The more clutter there is, the more features must agree.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri, fdtri, gammaln

from mixpose.body import Body
from mixpose.estimation.meeting import Meeting

Floats: TypeAlias = NDArray[np.float64]

DETECTION = 0.75
"""P_D, probability that a feature in view is detected."""

_LOG_UNSEEN = -0.7  # bodies are in view as a rule: half, for each feature that is not

_TYPICAL_NOISE = (
    0.2  # of σ_ε, what centres of blobs err by; believed only where evidence is weighed
)
_TYPICAL_DEGREES = 4.0
_LEAST_NOISE = 1e-3  # of σ_ε: float32 densities do not resolve residuals below
_LEAST_INFORMATION = 1e-18  # per squared length or radian: less is as good as none
_CONFIDENCE = 0.95
ROOM = 10.0
"""Radii of the body: how far a position may be, where nothing is known before."""


@dataclass(frozen=True)
class Noise:
    """Sum of squared residuals in σ_ε, and its degrees of freedom."""

    squares: float = 0.0
    degrees: float = 0.0

    def joined(self, other: Noise, memory: float = 1.0) -> Noise:
        """Add another noise to what is remembered of the present one."""
        return Noise(memory * self.squares + other.squares, memory * self.degrees + other.degrees)


@dataclass(frozen=True)
class Prior:
    """What is known of a pose before its frame.

    Attributes
    ----------
    log_density : float
        Logarithm of the probability density of the pose, per length and radian of each free
        direction.
    spread : (6,) float64
        How uncertain each direction is; matters where the data leave one open.
    """

    log_density: float
    spread: Floats


def flat_prior(body: Body, free: NDArray[np.bool_]) -> Prior:
    """Nothing is known: anywhere within ten radii of the body, turned in any way."""
    room = ROOM * body.radius
    turns = int(free[3:].sum())
    rotations = 8 * np.pi**2 if turns == 3 else (2 * np.pi) ** turns
    volume = room ** int(free[:3].sum()) * rotations / len(body.symmetries)
    return Prior(-float(np.log(volume)), np.repeat([room, np.pi], 3))


def information_of(meetings: Sequence[Meeting]) -> Floats:
    """Σ_l Σ_i J_iᵀ J_i / σ_l² over the met features: (6, 6), for noise of one σ."""
    information = np.zeros((6, 6))
    for one in meetings:
        weighted = one.J * one.shares[:, None, None]
        information += weighted.reshape(-1, 6).T @ one.J.reshape(-1, 6) / one.sigma**2
    return information


def noise_of(meetings: Sequence[Meeting], free: NDArray[np.bool_]) -> Noise:
    """Residuals of a frame, with the degrees of freedom that the pose has left."""
    measurements = sum(one.measurements for one in meetings)
    degrees = max(measurements - int(free.sum()), 0.0)
    return Noise(sum(one.squares for one in meetings) if degrees else 0.0, degrees)


def covariance_of(information: Floats, noise: Noise, free: NDArray[np.bool_]) -> Floats:
    """Covariance of a pose (6, 6), zero where it is not free.

    Directions that the data leave open get the variance that their information says: large, and
    at most what float64 can invert.
    """
    covariance = np.zeros((6, 6))
    inner = information[np.ix_(free, free)]
    scale = 1.0 / np.sqrt(np.maximum(np.diag(inner), _LEAST_INFORMATION))
    values, vectors = np.linalg.eigh(inner * scale * scale[:, None])
    inverse = (vectors / np.maximum(values, 1e-12)) @ vectors.T * scale * scale[:, None]
    variance = noise.squares / noise.degrees if noise.degrees >= 1 else _TYPICAL_NOISE**2
    variance = max(variance, _LEAST_NOISE**2) * enlargement(int(free.sum()), noise.degrees)
    covariance[np.ix_(free, free)] = variance * (inverse + inverse.T) / 2
    return covariance


def enlargement(directions: int, degrees: float) -> float:
    """Factor that makes the Gaussian 95 % ellipsoid as large as that of the F distribution."""
    if directions == 0:
        return 1.0
    tail = fdtri(directions, max(degrees, 1.0), _CONFIDENCE)
    return float(directions * tail / chdtri(directions, 1 - _CONFIDENCE))


def log_evidence(
    meetings: Sequence[Meeting],
    information: Floats,
    noise: Noise,
    free: NDArray[np.bool_],
    prior: Prior,
    blind: float = 0.0,
) -> float:
    """Logarithm of the odds for the body at a pose against mere clutter.

    Parameters
    ----------
    meetings : sequence of Meeting
    information : (6, 6) array
        For noise of one σ.
    noise : Noise
    free : (6,) bool
    prior : Prior
    blind : float
        Number of features in sensors that have none of the body in view.
    """
    if not any(one.shares.any() for one in meetings):
        return -np.inf
    typical = Noise(_TYPICAL_DEGREES * _TYPICAL_NOISE**2, _TYPICAL_DEGREES).joined(noise)
    variance = typical.squares / typical.degrees
    gained, missed = 0.0, blind * _LOG_UNSEEN
    for one in meetings:
        gained += float(one.shares @ _gains(one, variance))
        missed += (one.expected - float(one.shares.sum())) * float(np.log(1 - DETECTION))
        missed += one.unseen * _LOG_UNSEEN
    # a direction that the data leave open is as uncertain as before
    inner = information[np.ix_(free, free)] / variance + np.diag(1 / prior.spread[free] ** 2)
    laplace = 0.5 * (len(inner) * np.log(2 * np.pi) - np.linalg.slogdet(inner)[1])
    by_volume = gained + missed + float(laplace) + prior.log_density
    return max(
        by_volume, gained * _redundant(meetings, free) + missed - _log_choices(meetings, free)
    )


def _gains(one: Meeting, variance: float) -> Floats:
    """What each met feature adds to the odds (n,); at least nothing."""
    m = one.J.shape[1]
    density = one.sigma**m * one.crowd * (2 * np.pi * variance) ** (m / 2)
    gain = np.log(DETECTION) - np.log(max(density, 1e-300))
    squared = (one.offsets**2).sum(axis=1) / one.sigma**2
    return np.asarray(np.maximum(gain - squared / (2 * variance), 0.0))


def _redundant(meetings: Sequence[Meeting], free: NDArray[np.bool_]) -> float:
    """Share of the met coordinates that do not go into fixing the pose."""
    measurements = sum(one.measurements for one in meetings)
    return max(1.0 - int(free.sum()) / max(measurements, 1.0), 0.0)


def _log_choices(meetings: Sequence[Meeting], free: NDArray[np.bool_]) -> float:
    """Logarithm of the number of ways to fix a pose by observed features."""
    dimension = max(one.J.shape[1] for one in meetings)
    pins = -(-int(free.sum()) // dimension)
    observed = max(sum(one.count for one in meetings), pins)
    features = max(*(one.expected for one in meetings), pins)
    ways = gammaln(observed + 1) - gammaln(observed - pins + 1) - gammaln(pins + 1)
    assigned = gammaln(features + 1) - gammaln(features - pins + 1)
    return float(ways + assigned + np.log(2))
