"""Which feature of a pose is met by which detection, how far off, and what the extraction errs by.

At a blur σ a feature r away from its prediction pulls with r exp(−r²/4σ²), as in robust least
squares with the loss of Welsch.  Offsets of standard deviation s, weighted so, have the variance q
with 1/q = 1/s² + 1/2σ².  σ = 1.5 s and s² = q / (1 − q / 2σ²) follow from one another, from σ_ε
down and from what is known upwards, to where they agree.  Lengths are in σ_ε of their sensor.
Of noise, squares of residuals and degrees of freedom are added up (2, L): sensor by sensor.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any, TypeAlias

import numpy as np
from scipy.special import fdtri

from mixpose.constants import constant
from mixpose.density import DRAWING
from mixpose.records import Floats, Indices, Mask


@dataclass(frozen=True, eq=False)
class Matches:
    """L sensors at the N features (nodes) of a body, at one pose, or by a leading axis at K.

    What is not in view has no weight, what is not met no share; what is not there no offset and no
    Jacobian.  A sensor of one coordinate has 0 as its second.
    """

    names: tuple[str, ...]  # of the sensors
    dimensions: Indices  # (L,) coordinates of each
    sigmas: Floats  # (L,) σ_ε in sensor units
    weights: Floats  # (..., L, N) of the features in view; 0 of the others
    shares: Floats  # (..., L, N) how far each is met, 0 to its weight
    places: Floats  # (..., L, N, 2) where they are predicted, sensor units
    offsets: Floats  # (..., L, N, 2) observed minus predicted, σ_ε; of a merged pair its middle's
    J: Floats  # (..., L, N, 2, 6) Jacobian of the predicted places by the pose, σ_ε
    detections: Indices  # (..., L, N) by which each is met; -1 for none
    explained: Floats  # (..., L) share of the sensor's density that the pose accounts for
    unseen: Floats  # (..., L) weight of the features that face the sensor outside its view
    merged: Indices  # (..., L) pairs of features that share a detection
    count: Floats  # (..., L) number of detections
    crowd: Floats  # (..., L) of them per m-th power of σ_ε, around the prediction
    others: Floats  # (..., L) points in space by those that meet no feature, per σ_ε³ across
    unmatched_nearby: Floats  # (..., L) of no feature, about the body, where some feature is missed
    beside: Floats  # (..., L, N) how far the nearest detection but its own is, σ_ε; NaN for none
    finest: Floats  # (..., L) narrowest blur at which the density can be looked up, σ_ε
    extra: Floats  # (..., L, N) variances of what meets them beyond the noise, σ_ε²: of what is cut
    radii: Floats  # (..., L, N) of the spots that meet them, sensor units; 0 where nobody knows
    # (..., L, N, 2) chances that these are cut unseen, and variances then, σ_ε²; NaN: nobody knows
    cut: Floats
    by_calibration: Floats | None = None  # (..., L, N, 2, Q) offsets, σ_ε, by Q stated errors
    # (L,) numbers of the sensors that these are images of, as of clouds; None: each of its own
    owners: Indices | None = None

    def at(self, index: int | list[int] | None) -> Matches:
        """At one of K poses; None makes K = 1 of one."""
        arrays: dict[str, Any] = {
            name: None if (array := getattr(self, name)) is None else array[index]
            for name in _BY_POSE
        }
        return Matches(self.names, self.dimensions, self.sigmas, **arrays, owners=self.owners)

    def of_sensors(self, chosen: Sequence[int] | Mask | Indices) -> Matches:
        """Some of the sensors, by numbers or a mask, at one pose."""
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
        """K poses of the same sensors, of bodies of their own; fewer features are filled up."""
        if len(poses) == 1:
            return poses[0].at(None)
        most = max(one.weights.shape[1] for one in poses)
        stacks: dict[str, Any] = {}
        for name in _BY_POSE:
            parts = [getattr(one, name) for one in poses]
            if parts[0] is not None:
                sensors, *rest = parts[0].shape
                shape = (len(poses), sensors, most, *rest[1:]) if rest else (len(poses), sensors)
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
        """Share of the features that face each sensor that are met (..., L)."""
        return np.asarray(self.met / np.maximum(self.expected + self.unseen, 1e-12))

    @cached_property
    def owner(self) -> Indices:
        """Numbers (L,) of the sensors that these are images of, without gaps."""
        if self.owners is None:
            return np.arange(len(self.names))
        return np.unique(self.owners, return_inverse=True)[1]

    @cached_property
    def images(self) -> Indices:
        """How many images each sensor has (S,): a cloud three."""
        return np.bincount(self.owner)

    @cached_property
    def each_part(self) -> Floats:
        """What a coordinate counts (L,): half in images of a cloud, of which two show it."""
        return np.where(self.images > 1, 0.5, 1.0)[self.owner]

    def summed(self, values: Floats) -> Floats:
        """Sums (S,) over the images of each sensor, of values (L,) at one pose."""
        if self.owners is None:
            return values
        return np.asarray(np.bincount(self.owner, values), dtype=np.float64)

    @property
    def covered(self) -> Floats:
        """Share of the features that face each sensor that are met (S,): the mean of its images."""
        return np.asarray(self.summed(self.coverage) / self.images)

    @property
    def measurements(self) -> Floats:
        """Number of coordinates that are met (..., L)."""
        return np.asarray(self.met * self.dimensions * self.each_part)

    @cached_property
    def squares(self) -> Floats:
        """Sum of the squared offsets (..., L), σ_ε², of coordinates that count."""
        return np.asarray(np.vecdot(self.shares, self.squared) * self.each_part)

    @cached_property
    def met_by(self) -> Indices:
        """By how many sensors each feature is met (..., N)."""
        return np.asarray((self.shares > 0).sum(axis=-2))

    @property
    def rms(self) -> list[float | None]:
        """Root mean square of the offsets of each sensor at one pose, sensor units."""
        squares = np.vecdot(self.shares, self.squared)
        mean = self.sigmas * np.sqrt(squares / np.maximum(self.met, 1e-12))
        return [r if m > 0 else None for r, m in zip(mean.tolist(), self.met.tolist())]

    def rows(self) -> tuple[Floats, Floats]:
        """Jacobian (L, 2N, 6) and offsets (L, 2N) at one pose, by the roots of the shares."""
        roots = np.sqrt(self.shares)[..., None]
        L, N, m = self.offsets.shape
        J = (roots[..., None] * self.J).reshape(L, m * N, 6)
        return J, (roots * self.offsets).reshape(L, m * N)


_BY_SENSOR = ("names", "dimensions", "sigmas", "owners")
_BY_POSE = tuple([one.name for one in fields(Matches) if one.name not in _BY_SENSOR])


@dataclass(frozen=True)
class ErrorRules:
    """What is believed of the extraction's error before offsets are seen."""

    typical: float = constant(0.2, "of σ_ε: centres of blobs err by 0.01-0.3 px, σ_ε is 1.5 px")
    typical_degrees: float = constant(
        4.0, "degrees of freedom that `typical` counts as, and all sensors for one: two features"
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
        (0.1, 0.3, 1.0), "σ_ε that a detection may be off by beyond what it shows"
    )
    chances: tuple[float, float, float] = constant(
        (0.01, 0.0, 0.003),
        "of each: of 13,400 spots before a hand 1.0, 0.5, 0.1 % are 0.14, 0.22, 2.8 px off",
    )
    outlying: float = constant(3.5, "deviations from which an offset is no noise: 2 in 1000")

    def counted(self, variances: Floats, fields: float = 0.0) -> Floats:
        """Variances (L,) that sensors count by: `common` of their noise, or `fields`, is alike."""
        return np.asarray(variances + max(fields, self.common) * (variances.mean() - variances))

    def are_off(self, matches: Matches, variances: Floats) -> Mask:
        """Which features (L, N) are met farther off than errors of variances (L, N) put them."""
        far = matches.squared > self.outlying**2 * variances
        return np.asarray((matches.shares > 0) & far)

    @property
    def reach(self) -> float:
        """σ_ε around features within which detections count: as far as C is drawn, and `met`."""
        return math.sqrt(2) * DRAWING.reach + self.met


