"""Detection noise, estimated from residuals, and the covariance of a pose that follows.

Errors are independent for each feature (variance s_0²), or fields: of a sensor, offsets (s_1²) and
fields that turn, scale and shear all of its features (s_2²); of a marker, alike in all sensors
(s_3²).  With weights W, A = JᵀWJ, R = 1 − J A⁻¹JᵀW, fields P_k and K_jk = P_jᵀWR P_k,

    rᵀWr = s_0² tr R + Σ_k s_k² tr K_kk,      |P_jᵀWr|² = s_0² tr K_jj + Σ_k s_k² |K_jk|²

is expected of residuals r (C. R. Henderson's method of moments), and the covariance of a pose is
s_0² A⁻¹ + Σ_k s_k² A⁻¹ JᵀW P_k P_kᵀ WJ A⁻¹, enlarged as by Student, with the degrees of freedom
that B. L. Welch and F. E. Satterthwaite give to a sum of variances of shares w_k: 1/ν = Σ w_k²/ν_k;
and by more where the tail of F needs it, see `mixpose.judgement.cut`.

Fields of a sensor that last, of sizes γ in σ_ε, show in fading sums A of PᵀWRP and v of PᵀWr.  With
a normal prior of γ, of deviation d, γ̂ = S v, S = (A + 1/d²)⁻¹, and fields make v more likely by the
factor det(1 + d²A)^(−½) exp(½ vᵀγ̂).  Calibrating makes residuals small, but not the errors behind
them: small fields in residuals show as well that there are errors, by which a pose is off.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TypeAlias

import numpy as np
from scipy.linalg.lapack import dposv
from scipy.optimize import nnls
from scipy.special import expit, logit

from mixpose.constants import constant
from mixpose.judgement.cut import with_cut_spots
from mixpose.judgement.fields import Fields, fields_at
from mixpose.judgement.information import inverted, unit
from mixpose.matching import ErrorRules, Matches, NoiseEstimate, errors_seen, pooled, residual_ratio
from mixpose.records import Floats, Mask, replace

Biases: TypeAlias = Mapping[tuple[str, ...], Floats]

NEGLIGIBLE = 1e-4  # probability of fields below which they do not widen the covariance


@dataclass(frozen=True)
class NoiseModel:
    """Priors of detection noise and of fields, and how long residuals are remembered."""

    errors: ErrorRules = ErrorRules()
    by_chance: float = constant(0.999, "frames of rarer residuals have a noise of their own")
    known: float = constant(20.0, "degrees of freedom that tell the noise to 16 %, √(1/2ν)")
    usual: float = constant(0.1, "σ_ε: spots and corners err by 0.01 to 0.3 of it")
    usual_degrees: float = constant(10.0, "of freedom that this counts as: by a factor of 1.25")
    guess: float = constant(
        0.1, "of freedom that it counts as in the covariance: residuals may agree by chance"
    )
    fewest: float = constant(
        10.0, "detections that tell a change of noise from a hand that cuts every second spot"
    )
    memory: float = constant(0.95, "per frame, of the residuals before: 20 frames count")
    fewest_degrees: float = constant(3.0, "of freedom that a variance has at least: thrice as wide")
    of_frame: float = constant(
        12.0,
        "of freedom that the noise so far counts as in a frame: it varies by 40 %, √(2/ν)",
    )
    lasting: float = constant(0.18, "of the noise: fields of a sensor; half and twice do as well")
    off: float = constant(0.03, "of calibrations are off, before anything is seen")
    bias: float = constant(0.25, "σ_ε: of fields that last: 0.4 px, a camera turned by 0.02°")
    shown: float = constant(0.016, "σ_ε: of these in residuals, which calibrating has made small")
    turned: float = constant(0.03, "rad, of a sensor that stands otherwise; of a body's size")
    shifted: float = constant(20.0, "σ_ε: of a body in such a sensor: 30 px, 1 or 2°")
    lens: float = constant(0.2, "k1 of another lens than the session's: lenses have 0.05 to 0.4")
    bias_memory: float = constant(0.99, "per frame, of fields that last: 100 frames count")

    def enlargement(self, degrees: Floats | float) -> Floats:
        """Return factors (n,) for variances of these degrees of freedom, as by Student."""
        known = np.maximum(degrees, self.fewest_degrees)
        return np.asarray(known / (known - 2))


@dataclass(frozen=True, eq=False)
class RememberedNoise:
    """Sums over residuals of frames so far, for the next frame."""

    names: tuple[str, ...] = ()  # of the sensors so far
    # (2, L) squares of their residuals in σ_ε², and degrees of freedom
    sums: Floats = field(default_factory=lambda: np.zeros((2, 0)))
    # (4, 5) normal equations of the variances of errors and fields, [expected | seen]
    moments: Floats = field(default_factory=lambda: np.zeros((4, 5)))
    # (q, q + 1) sums [A | v] of fields that last, by sets of sensors, the latest first
    biases: Biases = field(default_factory=dict)
    fields: float = 1.0  # share of the variance by fields of sensors; 1 before it is known
    # numbers of frames with a rigid and with a bent body; older frames count less
    bends: tuple[float, float] = (0.0, 0.0)

    def followed(
        self, names: Sequence[str], sums: Floats, moments: Floats, biases: Biases, fields: float
    ) -> RememberedNoise:
        """Return these sums with new ones of some sensors, whose sums are (2, L)."""
        others = [k for k, name in enumerate(self.names) if name not in names]
        sums = np.concatenate([sums, self.sums[:, others]], axis=1) if others else sums
        names = *names, *[self.names[k] for k in others]
        return RememberedNoise(names, sums, moments, biases, fields, self.bends)

    @property
    def log_bent(self) -> tuple[float, float]:
        """Log probabilities that a body with spreads is rigid, and bent; even before any frame."""
        rigid, bent = (count + 0.5 for count in self.bends)
        return math.log(rigid / (rigid + bent)), math.log(bent / (rigid + bent))

    def bent_once(self, share: float, memory: float) -> RememberedNoise:
        """Return these sums after a frame in which the body was bent by a probability `share`."""
        rigid, bent = self.bends
        return replace(self, bends=(memory * rigid + 1 - share, memory * bent + share))

    def of(self, names: Sequence[str]) -> Floats:
        """Return squares and degrees of freedom (2, L) of the named sensors."""
        if tuple(names) == self.names:
            return self.sums
        known = dict(zip(self.names, self.sums.T))
        return np.array([known.get(name, np.zeros(2)) for name in names]).reshape(-1, 2).T


def noise_of(
    matches: Matches,
    free: Mask,
    before: RememberedNoise,
    model: NoiseModel,
    estimate: NoiseEstimate | None = None,  # of the fit, if known
    known: Floats = np.full(6, np.inf),  # standard deviations of the pose before the frame
    anywhere: Floats = np.full(6, np.inf),  # and of an unknown pose
) -> tuple[Floats, Floats, Floats, RememberedNoise, float, float]:
    """Estimate the noise of a frame at one pose from its residuals and from those before it.

    Returns variances (L,) of the sensors, σ_ε²; the covariance (6, 6), zero where the pose is not
    free, and its part by errors that last, which leaves velocities alone; the sums to remember; the
    ratio of residuals to the largest that chance makes; and the log of how rare the noise is.
    """
    (chosen,) = free.nonzero()
    count, inner = len(chosen), (chosen[:, None], chosen)
    variances, rarity, scale, sums, degrees, ratio = _level(matches, before, count, model, estimate)
    wide = scale[:, None] + matches.extra
    # detections of extra variance count less
    is_off, noise = model.errors.are_off(matches, wide), np.sqrt(scale)
    counted = matches.shares * matches.coordinate_weight[:, None] * scale[:, None] / wide
    met = (shares := np.where(is_off, 0.0, counted)).sum(axis=1)
    roots = (np.sqrt(shares) / noise[:, None]).ravel().repeat(2)
    fields = fields_at(matches, shares, roots, chosen, anywhere)
    # fields of sensors may last, as biases
    q = fields.remaining.shape[1]
    unit_fields = fields.remaining / (sizes := noise.repeat(q // len(noise)))
    biases, mean, second = _biases(before.biases, matches.names, unit_fields, fields.r, model)
    unbiased, (covariance, persistent) = fields.r - unit_fields @ mean, np.zeros((2, 6, 6))
    shifts = fields.shifts[:, :q] / sizes
    persistent[inner] = shifts @ second @ shifts.T
    redundant = float(met @ matches.dimensions) - count
    in_frame = np.zeros((4, 5))
    if redundant > 0:
        in_frame[:, :4] = fields.expected_squares(matches)
        in_frame[0, 0], in_frame[0, 4] = redundant, unbiased @ unbiased
        in_frame[1:, 4] = fields.pulls(unbiased, matches) ** 2 @ fields.kinds[:, 1:]
    moments = model.memory * before.moments + in_frame
    usual = model.usual**2 / (float(scale.sum()) / len(scale))
    met_by_sensor = sum(matches.met.tolist()) / len(matches.names)
    by_kind, of_fields = _variances(moments, in_frame, met_by_sensor, usual, model)
    share = float(by_kind[1:3].sum() / by_kind[:3].sum())
    # the variance of independent errors in this frame has a scaled inverse χ² distribution of ν
    # degrees of freedom: its mean, which is estimated from all frames, counts as ν − 2
    counts, redundant = model.of_frame - 2, max(redundant, 0.0)
    by_kind[0] = (counts * by_kind[0] + in_frame[0, 4]) / (counts + redundant)
    # fields last, so that further frames show no more of them
    known_to = np.maximum([degrees, *of_fields], model.fewest_degrees)
    covariance[inner], factor = _of_all_kinds(by_kind, known_to, fields, model)
    arguments = matches, fields.J, fields.r, fields.information, known[chosen], wide, model.errors
    spread, tail_factor = with_cut_spots(*arguments, 1 - model.by_chance, float(known_to[0]))
    covariance[inner] = max(factor, tail_factor) * (covariance[inner] + spread)
    if matches.by_calibration is not None:
        by_calibration = roots[:, None] * matches.by_calibration.reshape(len(roots), -1)
        shifted = fields.inverse @ (fields.J.T @ by_calibration)
        covariance[inner] += shifted @ shifted.T
    after = before.followed(matches.names, sums, moments, biases, share)
    return variances, covariance + persistent, persistent, after, ratio, rarity


def _of_all_kinds(
    variances: Floats,  # (4,) of independent errors and of fields
    degrees: Floats,  # (4,) of freedom of these variances
    fields: Fields,
    model: NoiseModel,
) -> tuple[Floats, float]:
    """Return the covariance (k, k) by all kinds of errors, and a factor as variances are not exact.

    The shares of kinds, which set its degrees of freedom, are those of all directions together.
    """
    shifts, kinds = fields.shifts, fields.kinds
    covariance = variances[0] * fields.inverse + (shifts * (kinds @ variances)) @ shifts.T
    B = inverted(covariance)
    shares = variances * (np.vecdot(shifts.T, (B @ shifts).T) @ kinds)
    shares[0] = variances[0] * np.vdot(B, fields.inverse)
    shares /= max(float(shares.sum()), 1e-300)
    return covariance, float(model.enlargement(1 / float(shares**2 @ (1 / degrees))))


def _level(
    matches: Matches,
    before: RememberedNoise,
    count: int,
    model: NoiseModel,
    estimate: NoiseEstimate | None,
) -> tuple[Floats, float, Floats, Floats, float, float]:
    """Return variances (L,) and their rarity as `_of_frame`, and variances that weigh residuals.

    As a rule the latter are of all frames so far.  A frame of much larger residuals goes by its
    own, and is remembered as one with the largest that chance makes.  If it has few detections,
    something in front more likely cuts spots: it goes by the noise so far and is not remembered.
    Also the sums (2, L) to remember, the degrees of freedom, and the ratio of residuals.
    """
    rules, past = model.errors, before.of(matches.names)
    sums, share = model.memory * past, model.usual_degrees / len(matches.names)
    in_frame, variances, *_ = estimate or errors_seen(matches, count, sums, rules)
    # the usual noise is that of cameras; of ranges there is none
    believed = past + share * (matches.dimensions == 2) * [[model.usual**2], [1.0]]
    known = [believed, past] if sum(past[1].tolist()) >= model.known else [believed]
    ratio = residual_ratio(in_frame, known, model.by_chance, rules)
    rarity, remembered = 0.0, sums + in_frame
    if believed[1].any():
        variances, rarity = _of_frame(in_frame, believed, rules)
        # a first frame may have any noise
        rarity = rarity if past[1].any() else 0.0
    if ratio > 1:
        remembered[0] = sums[0] + in_frame[0] / ratio
        if sum(matches.met.tolist()) < model.fewest and past[1].any():
            remembered = sums
        else:
            sums = np.zeros_like(past)
            in_frame, *_ = errors_seen(matches, count, sums, rules)
    sums = sums + in_frame
    scale = pooled(sums, rules, model.guess, model.usual)
    return variances, rarity, scale, remembered, sum(sums[1].tolist()) + model.guess, ratio


def _of_frame(in_frame: Floats, before: Floats, rules: ErrorRules) -> tuple[Floats, float]:
    """Return variances (L,) of the noise of one frame, and the log of how rare they are.

    They are those before times a factor f, which has a scaled inverse χ² distribution of ν degrees
    of freedom and is rarer than 1 by ½ ν (ln f + 1/f − 1); each sensor's is drawn to it.
    """
    nu, variances = rules.typical_degrees, pooled(before, rules, 0.0)
    ratios = in_frame / [variances, np.ones(len(variances))]
    squares, degrees = ratios.sum(axis=1).tolist()
    factor = (nu + squares) / (nu + degrees)
    rarity = -0.5 * nu * (math.log(factor) + 1 / factor - 1)
    return variances * pooled(ratios, rules, nu, deviation=1.0), rarity


def _biases(
    before: Biases, names: tuple[str, ...], fields: Floats, r: Floats, model: NoiseModel
) -> tuple[Biases, Floats, Floats]:
    """Add a frame with fields (R, q) to the sums [A | v], and estimate the fields that last.

    Returns the sums, sizes γ̂ (q,) in σ_ε and second moments (q, q), both zero if none is likely.
    """
    sums = np.concatenate([fields.T @ fields, (r @ fields)[:, None]], axis=1)
    if names in before and before[names].shape == sums.shape:
        sums = model.bias_memory * before[names] + sums
    others = [entry for entry in before.items() if entry[0] != names]
    biases = {names: sums, **dict(others[:3])}  # of the latest sets of sensors
    A, v = sums[:, :-1], sums[:, -1]
    if model.bias:
        chance = _probability_of_biases(A, v, model)
        if chance > NEGLIGIBLE:
            second = inverted(A + unit(len(v)) / model.bias**2)
            mean = second @ v
            return biases, chance * mean, chance * (second + np.outer(mean, mean))
    return biases, np.zeros(len(v)), np.zeros(A.shape)


def _probability_of_biases(A: Floats, v: Floats, model: NoiseModel) -> float:
    """Return the probability of fields, which show in full or as small as calibrating made them."""
    logs = np.logaddexp(_log_density(A, v, model.bias), _log_density(A, v, model.shown))
    return float(expit(logs - math.log(2) + logit(model.off)))


def _log_density(A: Floats, v: Floats, d: float) -> float:
    """Return the log density of v with fields of deviation d, less that without fields."""
    factor, mean, _ = dposv(A + unit(len(v)) / d**2, v)
    return 0.5 * float(v @ mean) - float(np.log(d * factor.diagonal()).sum())


def _variances(
    moments: Floats, in_frame: Floats, met: float, usual: float, model: NoiseModel
) -> tuple[Floats, Floats]:
    """Estimate variances (4,) of independent errors and of fields, and degrees (3,) of the latter.

    They solve the normal equations of all frames; the degrees of freedom are by one frame alone, in
    which a sensor meets `met` features.  Priors, as that markers are where they should be, count as
    the three fields of a camera along an axis: an offset, and two that turn, scale and shear.
    """
    fields, least = 3.0, 1e-6  # degrees of freedom; the least are as good as none
    of_markers = fields * in_frame[3, 3] + least
    believed = np.array([model.guess, fields * met**2, fields * met**2, of_markers])
    expected = moments[:, :4] + np.diag(believed)
    seen = moments[:, 4] + believed * [usual, model.lasting**2, model.lasting**2, 0.0]
    scale = 1 / np.maximum(expected.diagonal(), least)
    variances = nnls(scale[:, None] * expected, scale * seen)[0]
    # fields explain at most 19 of 20 parts of the squares
    variances[0] = max(variances[0], 0.05 * seen[0] * scale[0])
    in_one_frame = in_frame[0, 1:4] + [fields * met, fields * met, fields * in_frame[0, 3] + least]
    squared = in_frame.diagonal()[1:] + believed[1:]
    return variances, in_one_frame**2 / np.maximum(squared, least)
