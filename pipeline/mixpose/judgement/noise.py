"""What detections err by, as residuals show it, and the covariance of a pose that follows.

Offsets of the met features from their prediction are of two kinds.  What the extraction errs by is
independent from feature to feature.  What a calibration, a clock or a lens errs by is alike in all
features of a sensor: a field over its coordinates, an offset and, less than that, what turns,
scales and shears the features' image.  In units of each sensor's noise let the variance of the former be
s², that of the latter τ².  With the weights W, R = 1 − J (JᵀWJ)⁻¹ JᵀW that a pose leaves of errors,
the fields P as columns and K = PᵀWRP, the residuals r have the expectations

    rᵀWr = s² tr R + τ² tr K,        |PᵀWr|² = s² tr K + τ² tr K²

(C. R. Henderson's method of moments).  Both sums are taken over the frames so far, fading, and give
s² and τ².  Most of a field a pose takes for its own; the covariance has it back:

    s² A⁻¹ + τ² A⁻¹ JᵀW P Pᵀ WJ A⁻¹,         A = JᵀWJ.

With ν degrees of freedom the estimate itself is uncertain: the covariance is enlarged so that its
95 % ellipsoid is that of the F distribution with (d, ν) degrees, d directions being free.  For
many degrees of freedom nothing is added.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag
from scipy.special import chdtri, fdtri

from mixpose.constants import constant
from mixpose.density import ErrorRules, Noise, Offsets, Seen, errors_seen, pooled
from mixpose.judgement.association import Association

Floats: TypeAlias = NDArray[np.float64]

_LEAST_SHARE = 0.05  # of the squares of residuals, that is not taken for what lasts
_MIN_INFORMATION = 1e-18  # per squared length or radian: less is as good as none


@dataclass(frozen=True)
class NoiseModel:
    """What is believed of detection noise before residuals are seen, and for how long."""

    errors: ErrorRules = ErrorRules()
    smallest: float = constant(1e-3, "of σ_ε: float32 densities do not resolve residuals below")
    by_chance: float = constant(
        0.999, "frames whose residuals are larger than so many by chance stand on their own"
    )
    known: float = constant(
        20.0, "degrees of freedom from which the noise of a recording is known to 16 %, √(1/2ν)"
    )
    memory: float = constant(0.95, "per frame, of the residuals before: 20 frames count")
    confidence: float = constant(
        0.95, "of the ellipsoid that is as large as the F distribution's; 0 enlarges nothing"
    )
    forgetting: float = constant(0.8, "the same where they no longer seem to hold: 5 frames count")
    lasting: float = constant(
        0.2,
        "of the noise: errors that all features of a sensor have in common, before they are seen "
        "(calibrated web cams and a chessboard: 0.5-5)",
    )
    lasting_fields: float = constant(
        4.0, "fields that `lasting` counts as: those of two cameras outweigh it after a frame"
    )
    slanted: float = constant(
        0.7,
        "of a field's offset: what turns, scales and shears (a chessboard 0.65, web cams and "
        "action cameras 0.25-0.4)",
    )

    def unseen(self, met: float) -> Moments:
        """What is believed of lasting errors, as moments; a sensor meets so many features."""
        weight = self.lasting_fields * met**2
        return Moments(fields=weight * self.lasting**2, twice=weight)

    def enlargement(self, directions: int, degrees: float) -> float:
        """Factor that makes the Gaussian ellipsoid as large as that of the F distribution.

        Parameters
        ----------
        directions : int
            Of the pose that are free.
        degrees : float
            Of freedom, from which the variance was estimated.
        """
        if directions == 0 or self.confidence == 0:
            return 1.0
        tail = fdtri(directions, max(degrees, 1.0), self.confidence)
        return float(directions * tail / chdtri(directions, 1 - self.confidence))


class Moments(NamedTuple):
    """Sums over frames, from which s² and τ² follow.

    Attributes
    ----------
    squares, degrees : float
        rᵀWr and tr R.
    fields : float
        |PᵀWr|².
    once, twice : float
        tr K and tr K².
    """

    squares: float = 0.0
    degrees: float = 0.0
    fields: float = 0.0
    once: float = 0.0
    twice: float = 0.0

    def joined(self, other: Moments, memory: float) -> Moments:
        """Add those of another frame."""
        return Moments(*(memory * a + b for a, b in zip(self, other, strict=True)))

    def variances(self) -> tuple[float, float]:
        """s² and τ²."""
        if self.degrees < 1:
            return 1.0, self.fields / max(self.twice, 1e-12)
        determinant = max(self.degrees * self.twice - self.once**2, 1e-12)
        lasting = max(self.degrees * self.fields - self.once * self.squares, 0.0) / determinant
        rest = max(self.squares - lasting * self.once, _LEAST_SHARE * self.squares)
        return max(rest / self.degrees, _LEAST_SHARE), lasting


@dataclass(frozen=True)
class Residuals:
    """What is remembered of residuals: each sensor's noise in σ_ε, and what lasts of it."""

    noise: Mapping[str, Noise] = field(default_factory=dict)
    moments: Moments = Moments()

    @property
    def total(self) -> Noise:
        """Noise of all sensors."""
        total = Noise()
        for one in self.noise.values():
            total = total.joined(one)
        return total