LEAST_VARIANCE = float(np.finfo(np.float32).eps)
"""In σ_ε²: densities of single precision do not resolve smaller offsets."""


NoiseEstimate: TypeAlias = tuple[Floats, Floats, Floats, Floats]
"""What offsets show: squares, in σ_ε², and degrees of freedom (2, L) of each sensor in the frame;
variances (L,) of its noise, together with what was known; its blurs (L,) in σ_ε, and those by what
was known before the frame."""


def welsch(squared: Floats, blurs: Floats) -> Floats:
    """How much squared offsets (L, N) count at blurs (L,), in least squares with Welsch's loss."""
    return np.asarray(np.exp(squared * (-0.25 / (blurs * blurs))[:, None]))


def errors_seen(
    matches: Matches, free: int, known: Floats, rules: ErrorRules = ErrorRules()
) -> NoiseEstimate:
    """How large errors are, of matches at a pose fitted to them in so many free directions.

    `known` (2, L) has the squares and degrees of freedom of each sensor's noise so far.
    """
    before = _blurs(pooled(known, rules, rules.typical_degrees), matches, rules)
    # what errs by more counts less
    expected = ((before / rules.blur) ** 2)[:, None]
    alike = expected / (expected + matches.extra)
    squared, counts = matches.squared * alike, matches.shares * alike * matches.each_part[:, None]
    given = before, squared, counts, matches, free, known, rules
    at = np.ones(len(before))
    wide = _seen_at(at, *given)
    while np.count_nonzero(wide[2] <= 0.9 * at):
        at = np.minimum(wide[2], at)
        wide = _seen_at(at, *given)
    if not np.count_nonzero(wide[2] > 1.2 * before):
        return wide
    at, narrow = before, _seen_at(before, *given)
    for _ in range(3):  # as a rule it takes one
        if (narrow[2] <= 1.2 * at).all():
            break
        at, narrow = narrow[2], _seen_at(narrow[2], *given)
    return max(wide, narrow, key=lambda seen: log_likelihood(seen[2], matches, free, rules))


