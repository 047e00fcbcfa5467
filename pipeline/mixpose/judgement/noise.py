"""What detections err by, as residuals show it, and the covariance of a pose that follows.

Errors are independent from feature to feature (variance s_0²), fields that all features of a sensor
have in common: offsets (s_1²), and what turns, scales and shears (s_2²), or of a marker, alike in
all sensors (s_3²).  With weights W, A = JᵀWJ, R = 1 − J A⁻¹JᵀW, fields P_k and K_jk = P_jᵀWR P_k,

    rᵀWr = s_0² tr R + Σ_k s_k² tr K_kk,      |P_jᵀWr|² = s_0² tr K_jj + Σ_k s_k² |K_jk|²

is expected of residuals r (C. R. Henderson's method of moments), and the covariance of a pose is
s_0² A⁻¹ + Σ_k s_k² A⁻¹ JᵀW P_k P_kᵀ WJ A⁻¹, enlarged as the F distribution says.

Fields of a sensor that last, of sizes γ in σ_ε, show in fading sums A of PᵀWRP and v of PᵀWr.  With
γ normal, of the deviation d before, γ̂ = S v, S = (A + 1/d²)⁻¹: where vᵀγ̂ is larger than chance
makes it, something lasts.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls
from scipy.special import chdtri, fdtri

from mixpose.constants import constant
from mixpose.judgement.covariance import inverses
from mixpose.judgement.residuals import fields_of, normal_equations, weighted
from mixpose.matching import ErrorRules, Matches, NoiseEstimate, errors_seen, pooled
from mixpose.records import Floats

Biases: TypeAlias = Mapping[tuple[str, ...], Floats]


@dataclass(frozen=True)
class BiasRules:
    """What is believed of errors that last."""

    deviation: float = constant(
        0.25, "σ_ε: of fields that last, once some are seen: 0.4 px, a camera turned by 0.02°"
    )
    memory: float = constant(0.99, "per frame, of what was seen before: 100 frames count")


@dataclass(frozen=True)
class NoiseModel:
    """What is believed of detection noise before residuals are seen, and for how long."""

    errors: ErrorRules = ErrorRules()
    bias: BiasRules = BiasRules()
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
    lasting: float = constant(
        0.18,
        "of the noise: an offset that all features of a sensor have in common, or what turns, "
        "scales and shears them, before it is seen (half and twice of it do as well)",
    )

    def enlargement(self, directions: int, degrees: Floats | float) -> Floats:
        """Factors that make the Gaussian ellipsoid as large as that of the F distribution.

        Of a pose that is free in so many directions; variances have degrees (n,) of freedom.
        """
        if directions == 0 or self.confidence == 0:
            return np.ones(np.shape(degrees))
        tail = fdtri(directions, np.maximum(degrees, 1.0), self.confidence)
        return np.asarray(directions * tail / chdtri(directions, 1 - self.confidence))


@dataclass(frozen=True, eq=False)
class RememberedNoise:
    """What is remembered of residuals, for the next frame."""

    names: tuple[str, ...] = ()  # sensors that were seen so far
    # (2, L) squares of their residuals in σ_ε², and degrees of freedom
    sums: Floats = field(default_factory=lambda: np.zeros((2, 0)))
    # (4, 5) normal equations of the variances of errors and fields, [expected | seen]
    moments: Floats = field(default_factory=lambda: np.zeros((4, 5)))
    # (q, q + 1) sums [A | v] of fields that last, by sets of sensors, the last seen first
    biases: Biases = field(default_factory=dict)

    @property
    def total(self) -> Floats:
        """Squares and degrees of freedom (2,) of all sensors together."""
        return np.asarray(self.sums.sum(axis=1))

    def of(self, names: Sequence[str]) -> Floats:
        """Squares and degrees of freedom (2, L) of some sensors."""
        if tuple(names) == self.names:
            return self.sums
        known = dict(zip(self.names, self.sums.T))
        return np.array([known.get(name, np.zeros(2)) for name in names]).reshape(-1, 2).T


def noise_of(
    found: Matches,
    free: NDArray[np.bool_],
    before: RememberedNoise,
    model: NoiseModel,
    estimate: NoiseEstimate | None = None,
) -> tuple[Floats, Floats, Floats, RememberedNoise, float]:
    """The noise of a frame at one pose, from its residuals and from those before it.

    As a rule it is that of the frames so far.  A frame with residuals of another kind goes by its
    own, and is remembered as one that has the largest that chance makes.  `estimate` is what the
    fit saw already.

    Returns the variances (L,) of each sensor in σ_ε²; the covariance (6, 6), zero where the pose
    is not free, and what of it lasts from frame to frame and leaves velocities alone; what is
    remembered; and the ratio of residuals to the largest that those before let chance make.
    """
    count = int(free.sum())
    variances, scale, sums, degrees, ratio = _level(found, before, count, model, estimate)
    is_noise = found.squared <= model.errors.outlying**2 * scale[:, None]
    shares, noise = np.where(is_noise, found.shares, 0.0), np.sqrt(scale)
    r, rows, by_calibration = weighted(found, shares, noise)
    fields, kinds = fields_of(found, shares, rows)
    J = rows[:, free]
    inverse = inverses(J.T @ J)
    # by how much fields move the pose, and what it leaves of them
    drawn = inverse @ (J.T @ fields)
    left = fields - J @ drawn
    # those of the sensors may last
    q = fields.shape[1] - 3 * shares.shape[1]
    sizes = np.repeat(noise, q // len(noise))
    lasting = left[:, :q] / sizes
    biases = _with(before.biases, found.names, lasting.T @ np.column_stack([lasting, r]), model)
    mean, second = _fields_that_last(biases[found.names], model)
    rest = r - lasting @ mean
    pulls = np.concatenate([rest @ fields[:, :q], r @ fields[:, q:]])
    redundancy = float(shares.sum(axis=1) @ found.dimensions) - count
    own = normal_equations(rest, redundancy, fields, left, pulls, kinds)
    moments = model.memory * before.moments + own
    met = float(found.met.mean())
    by_kind, of_fields = _variances(moments, own, met, model)
    # fields last: a further frame shows no more of them
    by_kind *= model.enlargement(count, np.array([degrees, *of_fields]))
    moved = drawn[:, :q] / sizes
    covariance, steady = np.zeros((2, 6, 6))
    steady[np.ix_(free, free)] = moved @ second @ moved.T
    inner = by_kind[0] * inverse + (drawn * (kinds @ by_kind)) @ drawn.T
    pulled = inverse @ (J.T @ by_calibration)
    covariance[np.ix_(free, free)] = inner + pulled @ pulled.T
    others = [k for k, name in enumerate(before.names) if name not in found.names]
    remembered = RememberedNoise(
        (*found.names, *(before.names[k] for k in others)),
        np.hstack([sums, before.sums[:, others]]),
        moments,
        biases,
    )
    return variances, covariance + steady, steady, remembered, ratio


def _level(
    matches: Matches,
    before: RememberedNoise,
    count: int,
    model: NoiseModel,
    estimate: NoiseEstimate | None,
) -> tuple[Floats, Floats, Floats, float, float]:
    """How large residuals are, sensor by sensor.

    Variances (L,) as offsets show them, and drawn to that of all sensors, which residuals are
    measured in; sums (2, L) to remember; degrees of freedom of all that was seen; the ratio.
    """
    rules, past = model.errors, before.of(matches.names)
    sums, ratio = model.memory * past, 0.0
    seen = estimate or errors_seen(matches, count, sums, rules)
    known, degrees = float(past[1].sum()), float(seen.own[1].sum())
    if known >= model.known and degrees >= 1:
        usual = np.maximum(pooled(past, rules, 0.0), model.smallest**2)
        ratio = float((seen.own[0] / usual).sum()) / degrees
        ratio /= float(fdtri(degrees, known, model.by_chance))
    told = sums + seen.own / [[max(ratio, 1.0)], [1.0]]
    if ratio > 1:
        sums = np.zeros_like(past)
        seen = errors_seen(matches, count, sums, rules)
    sums = sums + seen.own
    degrees = float(sums[1].sum())
    scale = pooled(sums, rules, 0.0 if degrees >= 1 else rules.typical_degrees)
    return seen.variances, np.maximum(scale, model.smallest**2), told, degrees, ratio


def _with(before: Biases, names: tuple[str, ...], shown: Floats, model: NoiseModel) -> Biases:
    """Sums (q, q + 1) with those of a frame, of the last four sets of sensors that were seen."""
    if names in before and before[names].shape == shown.shape:
        shown = model.bias.memory * before[names] + shown
    others = [(own, sums) for own, sums in before.items() if own != names]
    return {names: shown, **dict(others[:3])}


def _fields_that_last(sums: Floats, model: NoiseModel) -> tuple[Floats, Floats]:
    """Sizes γ̂ (q,) in σ_ε of fields with sums [A | v], and second moments (q, q); 0 for none."""
    information, vector, deviation = sums[:, :-1], sums[:, -1], model.bias.deviation
    if deviation:
        S = np.linalg.inv(information + np.eye(len(vector)) / deviation**2)
        mean = S @ vector
        degrees = float((S * information).sum())
        if vector @ mean > chdtri(max(degrees, 1.0), 1 - model.by_chance):
            return mean, S + np.outer(mean, mean)
    return np.zeros_like(vector), np.zeros_like(information)


def _variances(
    moments: Floats, own: Floats, met: float, model: NoiseModel
) -> tuple[Floats, Floats]:
    """Variances (4,) of independent errors and of fields; degrees of freedom (3,) of the latter.

    From normal equations (4, 5) of all frames and of this one's own, where each sensor meets so
    many features.  What is believed before counts as a camera's fields along an axis: an offset,
    and two that turn, scale and shear; that markers are where they are said to be, as surely as so
    many frames tell.
    """
    fields, least = 3.0, 1e-6  # degrees of freedom that are as good as none
    of_markers = fields * own[3, 3] + least
    believed = np.array([least, fields * met**2, fields * met**2, of_markers])
    expected = moments[:, :4] + np.diag(believed)
    seen = moments[:, 4] + believed * [1.0, model.lasting**2, model.lasting**2, 0.0]
    scale = 1 / np.maximum(expected.diagonal(), least)
    variances = nnls(scale[:, None] * expected, scale * seen)[0]
    # a twentieth of the squares is not taken for fields
    variances[0] = max(variances[0], 0.05 * seen[0] * scale[0])
    once = own[0, 1:4] + [fields * met, fields * met, fields * own[0, 3] + least]
    squared = own.diagonal()[1:] + believed[1:]
    return variances, once**2 / np.maximum(squared, least)