@dataclass(frozen=True)
class FrameNoise:
    """The noise that a frame goes by.

    Attributes
    ----------
    variances : (L,) float64
        Of each sensor, in σ_ε²; the typical one counts, too.
    covariance : (6, 6) float64
        Zero where the pose is not free.
    remembered : Residuals
        For the next frame.
    """

    variances: Floats
    covariance: Floats
    remembered: Residuals


def noise_of(
    associations: Sequence[Association],
    free: NDArray[np.bool_],
    before: Residuals,
    model: NoiseModel,
) -> FrameNoise:
    """The noise of a frame, from its residuals and from those before it.

    As a rule it is that of the frames so far.  A frame with residuals of another kind goes by its
    own, and the frames after it forget it.
    """
    offsets, count = _offsets(associations), int(free.sum())
    known = [before.noise.get(one.name, Noise()) for one in associations]
    past = np.array([(one.squares, one.degrees) for one in known]).T
    sums, rest = model.memory * past, None
    seen = errors_seen(offsets, count, sums, model.errors)
    if _is_outdone(past, seen, model):
        sums, rest = np.zeros_like(past), model.forgetting * past
        seen = errors_seen(offsets, count, sums, model.errors)
    sums = sums + seen.own
    degrees = float(sums[1].sum())
    typical = 0.0 if degrees >= 1 else model.errors.typical_degrees
    variances = np.maximum(pooled(sums, model.errors, typical), model.smallest**2)
    own, independent, lasting = _moments(associations, offsets, variances, free, model)
    moments = before.moments.joined(own, model.memory)
    met = float(np.mean([one.met for one in associations]))
    believed = model.unseen(met)
    s2, t2 = moments.joined(believed, 1.0).variances()
    # fields last: no further frame shows more of them
    fields = (own.once + model.lasting_fields * met) ** 2 / max(own.twice + believed.twice, 1e-12)
    covariance = np.zeros((6, 6))
    covariance[np.ix_(free, free)] = (
        model.enlargement(count, degrees) * s2 * independent
        + model.enlargement(count, fields) * t2 * lasting
    )
    told = sums if rest is None else rest
    noise = {one.name: Noise(*pair) for one, pair in zip(associations, told.T.tolist())}
    return FrameNoise(seen.variances, covariance, Residuals({**before.noise, **noise}, moments))


def _offsets(associations: Sequence[Association]) -> Offsets:
    """Offsets of the features of all sensors."""
    return Offsets(
        np.concatenate([one.squared for one in associations]),
        np.concatenate([one.shares for one in associations]),
        np.repeat(np.arange(len(associations)), [len(one.shares) for one in associations]),
        np.array([one.J.shape[1] for one in associations]),
        np.array([one.finest for one in associations]),
    )