def _blurs(variances: Floats, matches: Matches, rules: ErrorRules) -> Floats:
    """Blurs (L,) that suit a noise."""
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
    """The same, of squared offsets (L, N) that count so much, as seen at a blur (L,) for each."""
    weights = counts * welsch(squared, blurs)
    sums = map(sum, weights.tolist()), np.vecdot(weights, squared).tolist()
    coordinates, squares, degrees = [], [], []
    for m, blur, weight, square in zip(matches.dimensions.tolist(), blurs.tolist(), *sums):
        coordinates.append(m * weight + 1e-12)
        q = square / coordinates[-1]
        # at most twice what is seen: wider than the blur, offsets do not tell how wide they are
        factor = 1 / (1 - min(0.5 * q / blur**2, 0.5))
        # normal offsets weigh (1 + s²/2σ²)^(-m/2) on average
        degrees.append(factor ** (m / 2) * coordinates[-1])
        squares.append(factor * q * degrees[-1])
    # shares do not add up to whole ones: half a degree of freedom is none
    most = sum(degrees)
    is_enough = most - free > 0.5
    left = 1 - free / most if is_enough else 0.0
    own = float(is_enough) * np.array([squares, degrees])
    own[1] *= left
    variances = pooled(known + own, rules, rules.typical_degrees)
    # narrower only where this frame alone allows it, too: it may not be like those before it
    wide = np.maximum(variances, pooled(own, rules, 0.0))
    # half way to all sensors': what calibrations err by is in no sensor's own noise
    wide = (wide + float(wide @ coordinates) / sum(coordinates)) / 2
    return own, variances, _blurs(wide, matches, rules), before


def log_likelihood(
    blurs: Floats, matches: Matches, free: int, rules: ErrorRules = ErrorRules()
) -> Floats:
    """Of offsets (...), normal ones and some that are anywhere, less that of none being noise.

    What a pose is free to fit is paid for.  Blurs (L,) go by the noise.
    """
    m, variances = matches.dimensions[:, None], (blurs[:, None] / rules.blur) ** 2 + matches.extra
    peaks = (2 * np.pi * variances) ** (-0.5 * m)
    anywhere = np.where(m == 1, 2 * rules.met, np.pi * rules.met**2)
    odds = (1 / rules.astray - 1) * anywhere * peaks * np.exp(-0.5 * matches.squared / variances)
    believed = m * matches.shares * odds / (1 + odds)
    logs = believed * np.log(2 * np.pi * variances)
    each = np.sum([logs, believed, matches.shares * np.log1p(odds)], axis=(-2, -1))
    return np.asarray(each[2] + 0.5 * free * each[0] / np.maximum(each[1], 1e-12))


def pooled(
    sums: Floats, rules: ErrorRules, typical: float, deviation: float | None = None
) -> Floats:
    """Variances (L,) of squares and degrees of freedom (2, L), each drawn to that of all sensors.

    In that the typical variance, or that of another deviation, counts as `typical` degrees.
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
    own: Floats, known: Sequence[Floats], by_chance: float, rules: ErrorRules
) -> float:
    """Residuals of a frame (2, L) by the largest that chance makes of any that are known (2, L)."""
    ratio, degrees = 0.0, sum(own[1].tolist())
    for sums in known:
        before = sum(sums[1].tolist())
        if min(degrees, before) >= 1:
            largest = degrees * float(fdtri(degrees, before, by_chance))
            ratio = max(ratio, sum((own[0] / pooled(sums, rules, 0.0)).tolist()) / largest)
    return ratio
