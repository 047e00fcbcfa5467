"""Matches of features and detections at a pose, and the size of extraction errors by offsets.

At a blur σ a feature r away from its prediction pulls with r exp(−r²/4σ²), as in robust least
squares with the loss of Welsch.  Offsets of standard deviation s, weighted so, have the variance q
with 1/q = 1/s² + 1/2σ².  σ = 1.5 s and s² = q / (1 − q / 2σ²) are iterated until they agree, from
σ_ε down and from the noise known before upwards.  Lengths are in σ_ε of their sensor.
Of noise, squares of residuals and degrees of freedom are added up (2, L): sensor by sensor.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any, TypeAlias

import numpy as np
from scipy.special import fdtri

from mixpose.constants import constant
from mixpose.density import DRAWING
from mixpose.records import Floats, Indices, Mask, replace


@dataclass(frozen=True, eq=False)
class Matches:
    """Matches of N features (nodes) of a body in L sensors, at one pose, or at K by a leading axis.

    Features out of view have no weight and no Jacobian, features not met no share and no offset.
    A sensor of one coordinate has 0 as its second.
    """

    names: tuple[str, ...]  # of the sensors
    dimensions: Indices  # (L,) number of coordinates
    sigmas: Floats  # (L,) σ_ε in sensor units
    weights: Floats  # (..., L, N) of the features in view; 0 of the others
    shares: Floats  # (..., L, N) part of the weight that is met
    places: Floats  # (..., L, N, 2) predicted, sensor units
    offsets: Floats  # (..., L, N, 2) observed minus predicted, σ_ε; merged pairs: of the middle
    J: Floats  # (..., L, N, 2, 6) Jacobian of the predicted places by the pose, σ_ε
    detections: Indices  # (..., L, N) number of the one that meets a feature; -1 for none
    explained: Floats  # (..., L) share of the sensor's density that the pose explains
    unseen: Floats  # (..., L) weight of the features that face the sensor outside its view
    merged: Indices  # (..., L) pairs of features that share a detection
    count: Floats  # (..., L) number of detections
    crowd: Floats  # (..., L) their density around the prediction, per m-th power of σ_ε
    space_crowd: Floats  # (..., L) density of points in space by unmatched detections, per σ_ε³
    unmatched_nearby: Floats  # (..., L) unmatched detections near a body with missed features
    neighbour_distance: Floats  # (..., L, N) to the nearest other detection, σ_ε; NaN for none
    finest: Floats  # (..., L) narrowest blur at which the density can be looked up, σ_ε
    extra: Floats  # (..., L, N) variances of detections beyond the noise, σ_ε², as of cut spots
    radii: Floats  # (..., L, N) of the spots that meet them, sensor units; 0 where unknown
    # (..., L, N, 2) chances that spots are cut unseen, and variances then, σ_ε²; NaN: unknown
    cut: Floats
    by_calibration: Floats | None = None  # (..., L, N, 2, Q) offsets, σ_ε, by Q stated errors
    # (L,) numbers of the sensors of these images, as of a cloud; None: all of different ones
    owners: Indices | None = None

    def at(self, index: int | list[int] | None) -> Matches:
        """Return the matches at one of K poses; None adds an axis with K = 1."""
        arrays: dict[str, Any] = {
            name: None if (array := getattr(self, name)) is None else array[index]
            for name in _BY_POSE
        }
        return Matches(self.names, self.dimensions, self.sigmas, **arrays, owners=self.owners)

    def of_sensors(self, chosen: Sequence[int] | Mask | Indices) -> Matches:
        """Return the matches of chosen sensors, by numbers or a mask, at one pose."""
        numbers = np.arange(len(self.names))[np.asarray(chosen)].tolist()
        return replace(
            self.at(numbers),
            names=tuple([self.names[k] for k in numbers]),
            dimensions=self.dimensions[numbers],
            sigmas=self.sigmas[numbers],
            owners=None if self.owners is None else self.owner[numbers],
        )

    @classmethod
    def stacked(cls, poses: Sequence[Matches]) -> Matches:
        """Stack K poses of several bodies in the same sensors; fewer features are filled up."""
        if len(poses) == 1:
            return poses[0].at(None)
        most = max(pose.weights.shape[1] for pose in poses)
        stacks: dict[str, Any] = {}
        for name in _BY_POSE:
            parts = [getattr(pose, name) for pose in poses]
            if parts[0] is not None:
                sensors, *axes = parts[0].shape
                shape = (len(poses), sensors, most, *axes[1:]) if axes else (len(poses), sensors)
                stacks[name] = np.full(shape, -1 if name == "detections" else 0, parts[0].dtype)
                for stack, part in zip(stacks[name], parts):
                    stack[tuple(map(slice, part.shape))] = part
        return replace(poses[0], **stacks)

    @cached_property
    def squared(self) -> Floats:
        """Squared offsets (..., L, N), σ_ε²."""
        return np.asarray(np.vecdot(self.offsets, self.offsets))

    @cached_property
    def met(self) -> Floats:
        """Sum of the shares (..., L)."""
        return np.asarray(self.shares.sum(axis=-1))

    @cached_property
    def expected(self) -> Floats:
        """Sum of the weights in view (..., L)."""
        return np.asarray(self.weights.sum(axis=-1))

    @property
    def missed(self) -> Floats:
        """Weight in view that is not met (..., L)."""
        return self.expected - self.met

    @cached_property
    def coverage(self) -> Floats:
        """Share of the features facing each sensor that are met (..., L)."""
        return np.asarray(self.met / np.maximum(self.expected + self.unseen, 1e-12))

    @cached_property
    def owner(self) -> Indices:
        """Numbers (L,) of the sensors that these are images of, without gaps."""
        if self.owners is None:
            return np.arange(len(self.names))
        return np.unique(self.owners, return_inverse=True)[1]

    @cached_property
    def images(self) -> Indices:
        """Number of images of each sensor (S,): three of a cloud."""
        return np.bincount(self.owner)

    @cached_property
    def coordinate_weight(self) -> Floats:
        """Weight of a coordinate (L,): 1/2 in the images of a cloud, as two of them show it."""
        if self.owners is None:
            return np.ones(len(self.names))
        return np.where(self.images > 1, 0.5, 1.0)[self.owner]

    def summed(self, values: Floats) -> Floats:
        """Sum values (L,) at one pose over the images of each sensor (S,)."""
        if self.owners is None:
            return values
        return np.asarray(np.bincount(self.owner, values), dtype=np.float64)

    @property
    def covered(self) -> Floats:
        """Share of the features facing each sensor that are met (S,): the mean of its images."""
        return np.asarray(self.summed(self.coverage) / self.images)

    @property
    def measurements(self) -> Floats:
        """Number of coordinates that are met (..., L)."""
        return np.asarray(self.met * self.dimensions * self.coordinate_weight)

    @cached_property
    def squares(self) -> Floats:
        """Weighted sum of the squared offsets (..., L), σ_ε²."""
        return np.asarray(np.vecdot(self.shares, self.squared) * self.coordinate_weight)

    @cached_property
    def met_by(self) -> Indices:
        """Number of sensors that meet each feature (..., N)."""
        return np.asarray((self.shares > 0).sum(axis=-2))

    @property
    def rms(self) -> list[float | None]:
        """Root mean square of the offsets of each sensor at one pose, sensor units."""
        squares = np.vecdot(self.shares, self.squared)
        mean = self.sigmas * np.sqrt(squares / np.maximum(self.met, 1e-12))
        return [r if m > 0 else None for r, m in zip(mean.tolist(), self.met.tolist())]

    def rows(self) -> tuple[Floats, Floats]:
        """Return the Jacobian (L, 2N, 6) and offsets (L, 2N) at one pose, times roots of shares."""
        roots = np.sqrt(self.shares)[..., None]
        L, N, m = self.offsets.shape
        J = (roots[..., None] * self.J).reshape(L, m * N, 6)
        return J, (roots * self.offsets).reshape(L, m * N)


_BY_SENSOR = ("names", "dimensions", "sigmas", "owners")
_BY_POSE = tuple([entry.name for entry in fields(Matches) if entry.name not in _BY_SENSOR])


@dataclass(frozen=True)
class ErrorRules:
    """Priors of extraction errors, before offsets are seen."""

    typical: float = constant(0.2, "of σ_ε: centres of blobs err by 0.01-0.3 px, σ_ε is 1.5 px")
    typical_degrees: float = constant(
        4.0, "degrees of freedom of `typical`, and of the mean of all sensors in each: two features"
    )
    blur: float = constant(1.5, "of the noise: Welsch's loss is then 95 % as efficient as squares")
    narrowest: float = constant(0.05, "of σ_ε, the last blur: centres err by 0.03 σ_ε at best")
    astray: float = constant(0.1, "chance that an offset within `met` is no noise: a cut spot")
    met: float = constant(3.0, "σ_ε within which detections may be a feature's: pull 1/10")
    common: float = constant(
        0.25,
        "of the noise is that of all sensors, at least: half of it costs 10 % beside ranges, and "
        "none of it 20 % where a body is off",
    )
    cuts: tuple[float, float, float] = constant(
        (0.1, 0.3, 1.0), "σ_ε by which a detection may be off although it looks whole"
    )
    chances: tuple[float, float, float] = constant(
        (0.01, 0.0, 0.003),
        "of these: of 13,400 spots before a hand 1.0, 0.5, 0.1 % are 0.14, 0.22, 2.8 px off",
    )
    outlying: float = constant(3.5, "deviations from which an offset is no noise: 2 in 1000")

    def counted(self, variances: Floats, fields: float = 0.0) -> Floats:
        """Return variances (L,) that weigh sensors, with a common part of `common` or `fields`."""
        mean = variances.sum() / len(variances)
        return np.asarray(variances + max(fields, self.common) * (mean - variances))

    def are_off(self, matches: Matches, variances: Floats) -> Mask:
        """Return a mask (L, N) of features met too far off for errors of variances (L, N)."""
        far = matches.squared > self.outlying**2 * variances
        return np.asarray((matches.shares > 0) & far)

    @property
    def reach(self) -> float:
        """σ_ε around features within which detections matter: as far as C is drawn, plus `met`."""
        return math.sqrt(2) * DRAWING.reach + self.met


LEAST_VARIANCE = float(np.finfo(np.float32).eps)
"""In σ_ε²: densities of single precision do not resolve smaller offsets."""


NoiseEstimate: TypeAlias = tuple[Floats, Floats, Floats, Floats]
"""Noise by offsets: squares, σ_ε², and degrees of freedom (2, L) of the frame; variances (L,) by it
and earlier frames; blurs (L,) in σ_ε that suit the noise, and those by earlier frames alone."""


def welsch(squared: Floats, blurs: Floats) -> Floats:
    """Return weights of squared offsets (L, N) at blurs (L,): least squares with Welsch's loss."""
    return np.asarray(np.exp(squared * (-0.25 / (blurs * blurs))[:, None]))