def _is_outdone(past: Floats, seen: Seen, model: NoiseModel) -> bool:
    """Whether a frame's residuals are larger than chance makes them."""
    known, degrees = float(past[1].sum()), float(seen.own[1].sum())
    if known < model.known or degrees < 1:
        return False
    before = np.maximum(pooled(past, model.errors, 0.0), model.smallest**2)
    ratio = float((seen.own[0] / before).sum()) / degrees
    return bool(ratio > fdtri(degrees, known, model.by_chance))


def _moments(
    associations: Sequence[Association],
    offsets: Offsets,
    variances: Floats,
    free: NDArray[np.bool_],
    model: NoiseModel,
) -> tuple[Moments, Floats, Floats]:
    """Of one frame, and what unit variances of both kinds make of the pose's covariance.

    Detections that are farther off than the extraction errs are left out.
    """
    count = int(free.sum())
    clear = offsets.squared <= model.errors.outlying**2 * variances[offsets.sensor]
    ends = np.cumsum(np.bincount(offsets.sensor, minlength=len(associations)))[:-1]
    parts, blocks = [], []
    for one, inlying, variance in zip(associations, np.split(clear, ends), variances.tolist()):
        shares = np.where(inlying, one.shares, 0.0)
        scale = np.sqrt(shares / variance)[:, None, None] / one.sigma
        rows = np.concatenate([one.J[..., free], one.offsets[..., None]], axis=2)
        parts.append((scale * rows).reshape(-1, count + 1))
        blocks.append(_fields(one.places, shares, model.slanted))
    weighted = np.concatenate(parts)
    J, r = weighted[:, :count], weighted[:, count]
    P = block_diag(*blocks)
    inverse = _inverse(J.T @ J)
    met = J.T @ P
    drawn = inverse @ met
    K = P.T @ P - met.T @ drawn
    degrees = max(float(offsets.dimensions[offsets.sensor] @ (clear * offsets.shares)) - count, 0.0)
    fields = P.T @ r
    sums = (float(r @ r), degrees, float(fields @ fields), float(np.trace(K)), float((K * K).sum()))
    return Moments(*sums) if degrees > 0 else Moments(), inverse, drawn @ drawn.T


def _fields(places: Floats, shares: Floats, slanted: float) -> Floats:
    """What all features (n, m) of a sensor may have in common, with their shares: (nm, m + m²)."""
    n, m = places.shape
    total = max(float(shares.sum()), 1e-12)
    away = places - shares @ places / total
    size = float(np.sqrt((shares @ (away * away)).sum() / (m * total)))
    columns = np.concatenate([np.ones((n, 1)), slanted / max(size, 1e-12) * away], axis=1)
    columns *= np.sqrt(shares)[:, None]
    return (columns[:, None, :, None] * np.eye(m)[:, None]).reshape(n * m, m * (1 + m))


def _inverse(information: Floats) -> Floats:
    """Inverse of an information matrix.

    Directions that the data leave open get the variance that their information says: large, and
    at most what float64 can invert.
    """
    scale = 1.0 / np.sqrt(np.maximum(information.diagonal(), _MIN_INFORMATION))
    values, vectors = np.linalg.eigh(information * scale * scale[:, None])
    inverse = (vectors / np.maximum(values, 1e-12)) @ vectors.T * scale * scale[:, None]
    return np.asarray((inverse + inverse.T) / 2)


def information_of(associations: Sequence[Association], variances: Floats) -> Floats:
    """Σ_l Σ_i J_iᵀ J_i / s_l² (6, 6) over the met features, for noise (L,) in σ_ε²."""
    information = np.zeros((6, 6))
    for one, variance in zip(associations, variances.tolist(), strict=True):
        weighted = (one.J * (one.shares / (variance * one.sigma**2))[:, None, None]).reshape(-1, 6)
        information += weighted.T @ one.J.reshape(-1, 6)
    return information
