"""What detections err by, as residuals show it, and the covariance of a pose that follows.

Offsets of the met features from their prediction are of two kinds.  What the extraction errs by is
independent from feature to feature, with a variance s_0².  What a calibration, a clock or a lens
errs by is alike in all features of a sensor: a field over its coordinates, an offset (s_1²) and
what turns, scales and shears the features' image (s_2²).  What the body errs by is alike in all
sensors: three coordinates of each marker (s_3²).  With weights W, the matrix R = 1 − J (JᵀWJ)⁻¹ JᵀW
that a pose leaves of errors, and the fields P_1, P_2 and P_3 as columns, let
K_jk = P_jᵀ W R P_k.  The residuals r have the expectations

    rᵀWr = s_0² tr R + Σ_k s_k² tr K_kk,      |P_jᵀWr|² = s_0² tr K_jj + Σ_k s_k² |K_jk|²

(C. R. Henderson's method of moments).  Their sums over the frames so far, fading, give the four
variances, in units of each sensor's noise.  Most of a field a pose takes for its own; the
covariance has it back:

    s_0² A⁻¹ + Σ_k s_k² A⁻¹ JᵀW P_k P_kᵀ WJ A⁻¹,         A = JᵀWJ.

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
from scipy.optimize import nnls
from scipy.special import chdtri, fdtri

from mixpose.constants import constant
from mixpose.density import ErrorRules, Noise, Offsets, Seen, errors_seen, pooled
from mixpose.judgement.association import Association
from mixpose.judgement.lasting import Lasting, LastingRules

Floats: TypeAlias = NDArray[np.float64]

_LEAST = 1e-6  # degrees of freedom: less is as good as none
_LEAST_SHARE = 0.05  # of the squares of residuals, that is not taken for fields
_MIN_INFORMATION = 1e-18  # per squared length or radian: less is as good as none
_LEAST_EIGENVALUE = 1e-14  # of an information matrix of diagonal 1: float64 tells no less from none


@dataclass(frozen=True)
class NoiseModel:
    """What is believed of detection noise before residuals are seen, and for how long."""

    errors: ErrorRules = ErrorRules()
    fields: LastingRules = LastingRules()
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
    """Sums over frames, from which the variances of independent errors and of fields follow.

    Attributes
    ----------
    seen : (4,) float64
        rᵀWr and |P_kᵀWr|².
    expected : (4, 4) float64
        Of these, by unit variances of each kind.
    """

    seen: Floats = np.zeros(4)
    expected: Floats = np.zeros((4, 4))

    def joined(self, other: Moments, memory: float) -> Moments:
        """Add those of another frame."""
        return Moments(memory * self.seen + other.seen, memory * self.expected + other.expected)


@dataclass(frozen=True)
class Residuals:
    """What is remembered of residuals: each sensor's noise in σ_ε, and what fields have of it.

    Some fields change from frame to frame, as `moments` know; some last.
    """

    noise: Mapping[str, Noise] = field(default_factory=dict)
    moments: Moments = Moments()
    lasting: tuple[Lasting, ...] = ()

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
    lasting : (6, 6) float64
        Of it, what lasts from frame to frame and leaves velocities alone.
    remembered : Residuals
        For the next frame.
    """

    variances: Floats
    covariance: Floats
    lasting: Floats
    remembered: Residuals