def errors_seen(
    matches: Matches, free: int, known: Floats, rules: ErrorRules = ErrorRules()
) -> NoiseEstimate:
    """Estimate errors from matches at a pose that was fitted to them in `free` directions.

    `known` (2, L) has the squares and degrees of freedom of each sensor's noise so far.
    """
    before = _blurs(pooled(known, rules, rules.typical_degrees), matches, rules)
    # detections of extra variance count less
    expected = ((before / rules.blur) ** 2)[:, None]
    alike = expected / (expected + matches.extra)
    counts = matches.shares * alike * matches.coordinate_weight[:, None]
    arguments = before, matches.squared * alike, counts, matches, free, known, rules
    blurs = np.ones(len(before))
    wide = _seen_at(blurs, *arguments)
    while np.count_nonzero(wide[2] <= 0.9 * blurs):
        blurs = np.minimum(wide[2], blurs)
        wide = _seen_at(blurs, *arguments)
    if not np.count_nonzero(wide[2] > 1.2 * before):
        return wide
    blurs, narrow = before, _seen_at(before, *arguments)
    for _ in range(3):  # as a rule it takes one
        if (narrow[2] <= 1.2 * blurs).all():
            break
        blurs, narrow = narrow[2], _seen_at(narrow[2], *arguments)
    return max(wide, narrow, key=lambda seen: log_likelihood(seen[2], matches, free, rules))


