"""How sure it is that the body is there at all.

Either the body is there at this pose, or everything seen is clutter.  The log of the odds is a sum
over the features in view,

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

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from mixpose.body import Body
from mixpose.constants import constant
from mixpose.judgement.association import Association
from mixpose.judgement.noise import information_of

Floats: TypeAlias = NDArray[np.float64]


@dataclass(frozen=True)
class DetectionModel:
    """How likely features are seen, and where a body may be."""

    probability: float = constant(
        0.75, "P_D that a feature in view is detected: one or two of eight are hidden as a rule"
    )
    log_unseen: float = constant(
        -1.2, "for each feature that faces a sensor out of its view: ln 0.3, bodies are in view"
    )
    by_count: bool = constant(
        True,
        "whether a pose may pay for its freedom by the features that fix it: cheaper than by "
        "volume where priors are wide",
    )
    room: float = constant(
        10.0, "radii of the body: how far a position may be where nothing is known before"
    )

    @property
    def log_missed(self) -> float:
        """Of a feature in view without a detection."""
        return math.log(1 - self.probability)


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


def flat_prior(body: Body, free: NDArray[np.bool_], detection: DetectionModel) -> Prior:
    """Nothing is known: anywhere within ten radii of the body, turned in any way."""
    room = detection.room * body.radius
    turns = int(free[3:].sum())
    rotations = 8 * np.pi**2 if turns == 3 else (2 * np.pi) ** turns
    volume = room ** int(free[:3].sum()) * rotations / len(body.symmetries)
    return Prior(-float(np.log(volume)), np.repeat([room, np.pi], 3))


def log_evidence(
    associations: Sequence[Association],
    variances: Floats,
    free: NDArray[np.bool_],
    prior: Prior,
    detection: DetectionModel,
) -> float:
    """Logarithm of the odds for the body at a pose against mere clutter.

    Parameters
    ----------
    associations : sequence of Association
        One per sensor that saw something.
    variances : (L,) array
        Of the noise of each, in σ_ε².
    free : (6,) bool
    prior : Prior
    detection : DetectionModel
    """
    if not any(one.met for one in associations):
        return -np.inf
    gained, missed = 0.0, 0.0
    for one, variance in zip(associations, variances.tolist(), strict=True):
        gained += float(one.shares @ _gains(one, variance, detection.probability))
        missed += one.missed * detection.log_missed
        missed += one.unseen * detection.log_unseen
    # a direction that the data leave open is as uncertain as before
    information = information_of(associations, variances)[np.ix_(free, free)]
    inner = information + np.diag(1 / prior.spread[free] ** 2)
    laplace = 0.5 * (len(inner) * math.log(2 * math.pi) - _log_det(inner))
    by_volume = gained + missed + laplace + prior.log_density
    if not detection.by_count:
        return by_volume
    by_count = gained * _redundant(associations, free) + missed - _log_choices(associations, free)
    return max(by_volume, by_count)


def _log_det(A: Floats) -> float:
    """Logarithm of the determinant of a positive definite matrix, however ill conditioned."""
    scale = np.sqrt(A.diagonal())
    values = np.linalg.eigvalsh(A / scale / scale[:, None])
    return float(np.log(np.maximum(values, 1e-12)).sum() + 2 * np.log(scale).sum())


def _gains(one: Association, variance: float, detection: float) -> Floats:
    """What each met feature adds to the odds (n,); at least nothing."""
    m = one.J.shape[1]
    density = one.sigma**m * one.crowd * (2 * np.pi * variance) ** (m / 2)
    gain = math.log(detection / max(density, 1e-300))
    return np.asarray(np.maximum(gain - one.squared / (2 * variance), 0.0))


def _redundant(associations: Sequence[Association], free: NDArray[np.bool_]) -> float:
    """Share of the met coordinates that do not go into fixing the pose."""
    measurements = sum(one.measurements for one in associations)
    return max(1.0 - int(free.sum()) / max(measurements, 1.0), 0.0)


def _log_choices(associations: Sequence[Association], free: NDArray[np.bool_]) -> float:
    """Logarithm of the number of ways to fix a pose by observed features."""
    associations = [one for one in associations if one.expected > 0]
    dimension = max(one.J.shape[1] for one in associations)
    pins = -(-int(free.sum()) // dimension)
    observed = max(sum(one.count for one in associations), pins)
    features = max(*(one.expected for one in associations), pins)
    ways = math.lgamma(observed + 1) - math.lgamma(observed - pins + 1) - math.lgamma(pins + 1)
    assigned = math.lgamma(features + 1) - math.lgamma(features - pins + 1)
    return ways + assigned + math.log(2)