def noise_of(
    associations: Sequence[Association],
    free: NDArray[np.bool_],
    before: Residuals,
    model: NoiseModel,
) -> FrameNoise:
    """The noise of a frame, from its residuals and from those before it.

    As a rule it is that of the frames so far.  A frame with residuals of another kind goes by its
    own, and is remembered as one that has the largest that chance makes.
    """
    offsets, count = joined_offsets(associations), int(free.sum())
    last = [before.noise.get(one.name, Noise()) for one in associations]
    past = np.array([(one.squares, one.degrees) for one in last]).T
    sums = model.memory * past
    seen = errors_seen(offsets, count, sums, model.errors)
    surplus = _surplus(past, seen, model)
    told = sums + seen.own / [[max(surplus, 1.0)], [1.0]]
    if surplus > 1:
        sums = np.zeros_like(past)
        seen = errors_seen(offsets, count, sums, model.errors)
    sums = sums + seen.own
    degrees = float(sums[1].sum())
    typical = 0.0 if degrees >= 1 else model.errors.typical_degrees
    variances = np.maximum(pooled(sums, model.errors, typical), model.smallest**2)
    frame = _moments(associations, offsets, variances, free, model)
    lasting = frame.lasting.after(before.lasting, model.fields)
    sizes = lasting.sizes(model.fields)
    own = frame.moments if sizes is None else frame.without(sizes.mean)
    moments = before.moments.joined(own, model.memory)
    met = float(np.mean([one.met for one in associations]))
    shares = _shares(moments, own, met, model)
    # fields last: a further frame shows no more of them
    factors = [model.enlargement(count, one) for one in (degrees, *shares.degrees)]
    covariance, steady = np.zeros((6, 6)), np.zeros((6, 6))
    inner = np.tensordot(shares.variances * factors, frame.parts, 1)
    inner += frame.by_calibration @ frame.by_calibration.T
    if sizes is not None:
        steady[np.ix_(free, free)] = frame.by_fields @ sizes.moments @ frame.by_fields.T
    covariance[np.ix_(free, free)] = inner
    covariance += steady
    noise = {one.name: Noise(*pair) for one, pair in zip(associations, told.T.tolist())}
    kept = lasting.kept(before.lasting, model.fields)
    remembered = Residuals({**before.noise, **noise}, moments, kept)
    return FrameNoise(seen.variances, covariance, steady, remembered)


def joined_offsets(associations: Sequence[Association]) -> Offsets:
    """Offsets of the features of all sensors."""
    return Offsets(
        np.concatenate([one.squared for one in associations]),
        np.concatenate([one.shares for one in associations]),
        np.repeat(np.arange(len(associations)), [len(one.shares) for one in associations]),
        np.array([one.J.shape[1] for one in associations]),
        np.array([one.finest for one in associations]),
    )


def _surplus(past: Floats, seen: Seen, model: NoiseModel) -> float:
    """How many times larger a frame's residuals are than chance makes them; 1 is just by chance."""
    known, degrees = float(past[1].sum()), float(seen.own[1].sum())
    if known < model.known or degrees < 1:
        return 0.0
    before = np.maximum(pooled(past, model.errors, 0.0), model.smallest**2)
    ratio = float((seen.own[0] / before).sum()) / degrees
    return ratio / float(fdtri(degrees, known, model.by_chance))


class _Shares(NamedTuple):
    """Variances (4,) of independent errors and of fields; degrees of freedom (3,) of the latter."""

    variances: Floats
    degrees: Floats


def _shares(moments: Moments, own: Moments, met: float, model: NoiseModel) -> _Shares:
    """What moments say; each sensor meets so many features, of a frame that has its own moments."""
    weights = model.lasting_fields * np.array([met, met**2])
    # markers are where they are said to be, as surely as so many frames tell
    of_markers = model.lasting_fields * own.expected[3, 3] + _LEAST
    believed = np.array([_LEAST, weights[1], weights[1], of_markers])
    expected = moments.expected + np.diag(believed)
    size = np.array([1.0, model.lasting**2, model.lasting**2, 0.0])
    seen = moments.seen + believed * size
    scale = 1 / np.maximum(expected.diagonal(), _LEAST)
    variances = nnls(scale[:, None] * expected, scale * seen)[0]
    variances[0] = max(variances[0], _LEAST_SHARE * seen[0] * scale[0])
    taken = np.array([weights[0], weights[0], model.lasting_fields * own.expected[0, 3] + _LEAST])
    once, squared = own.expected[0, 1:] + taken, own.expected.diagonal()[1:] + believed[1:]
    return _Shares(variances, once**2 / np.maximum(squared, _LEAST))