def _blurs(variances: Floats, matches: Matches, rules: ErrorRules) -> Floats:
    """Return the blurs (L,) that suit a noise."""
    return np.minimum(np.maximum(rules.blur * np.sqrt(variances), matches.finest), 1.0)


def _seen_at(
    blurs: Floats,
    before: Floats,
    squared: Floats,
    counts: Floats,
    matches: Matches,
    free: int,
    known: Floats,
    rules: ErrorRules,
) -> NoiseEstimate:
    """Estimate errors from squared offsets (L, N) with weights `counts`, as seen at blurs (L,)."""
    weights = counts * welsch(squared, blurs)
    sums = map(sum, weights.tolist()), np.vecdot(weights, squared).tolist()
    coordinates, squares, degrees = [], [], []
    for m, blur, weight, square in zip(matches.dimensions.tolist(), blurs.tolist(), *sums):
        coordinates.append(m * weight + 1e-12)
        q = square / coordinates[-1]
        # at most twice q: offsets wider than the blur do not show how wide they are
        factor = 1 / (1 - min(0.5 * q / blur**2, 0.5))
        # normal offsets weigh (1 + s²/2σ²)^(-m/2) on average
        degrees.append(factor ** (m / 2) * coordinates[-1])
        squares.append(factor * q * degrees[-1])
    # sums of shares are not whole numbers: half a degree of freedom counts as none
    most = sum(degrees)
    is_enough = most - free > 0.5
    remaining = 1 - free / most if is_enough else 0.0
    in_frame = float(is_enough) * np.array([squares, degrees])
    in_frame[1] *= remaining
    variances = pooled(known + in_frame, rules, rules.typical_degrees)
    # not narrower than by this frame alone, which may differ from those before it
    wide = np.maximum(variances, pooled(in_frame, rules, 0.0))
    # half way to the mean of all sensors: errors of calibrations are in no sensor's own noise
    wide = (wide + float(wide @ coordinates) / sum(coordinates)) / 2
    return in_frame, variances, _blurs(wide, matches, rules), before


