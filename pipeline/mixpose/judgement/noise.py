"""What detections err by, as residuals show it, and the covariance of a pose that follows.

Errors are independent from feature to feature (variance s_0²), fields that all features of a sensor
have in common: offsets (s_1²), and what turns, scales and shears (s_2²), or of a marker, alike in
all sensors (s_3²).  With weights W, A = JᵀWJ, R = 1 − J A⁻¹JᵀW, fields P_k and K_jk = P_jᵀWR P_k,

    rᵀWr = s_0² tr R + Σ_k s_k² tr K_kk,      |P_jᵀWr|² = s_0² tr K_jj + Σ_k s_k² |K_jk|²

is expected of residuals r (C. R. Henderson's method of moments), and the covariance of a pose is
s_0² A⁻¹ + Σ_k s_k² A⁻¹ JᵀW P_k P_kᵀ WJ A⁻¹, enlarged as the F distribution says.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls
from scipy.special import chdtri, fdtri

from mixpose.constants import constant
from mixpose.judgement.moments import LEAST, Frame, Moments, frames_of
from mixpose.judgement.persistent_bias import BiasRules, PersistentBias
from mixpose.matching import ErrorRules, Matches, Noise, NoiseEstimate, errors_seen, pooled
from mixpose.records import Floats

_LEAST_SHARE = 0.05  # of the squares of residuals, that is not taken for fields


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
    lasting_fields: float = constant(
        3.0, "fields that `lasting` counts as: those of two cameras outweigh it after a frame"
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
    """What is remembered of residuals, for the next frame.

    Attributes
    ----------
    names : tuple of str
        Sensors that were seen so far.
    sums : (2, L) float64
        Squares of their residuals in σ_ε², and degrees of freedom.
    moments : Moments
        Of fields that change from frame to frame.
    biases : tuple of PersistentBias
        Fields that last, by sets of sensors.
    """

    names: tuple[str, ...] = ()
    sums: Floats = field(default_factory=lambda: np.zeros((2, 0)))
    moments: Moments = Moments()
    biases: tuple[PersistentBias, ...] = ()

    @property
    def total(self) -> Noise:
        """Noise of all sensors."""
        return Noise(*self.sums.sum(axis=1).tolist())

    def of(self, names: Sequence[str]) -> Floats:
        """Squares and degrees of freedom (2, L) of some sensors."""
        if tuple(names) == self.names:
            return self.sums
        sums, numbers = np.zeros((2, len(names))), {name: k for k, name in enumerate(self.names)}
        for k, name in enumerate(names):
            if name in numbers:
                sums[:, k] = self.sums[:, numbers[name]]
        return sums

    def after(
        self,
        names: tuple[str, ...],
        sums: Floats,
        frame: Moments,
        biases: tuple[PersistentBias, ...],
    ) -> RememberedNoise:
        """With what a frame shows of some sensors."""
        others = [k for k, name in enumerate(self.names) if name not in names]
        if others:
            names = (*names, *(self.names[k] for k in others))
            sums = np.hstack([sums, self.sums[:, others]])
        return RememberedNoise(names, sums, frame, biases)


class FrameNoise(NamedTuple):
    """The noise that a frame goes by."""

    variances: Floats  # (L,) of each sensor, in σ_ε²; the typical one counts, too
    covariance: Floats  # (6, 6) zero where the pose is not free
    persistent: Floats  # (6, 6) of it, what lasts from frame to frame and leaves velocities alone
    remembered: RememberedNoise  # for the next frame
    residual_ratio: float  # of residuals to the largest that those before them let chance make


def noises_of(
    found: Matches,
    free: NDArray[np.bool_],
    before: Sequence[RememberedNoise],
    model: NoiseModel,
    estimates: Sequence[NoiseEstimate | None] = (),
) -> list[FrameNoise]:
    """The noise of K frames, from the residuals of each and from those before it.

    As a rule it is that of the frames so far.  A frame with residuals of another kind goes by its
    own, and is remembered as one that has the largest that chance makes.  `estimates` are what the
    fits saw already.
    """
    known = estimates or [None] * len(before)
    levels = [
        _level(found.at(k), memory, int(free.sum()), model, estimate)
        for k, (memory, estimate) in enumerate(zip(before, known, strict=True))
    ]
    frames = frames_of(found, np.array([one.scale for one in levels]), free, model.errors.outlying)
    met = found.met.mean(axis=1).tolist()
    parts = zip(before, levels, frames, met, strict=True)
    return [_frame_noise(found.names, *part, free, model) for part in parts]


class _Level(NamedTuple):
    """How large residuals are, sensor by sensor."""

    seen: Floats  # (L,) variances as offsets show them
    scale: Floats  # (L,) the same, drawn to that of all sensors, which residuals are measured in
    told: Floats  # (2, L) squares and degrees of freedom that are remembered
    degrees: float  # of freedom, of all that was seen
    residual_ratio: float  # as `FrameNoise` has it


def _level(
    matches: Matches,
    before: RememberedNoise,
    count: int,
    model: NoiseModel,
    estimate: NoiseEstimate | None,
) -> _Level:
    rules, past = model.errors, before.of(matches.names)
    sums = model.memory * past
    seen = estimate or errors_seen(matches, count, sums, rules)
    ratio = _residual_ratio(past, seen, model)
    told = sums + seen.own / [[max(ratio, 1.0)], [1.0]]
    if ratio > 1:
        sums = np.zeros_like(past)
        seen = errors_seen(matches, count, sums, rules)
    sums = sums + seen.own
    degrees = float(sums[1].sum())
    scale = pooled(sums, rules, 0.0 if degrees >= 1 else rules.typical_degrees)
    return _Level(seen.variances, np.maximum(scale, model.smallest**2), told, degrees, ratio)


def _frame_noise(
    names: tuple[str, ...],
    before: RememberedNoise,
    level: _Level,
    frame: Frame,
    met: float,
    free: NDArray[np.bool_],
    model: NoiseModel,
) -> FrameNoise:
    biases = frame.bias.after(before.biases, model.bias)
    sizes = biases[0].sizes(model.bias, model.by_chance)
    own = frame.moments if sizes is None else frame.without(sizes[0])
    moments = before.moments.joined(own, model.memory)
    variances, of_fields = _shares(moments, own, met, model)
    # fields last: a further frame shows no more of them
    factors = model.enlargement(int(free.sum()), np.array([level.degrees, *of_fields]))
    inner = np.tensordot(variances * factors, frame.parts, 1)
    inner += frame.by_calibration @ frame.by_calibration.T
    covariance, steady = np.zeros((2, 6, 6))
    if sizes is not None:
        steady[np.ix_(free, free)] = frame.by_fields @ sizes[1] @ frame.by_fields.T
    covariance[np.ix_(free, free)] = inner
    covariance += steady
    remembered = before.after(names, level.told, moments, biases)
    return FrameNoise(level.seen, covariance, steady, remembered, level.residual_ratio)


def _residual_ratio(past: Floats, seen: NoiseEstimate, model: NoiseModel) -> float:
    """How many times larger a frame's residuals are than chance makes them; 1 is just by chance."""
    known, degrees = float(past[1].sum()), float(seen.own[1].sum())
    if known < model.known or degrees < 1:
        return 0.0
    before = np.maximum(pooled(past, model.errors, 0.0), model.smallest**2)
    ratio = float((seen.own[0] / before).sum()) / degrees
    return ratio / float(fdtri(degrees, known, model.by_chance))