class _Frame(NamedTuple):
    """What one frame shows.

    Attributes
    ----------
    moments : Moments
    parts : (4, k, k) float64
        Covariances that unit variances of each kind make.
    lasting : Lasting
        What it says of fields that last.
    by_fields : (k, q) float64
        How these move the pose.
    by_calibration : (k, K) float64
        How calibrations do that are off by a standard deviation in one thing each.
    rest : (K, 1 + q) float64
        Weighted residuals, and what a pose leaves of the fields that may last.
    fields : list of (K, n) float64
        Those that change, of each kind.
    """

    moments: Moments
    parts: Floats
    lasting: Lasting
    by_fields: Floats
    by_calibration: Floats
    rest: Floats
    fields: list[Floats]

    def without(self, sizes: Floats) -> Moments:
        """Moments of what is left where fields of sizes (q,) are taken off."""
        left = self.rest[:, 0] - self.rest[:, 1:] @ sizes
        seen = [float(left @ left), *(float(((P.T @ left) ** 2).sum()) for P in self.fields)]
        expected = self.moments.expected
        return Moments(np.array([*seen, self.moments.seen[3]]) * expected.any(), expected)


def _moments(
    associations: Sequence[Association],
    offsets: Offsets,
    variances: Floats,
    free: NDArray[np.bool_],
    model: NoiseModel,
) -> _Frame:
    """Of one frame.  Detections that are farther off than the extraction errs are left out."""
    count = int(free.sum())
    clear = offsets.squared <= model.errors.outlying**2 * variances[offsets.sensor]
    ends = np.cumsum(np.bincount(offsets.sensor, minlength=len(associations)))[:-1]
    parts, blocks, shifts, doubts = [], [], [], []
    for one, inlying, variance in zip(associations, np.split(clear, ends), variances.tolist()):
        shares = np.where(inlying, one.shares, 0.0)
        scale = np.sqrt(shares / variance)[:, None, None] / one.sigma
        rows = np.concatenate([one.J[..., free], one.offsets[..., None]], axis=2)
        parts.append((scale * rows).reshape(-1, count + 1))
        blocks.append(_fields(one.places, shares))
        shifts.append((scale * one.J[..., :3]).reshape(-1, 3))
        if one.by_calibration is not None:
            rows = (scale * one.by_calibration).reshape(parts[-1].shape[0], -1)
            doubts.append(parts[-1][:, :count].T @ rows)
    weighted, shift = np.concatenate(parts), np.concatenate(shifts)
    shift /= max(float(np.sqrt((shift**2).sum() / max(shift.size, 1))), _LEAST)
    J, r = weighted[:, :count], weighted[:, count]
    P = [_side_by_side(kind) for kind in zip(*blocks)]
    inverse = _inverse(J.T @ J)
    drawn = [inverse @ (J.T @ one) for one in P]
    left = [one - J @ each for one, each in zip(P, drawn, strict=True)]
    rest, split = np.hstack(left), P[0].shape[1]
    information, vector = rest.T @ rest, rest.T @ r
    K, once = np.zeros((3, 3)), np.zeros(3)
    kinds = [slice(split), slice(split, None)]
    K[:2, :2] = [[float((information[a, b] ** 2).sum()) for b in kinds] for a in kinds]
    once[:2] = [float(np.trace(information[a, a])) for a in kinds]
    of_markers = _of_markers(associations, shift, J, r, left, inverse)
    K[2], once[2] = of_markers.K, of_markers.once
    K[:2, 2] = K[2, :2]
    degrees = float(offsets.dimensions[offsets.sensor] @ (clear * offsets.shares)) - count
    squares = [float(r @ r), *(float(((one.T @ r) ** 2).sum()) for one in P)]
    squares.append(of_markers.squares)
    roots = np.sqrt(variances)
    sizes = np.concatenate([np.repeat(roots, [f[k].shape[1] for f in blocks]) for k in (0, 1)])
    names = tuple(one.name for one in associations)
    lasting = Lasting(names, information / np.outer(sizes, sizes), vector / sizes)
    expected = np.block([[np.array([[degrees]]), once[None]], [once[:, None], K]])
    own = Moments(np.array(squares), expected) if degrees > 0 else Moments()
    by_kind = np.array([inverse, *(one @ one.T for one in drawn), of_markers.part])
    by_calibration = inverse @ np.hstack([np.zeros((count, 0)), *doubts])
    rest = np.column_stack([r, rest / sizes])
    return _Frame(own, by_kind, lasting, np.hstack(drawn) / sizes, by_calibration, rest, P)


