"""What detections err by, as residuals show it, and the covariance of a pose that follows.

Errors are independent from feature to feature (variance s_0²), fields that all features of a sensor
have in common: offsets (s_1²), and what turns, scales and shears (s_2²), or of a marker, alike in
all sensors (s_3²).  With weights W, A = JᵀWJ, R = 1 − J A⁻¹JᵀW, fields P_k and K_jk = P_jᵀWR P_k,

    rᵀWr = s_0² tr R + Σ_k s_k² tr K_kk,      |P_jᵀWr|² = s_0² tr K_jj + Σ_k s_k² |K_jk|²

is expected of residuals r (C. R. Henderson's method of moments), and the covariance of a pose is
s_0² A⁻¹ + Σ_k s_k² A⁻¹ JᵀW P_k P_kᵀ WJ A⁻¹, enlarged as by Student, with the degrees of freedom
that B. L. Welch and F. E. Satterthwaite give to a sum of variances of shares w_k: 1/ν = Σ w_k²/ν_k;
and by more where the tail of F needs it, see `mixpose.judgement.cut`.

Fields of a sensor that last, of sizes γ in σ_ε, show in fading sums A of PᵀWRP and v of PᵀWr.  With
γ normal, of the deviation d before, γ̂ = S v, S = (A + 1/d²)⁻¹, and v is as likely by fields as by
none times det(1 + d²A)^(−½) exp(½ vᵀγ̂).  Calibrating makes residuals small, not what is off: small
fields tell that something lasts as well, and a pose is off by a larger one.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TypeAlias

import numpy as np
from scipy.linalg.lapack import dposv
from scipy.optimize import nnls
from scipy.special import expit, logit

from mixpose.constants import constant
from mixpose.judgement.cut import with_cut_spots
from mixpose.judgement.fields import Fields, fields_at
from mixpose.judgement.information import inverted, unit
from mixpose.matching import (
    ErrorRules,
    Matches,
    NoiseEstimate,
    errors_seen,
    pooled,
    residual_ratio,
)
from mixpose.records import Floats, Mask

Biases: TypeAlias = Mapping[tuple[str, ...], Floats]

NEGLIGIBLE = 1e-4  # probabilities that widen nothing


@dataclass(frozen=True)
class NoiseModel:
    """What is believed of detection noise before residuals are seen, and for how long."""

    errors: ErrorRules = ErrorRules()
    by_chance: float = constant(0.999, "frames of residuals rarer than this stand on their own")
    known: float = constant(20.0, "degrees of freedom that tell the noise to 16 %, √(1/2ν)")
    usual: float = constant(0.1, "σ_ε: spots and corners err by 0.01 to 0.3 of it")
    usual_degrees: float = constant(10.0, "of freedom that this counts as: by a factor of 1.25")
    guess: float = constant(
        0.1, "of freedom that it counts as in what a pose is sure to: residuals may agree by chance"
    )
    fewest: float = constant(
        10.0, "detections that tell a change of noise from something that cuts every second spot"
    )
    memory: float = constant(0.95, "per frame, of the residuals before: 20 frames count")
    fewest_degrees: float = constant(3.0, "of freedom that a variance has at least: thrice as wide")
    of_frame: float = constant(
        12.0,
        "of freedom that the noise so far counts as in a frame: it varies by 40 %, √(2/ν)",
    )
    lasting: float = constant(0.18, "of the noise: a sensor's fields; half and twice do as well")
    off: float = constant(0.03, "of calibrations are off, before anything is seen")
    bias: float = constant(0.25, "σ_ε: of fields that last: 0.4 px, a camera turned by 0.02°")
    shown: float = constant(0.016, "σ_ε: of them in residuals, which calibrating has made small")
    turned: float = constant(0.03, "rad, of a sensor that stands otherwise; of a body's size")
    shifted: float = constant(20.0, "σ_ε: of a body in such a sensor: 30 px, 1 or 2°")
    lens: float = constant(0.2, "k1 of a lens that is another than told: lenses have 0.05 to 0.4")
    bias_memory: float = constant(0.99, "per frame, of fields that last: 100 frames count")

    def enlargement(self, degrees: Floats | float) -> Floats:
        """Factors by which errors of variances of degrees (n,) of freedom are larger: Student's."""
        known = np.maximum(degrees, self.fewest_degrees)
        return np.asarray(known / (known - 2))


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
    fields: float = 1.0  # share of the variance that is fields of sensors; not known before
    # frames so far, the older ones less, in which the body was rigid, and in which it was bent
    bends: tuple[float, float] = (0.0, 0.0)

    def followed(
        self, names: Sequence[str], sums: Floats, moments: Floats, biases: Biases, fields: float
    ) -> RememberedNoise:
        """With sums (2, L) of some sensors, and those of others and bends as they were."""
        others = [k for k, name in enumerate(self.names) if name not in names]
        sums = np.concatenate([sums, self.sums[:, others]], axis=1) if others else sums
        names = *names, *[self.names[k] for k in others]
        return RememberedNoise(names, sums, moments, biases, fields, self.bends)

    @property
    def log_bent(self) -> tuple[float, float]:
        """Of a body that gives way ln p to be rigid, and to be bent, in a frame; even at first."""
        rigid, bent = (count + 0.5 for count in self.bends)
        return math.log(rigid / (rigid + bent)), math.log(bent / (rigid + bent))

    def bent_once(self, share: float, memory: float) -> RememberedNoise:
        """After a frame in which the body was bent by a chance."""
        rigid, bent = self.bends
        return replace(self, bends=(memory * rigid + 1 - share, memory * bent + share))

    def of(self, names: Sequence[str]) -> Floats:
        """Squares and degrees of freedom (2, L) of some sensors."""
        if tuple(names) == self.names:
            return self.sums
        known = dict(zip(self.names, self.sums.T))
        return np.array([known.get(name, np.zeros(2)) for name in names]).reshape(-1, 2).T