def _shares(moments: Moments, own: Moments, met: float, model: NoiseModel) -> tuple[Floats, Floats]:
    """Variances (4,) of independent errors and of fields; degrees of freedom (3,) of the latter.

    Each sensor meets so many features, of a frame that has its own moments.
    """
    weights = model.lasting_fields * np.array([met, met**2])
    # markers are where they are said to be, as surely as so many frames tell
    of_markers = model.lasting_fields * own.expected[3, 3] + LEAST
    believed = np.array([LEAST, weights[1], weights[1], of_markers])
    expected = moments.expected + np.diag(believed)
    size = np.array([1.0, model.lasting**2, model.lasting**2, 0.0])
    seen = moments.seen + believed * size
    scale = 1 / np.maximum(expected.diagonal(), LEAST)
    variances = nnls(scale[:, None] * expected, scale * seen)[0]
    variances[0] = max(variances[0], _LEAST_SHARE * seen[0] * scale[0])
    taken = np.array([weights[0], weights[0], model.lasting_fields * own.expected[0, 3] + LEAST])
    once, squared = own.expected[0, 1:] + taken, own.expected.diagonal()[1:] + believed[1:]
    return variances, once**2 / np.maximum(squared, LEAST)


def information_of(found: Matches, variances: Floats, spreads: Floats | None = None) -> Floats:
    """Σ_l Σ_i J_iᵀ J_i / s_l² (K, 6, 6) over the met features, for noise (K, L) in σ_ε².

    What features tell that are off by `spreads` (K, N, 3, 3) in the world is less.
    """
    frames, sensors, n, m, _ = found.J.shape
    weights = (found.shares / variances[..., None])[..., None, None]
    J, weighted = (
        one.swapaxes(1, 2).reshape(frames, n, sensors * m, 6)
        for one in (found.J, weights * found.J)
    )
    information = weighted.swapaxes(2, 3) @ J
    if spreads is not None:
        place = information[..., :3, :3]
        taken = spreads @ np.linalg.inv(np.eye(3) + place @ spreads)
        information = information - information[..., :3] @ taken @ information[..., :3, :]
    return np.asarray(information.sum(axis=1))