class _OfMarkers(NamedTuple):
    """K_3k (3,), tr K_33, |P_3ᵀWr|², and the covariance that a unit variance makes."""

    K: Floats
    once: float
    squares: float
    part: Floats


def _of_markers(
    associations: Sequence[Association],
    shift: Floats,
    J: Floats,
    r: Floats,
    left: Sequence[Floats],
    inverse: Floats,
) -> _OfMarkers:
    """Moments of what markers are off by, of which P_3 has three columns each: one by one.

    `shift` (K, 3) is how features move with the body, in units in which their images move by the
    noise; a row for each coordinate of each sensor.
    """
    marker = np.concatenate([np.repeat(one.features, one.J.shape[1]) for one in associations])
    order = np.argsort(marker, kind="stable")
    starts = np.flatnonzero(np.diff(marker[order], prepend=-1))
    columns = np.hstack([J, r[:, None], shift, *left])[order]
    own = np.add.reduceat(shift[order][:, :, None] * columns[:, None], starts, axis=0)
    widths = np.cumsum([J.shape[1], 1, 3, left[0].shape[1]])
    by_pose, by_rest, by_shift, *by_fields = np.split(own, widths, axis=2)
    taken, flat = by_pose @ inverse, by_pose.reshape(-1, J.shape[1])
    drawn = inverse @ flat.T
    spread = drawn @ flat
    within = by_shift - 2 * taken @ by_pose.swapaxes(1, 2)
    K = float((within * by_shift).sum()) + float((spread * spread.T).sum())
    return _OfMarkers(
        np.array([*(float((one**2).sum()) for one in by_fields), K]),
        float(np.trace(by_shift.sum(axis=0)) - (taken * by_pose).sum()),
        float((by_rest**2).sum()),
        drawn @ drawn.T,  # not less than nothing where a direction is hardly determined
    )


def _side_by_side(fields: Sequence[Floats]) -> Floats:
    """Fields of each sensor as columns of their own."""
    P = np.zeros(np.sum([one.shape for one in fields], axis=0))
    row = column = 0
    for one in fields:
        below, beside = row + one.shape[0], column + one.shape[1]
        P[row:below, column:beside] = one
        row, column = below, beside
    return P


def _fields(places: Floats, shares: Floats) -> tuple[Floats, Floats]:
    """What all features (n, m) of a sensor have in common, with their shares.

    Offsets (nm, m), and what turns, scales and shears (nm, m²).
    """
    n, m = places.shape
    total = max(float(shares.sum()), _LEAST)
    away = places - shares @ places / total
    size = float(np.sqrt((shares @ (away * away)).sum() / (m * total)))
    roots, axes = np.sqrt(shares)[:, None, None, None], np.eye(m)
    slants = roots * away[:, None, :, None] / max(size, _LEAST) * axes[:, None]
    return (roots[..., 0] * axes).reshape(n * m, m), slants.reshape(n * m, m * m)


def _inverse(information: Floats) -> Floats:
    """Inverse of an information matrix.

    Directions that the data leave open get the variance that their information says: large, and
    at most what float64 can invert.
    """
    scale = 1.0 / np.sqrt(np.maximum(information.diagonal(), _MIN_INFORMATION))
    values, vectors = np.linalg.eigh(information * scale * scale[:, None])
    inverse = (vectors / np.maximum(values, _LEAST_EIGENVALUE)) @ vectors.T * scale * scale[:, None]
    return np.asarray((inverse + inverse.T) / 2)


def information_of(associations: Sequence[Association], variances: Floats) -> Floats:
    """Σ_l Σ_i J_iᵀ J_i / s_l² (6, 6) over the met features, for noise (L,) in σ_ε²."""
    information = np.zeros((6, 6))
    for one, variance in zip(associations, variances.tolist(), strict=True):
        weighted = (one.J * (one.shares / (variance * one.sigma**2))[:, None, None]).reshape(-1, 6)
        information += weighted.T @ one.J.reshape(-1, 6)
    return information