def log_likelihood(
    blurs: Floats, matches: Matches, free: int, rules: ErrorRules = ErrorRules()
) -> Floats:
    """Return log likelihoods (...) of normal offsets with outliers, over those of outliers alone.

    They include the cost of the free directions.  The noise is that which suits the blurs (L,).
    """
    m, variances = matches.dimensions[:, None], (blurs[:, None] / rules.blur) ** 2 + matches.extra
    peaks = (2 * np.pi * variances) ** (-0.5 * m)
    anywhere = np.where(m == 1, 2 * rules.met, np.pi * rules.met**2)
    odds = (1 / rules.astray - 1) * anywhere * peaks * np.exp(-0.5 * matches.squared / variances)
    believed = m * matches.shares * odds / (1 + odds)
    logs = believed * np.log(2 * np.pi * variances)
    sums = np.sum([logs, believed, matches.shares * np.log1p(odds)], axis=(-2, -1))
    return np.asarray(sums[2] + 0.5 * free * sums[0] / np.maximum(sums[1], 1e-12))


def pooled(
    sums: Floats, rules: ErrorRules, typical: float, deviation: float | None = None
) -> Floats:
    """Return variances (L,) of squares and degrees of freedom (2, L), drawn to that of all sensors.

    In the latter the typical variance, or that of `deviation`, counts as `typical` degrees.
    """
    deviation = rules.typical if deviation is None else deviation
    squares, degrees = sums.tolist()
    most = sum(degrees) + typical
    common = (sum(squares) + typical * deviation**2) / max(most, 1e-12)
    pull = min(rules.typical_degrees, most)
    drawn = pull * common
    pairs, least = zip(squares, degrees), LEAST_VARIANCE
    return np.array([max((s + drawn) / max(d + pull, 1e-12), least) for s, d in pairs])


def residual_ratio(
    frame: Floats, known: Sequence[Floats], by_chance: float, rules: ErrorRules
) -> float:
    """Return the ratio of a frame's residuals (2, L) to the largest by chance of `known` (2, L)."""
    ratio, degrees = 0.0, sum(frame[1].tolist())
    for sums in known:
        before = sum(sums[1].tolist())
        if min(degrees, before) >= 1:
            largest = degrees * float(fdtri(degrees, before, by_chance))
            ratio = max(ratio, sum((frame[0] / pooled(sums, rules, 0.0)).tolist()) / largest)
    return ratio