def noise_of(
    found: Matches,
    free: Mask,
    before: RememberedNoise,
    model: NoiseModel,
    estimate: NoiseEstimate | None = None,  # as the fit has it
    known: Floats = np.full(6, np.inf),  # how uncertain the pose was before
    anywhere: Floats = np.full(6, np.inf),  # and where nothing is known
) -> tuple[Floats, Floats, Floats, RememberedNoise, float, float]:
    """The noise of a frame at one pose, from its residuals and from those before it.

    Variances (L,) of each sensor, σ_ε²; the covariance (6, 6), zero where the pose is not free, and
    what of it lasts and leaves velocities alone; what is remembered; the ratio of residuals to
    the largest that chance makes; and the log of how rare such variances are.
    """
    (chosen,) = free.nonzero()
    count, inner = len(chosen), (chosen[:, None], chosen)
    variances, rarity, scale, sums, degrees, ratio = _level(found, before, count, model, estimate)
    wide = scale[:, None] + found.extra
    # what errs by more than noise counts less
    is_off, noise = model.errors.are_off(found, wide), np.sqrt(scale)
    counted = found.shares * found.each_part[:, None] * scale[:, None] / wide
    met = (shares := np.where(is_off, 0.0, counted)).sum(axis=1)
    roots = (np.sqrt(shares) / noise[:, None]).ravel().repeat(2)
    at = fields_at(found, shares, roots, chosen, anywhere)
    # those of sensors may last
    q = at.left.shape[1]
    lasting = at.left / (sizes := noise.repeat(q // len(noise)))
    biases, mean, second = _lasting(before.biases, found.names, lasting, at.r, model)
    rest, (covariance, steady) = at.r - lasting @ mean, np.zeros((2, 6, 6))
    moved = at.drawn[:, :q] / sizes
    steady[inner] = moved @ second @ moved.T
    spare = float(met @ found.dimensions) - count
    own = np.zeros((4, 5))
    if spare > 0:
        own[:, :4] = at.expected_squares(found)
        own[0, 0], own[0, 4] = spare, rest @ rest
        own[1:, 4] = at.pulls(rest, found) ** 2 @ at.kinds[:, 1:]
    moments = model.memory * before.moments + own
    usual = model.usual**2 / float(scale.mean())
    most = sum(found.met.tolist()) / len(found.names)
    by_kind, of_fields = _variances(moments, own, most, usual, model)
    share = float(by_kind[1:3].sum() / by_kind[:3].sum())
    # independent errors are of this frame, whose variance is one of a scaled inverse χ² of ν
    # degrees of freedom: its mean, which all frames show, counts as ν − 2
    counts, spare = model.of_frame - 2, max(spare, 0.0)
    by_kind[0] = (counts * by_kind[0] + own[0, 4]) / (counts + spare)
    # fields last: a further frame shows no more of them
    known_to = np.maximum([degrees, *of_fields], model.fewest_degrees)
    covariance[inner], larger = _of_all_kinds(by_kind, known_to, at, model)
    given = found, at.J, at.r, at.information, known[chosen], wide, model.errors
    spread, needed = with_cut_spots(*given, 1 - model.by_chance, float(known_to[0]))
    covariance[inner] = max(larger, needed) * (covariance[inner] + spread)
    if found.by_calibration is not None:
        by_calibration = roots[:, None] * found.by_calibration.reshape(len(roots), -1)
        pulled = at.inverse @ (at.J.T @ by_calibration)
        covariance[inner] += pulled @ pulled.T
    after = before.followed(found.names, sums, moments, biases, share)
    return variances, covariance + steady, steady, after, ratio, rarity


def _of_all_kinds(
    variances: Floats,  # (4,) of independent errors and of fields
    degrees: Floats,  # (4,) of freedom that they are known to
    at: Fields,
    model: NoiseModel,
) -> tuple[Floats, float]:
    """The covariance (k, k) by all kinds of errors, and by what it is larger as they are not known.

    Their shares are of all directions together.
    """
    drawn, kinds = at.drawn, at.kinds
    covariance = variances[0] * at.inverse + (drawn * (kinds @ variances)) @ drawn.T
    B = inverted(covariance)
    shares = variances * (np.vecdot(drawn.T, (B @ drawn).T) @ kinds)
    shares[0] = variances[0] * np.vdot(B, at.inverse)
    shares /= max(float(shares.sum()), 1e-300)
    return covariance, float(model.enlargement(1 / float(shares**2 @ (1 / degrees))))


def _level(
    matches: Matches,
    before: RememberedNoise,
    count: int,
    model: NoiseModel,
    estimate: NoiseEstimate | None,
) -> tuple[Floats, float, Floats, Floats, float, float]:
    """Variances (L,) as `_of_frame` has them, and those that residuals are measured in.

    As a rule the latter are of the frames so far.  A frame with residuals of another kind goes by
    its own, and is remembered as one that has the largest that chance makes: sums (2, L).  Where it
    is more likely that something in front cuts spots, it goes by the noise so far, beyond which
    spots say nothing.  Then the degrees of freedom of all that was seen, and the ratio.
    """
    rules, past = model.errors, before.of(matches.names)
    sums, share = model.memory * past, model.usual_degrees / len(matches.names)
    own, variances, *_ = estimate or errors_seen(matches, count, sums, rules)
    # of cameras; what is usual for ranges nobody knows
    believed = past + share * (matches.dimensions == 2) * [[model.usual**2], [1.0]]
    known = [believed, past] if sum(past[1].tolist()) >= model.known else [believed]
    ratio = residual_ratio(own, known, model.by_chance, rules)
    rarity, told = 0.0, sums + own
    if believed[1].any():
        variances, rarity = _of_frame(own, believed, rules)
        # of frames that went before: a first one may be of any noise
        rarity = rarity if past[1].any() else 0.0
    if ratio > 1:
        told[0] = sums[0] + own[0] / ratio
        if sum(matches.met.tolist()) < model.fewest and past[1].any():
            told = sums
        else:
            sums = np.zeros_like(past)
            own, *_ = errors_seen(matches, count, sums, rules)
    sums = sums + own
    scale = pooled(sums, rules, model.guess, model.usual)
    return variances, rarity, scale, told, sum(sums[1].tolist()) + model.guess, ratio


def _of_frame(own: Floats, before: Floats, rules: ErrorRules) -> tuple[Floats, float]:
    """Variances (L,) of the noise of one frame, and the log of how rare they are.

    They are those before times a factor f, which has a scaled inverse χ² distribution of ν degrees
    of freedom and is rarer than 1 by ½ ν (ln f + 1/f − 1), and each sensor's is drawn to it.
    """
    nu, at = rules.typical_degrees, pooled(before, rules, 0.0)
    ratios = own / [at, np.ones(len(at))]
    squares, degrees = ratios.sum(axis=1).tolist()
    factor = (nu + squares) / (nu + degrees)
    rarity = -0.5 * nu * (math.log(factor) + 1 / factor - 1)
    return at * pooled(ratios, rules, nu, deviation=1.0), rarity


def _lasting(
    before: Biases, names: tuple[str, ...], fields: Floats, r: Floats, model: NoiseModel
) -> tuple[Biases, Floats, Floats]:
    """Sums [A | v] with those of a frame, of fields (R, q), and what they show of those that last.

    Sizes γ̂ (q,) in σ_ε and their second moments (q, q), zero where there may be none.
    """
    shown = np.concatenate([fields.T @ fields, (r @ fields)[:, None]], axis=1)
    if names in before and before[names].shape == shown.shape:
        shown = model.bias_memory * before[names] + shown
    others = [(own, sums) for own, sums in before.items() if own != names]
    biases = {names: shown, **dict(others[:3])}  # of the last sets of sensors
    A, v = shown[:, :-1], shown[:, -1]
    if model.bias:
        chance = _of_fields(A, v, model)
        if chance > NEGLIGIBLE:
            second = inverted(A + unit(len(v)) / model.bias**2)
            mean = second @ v
            return biases, chance * mean, chance * (second + np.outer(mean, mean))
    return biases, np.zeros(len(v)), np.zeros(A.shape)


def _of_fields(A: Floats, v: Floats, model: NoiseModel) -> float:
    """The probability of fields, which show as they are, or as small as calibrating makes them."""
    logs = np.logaddexp(_log_density(A, v, model.bias), _log_density(A, v, model.shown))
    return float(expit(logs - math.log(2) + logit(model.off)))


def _log_density(A: Floats, v: Floats, d: float) -> float:
    """The log of the density of v with fields of deviation d, over that without."""
    factor, mean, _ = dposv(A + unit(len(v)) / d**2, v)
    return 0.5 * float(v @ mean) - float(np.log(d * factor.diagonal()).sum())


def _variances(
    moments: Floats, own: Floats, met: float, usual: float, model: NoiseModel
) -> tuple[Floats, Floats]:
    """Variances (4,) of independent errors and of fields; degrees of freedom (3,) of the latter.

    From normal equations of all frames and of one alone, where sensors meet so many features, and
    the `usual` variance.  What is believed before, as that markers are where they are said to be,
    counts as a camera's fields along an axis in it: an offset, and two that turn, scale and shear.
    """
    fields, least = 3.0, 1e-6  # degrees of freedom that are as good as none
    of_markers = fields * own[3, 3] + least
    believed = np.array([model.guess, fields * met**2, fields * met**2, of_markers])
    expected = moments[:, :4] + np.diag(believed)
    seen = moments[:, 4] + believed * [usual, model.lasting**2, model.lasting**2, 0.0]
    scale = 1 / np.maximum(expected.diagonal(), least)
    variances = nnls(scale[:, None] * expected, scale * seen)[0]
    # a twentieth of the squares is not taken for fields
    variances[0] = max(variances[0], 0.05 * seen[0] * scale[0])
    once = own[0, 1:4] + [fields * met, fields * met, fields * own[0, 3] + least]
    squared = own.diagonal()[1:] + believed[1:]
    return variances, once**2 / np.maximum(squared, least)
