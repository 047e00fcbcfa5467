"""The frozen records that pass from stage to stage.

    frames -> FrameSet -> extraction -> Pattern (g0) -> density (g) -> estimator -> Estimate

Sensor coordinates y are what the sensor measures: pixels (u right, v down, pixel centres at
integers) for cameras, lengths for ranges.  A camera has m = 2 coordinates, a range m = 1.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

Floats: TypeAlias = NDArray[np.float64]
Singles: TypeAlias = NDArray[np.float32]
Indices: TypeAlias = NDArray[np.intp]
Mask: TypeAlias = NDArray[np.bool_]
Image: TypeAlias = NDArray[np.uint8] | NDArray[np.uint16] | NDArray[np.float32]


@dataclass(frozen=True)
class PointPattern:
    """Feature pattern g0 as a sum of weighted points.

    Raises `ValueError` if shapes do not match, a value is not finite or a weight is negative.
    """

    points: Floats  # (M, m) in sensor coordinates
    weights: Floats  # (M,) positive; 1 for a plain detection
    # (M,) by how much more than others each may err, sensor units; 0 but for blobs that are cut
    deviations: Floats = field(default_factory=lambda: np.zeros(()))
    # (M,) of a disk of as much area as is seen of each, sensor units; 0 where that is not known
    radii: Floats = field(default_factory=lambda: np.zeros(()))
    # (M, 2) chance that each is cut or merged unseen, and what it errs by then, sensor units
    cut: Floats | None = None

    is_even: bool = field(init=False, default=True)  # whether none errs by more than others

    @property
    def size(self) -> int:
        """M, the number of points."""
        return len(self.points)

    @cached_property
    def total(self) -> float:
        """Sum of the weights."""
        return float(self.weights.sum())

    @cached_property
    def has_radii(self) -> bool:
        """Whether the radius of each point is known."""
        return bool(self.size and self.radii.all())

    def only(self, chosen: Mask) -> PointPattern:
        """Some of the points (M,)."""
        return self._with(
            self.deviations[chosen],
            None if self.cut is None else self.cut[chosen],
            points=self.points[chosen],
            weights=self.weights[chosen],
            radii=self.radii[chosen],
        )

    def erring(self, deviations: Floats, cut: Floats | None) -> PointPattern:
        """With other `deviations` (M,) and `cut` (M, 2)."""
        same = {"points": self.points, "weights": self.weights, "radii": self.radii}
        return self._with(deviations, cut, **same)

    def _with(self, deviations: Floats, cut: Floats | None, **fields: Floats) -> PointPattern:
        """Of what was checked already."""
        made = object.__new__(PointPattern)
        is_even = not np.count_nonzero(deviations)
        made.__dict__.update(fields, deviations=deviations, cut=cut, is_even=is_even)
        return made

    def weighed(self, deviation: float) -> Floats:
        """Weights (M,) as exact as detections are beside those that err by a deviation."""
        if self.is_even:
            return self.weights
        return np.asarray(self.weights / (1 + (self.deviations / deviation) ** 2))

    def __post_init__(self) -> None:
        points = np.asarray(self.points, dtype=np.float64)
        weights = np.asarray(self.weights, dtype=np.float64)
        object.__setattr__(self, "points", points)
        object.__setattr__(self, "weights", weights)
        for name in ("deviations", "radii"):
            if (own := getattr(self, name)).shape != weights.shape:
                object.__setattr__(self, name, np.full(weights.shape, own))
        object.__setattr__(self, "is_even", not np.count_nonzero(self.deviations))
        if points.ndim != 2:
            raise ValueError(
                f"points: found the shape {points.shape}; allowed: (M, 2) for pixels, (M, 1) for "
                "ranges"
            )
        if weights.shape != points.shape[:1]:
            raise ValueError(
                f"weights: found the shape {weights.shape}; allowed: {points.shape[:1]}, one per "
                "point"
            )
        if not (np.isfinite(points).all() and np.isfinite(weights).all()):
            raise ValueError("points and weights: found NaN or infinity; leave such points out")
        if (weights < 0).any():
            raise ValueError(f"weights: found {weights.min():g}; allowed: 0 or more")

    @property
    def dimension(self) -> int:
        """m, the number of sensor coordinates."""
        return int(self.points.shape[1])

    @property
    def extent(self) -> tuple[Floats, Floats]:
        """Smallest and largest sensor coordinates (m,); of one point at least."""
        return self.points.min(axis=0), self.points.max(axis=0)

    @property
    def spots(self) -> tuple[Floats, Floats]:
        """Places (K, m) where anything is, and how much of it (K,)."""
        return self.points, self.weights


@dataclass(frozen=True)
class GridPattern:
    """Feature pattern g0 as values on a regular grid: grey values or a range profile."""

    values: Singles  # (H, W) not negative after extraction; a profile has H = 1
    origin: Floats  # (m,) sensor coordinates of ``values[0, 0]``, u first
    step: float  # sensor units from one grid point to the next

    @property
    def size(self) -> int:
        """The number of grid points."""
        return self.values.size

    @cached_property
    def total(self) -> float:
        """Sum of the values."""
        return float(self.values.sum())

    @property
    def dimension(self) -> int:
        """m, the number of sensor coordinates."""
        return len(self.origin)

    @property
    def extent(self) -> tuple[Floats, Floats]:
        """Sensor coordinates (m,) of the first grid point and of the last."""
        size = np.array(self.values.shape[::-1])[: self.dimension]
        return self.origin, np.asarray(self.origin + (size - 1) * self.step)

    @property
    def spots(self) -> tuple[Floats, Floats]:
        """Places (K, m) where anything is, from a tenth of the most, and how much of it (K,)."""
        rows, columns = np.nonzero(self.values > 0.1 * self.values.max())
        steps = np.stack([columns, rows], axis=1)[:, : self.dimension]
        weights = self.values[rows, columns].astype(np.float64)
        return self.origin + self.step * steps, weights


Pattern: TypeAlias = PointPattern | GridPattern


@dataclass(frozen=True)
class Moment:
    """When a frame was taken, by the steady clock of this machine."""

    seconds: float  # of `time.monotonic`
    of: Literal["capture", "arrival"]  # what happened then: capture where the source tells


@dataclass(frozen=True)
class RawFrame:
    """What one sensor recorded at one moment.

    `data` is an image (H, W) of a camera, or a pattern where the source holds detections
    (`PointPattern`) or range profiles (`GridPattern`) already.  `moment` is None in a recording.
    """

    number: int
    time_s: float | None
    data: Image | Pattern
    moment: Moment | None = field(default=None, compare=False)


@dataclass(frozen=True)
class FrameSet:
    """The frames of one number, by sensor name; a sensor without a frame is left out."""

    number: int
    time_s: float | None
    frames: Mapping[str, RawFrame]

    @property
    def moment(self) -> Moment | None:
        """When it was taken, by the first sensor that knows, as `time_s`; None in a recording."""
        return next((one.moment for one in self.frames.values() if one.moment is not None), None)


@dataclass(frozen=True)
class DelaySeen:
    """How late a sensor is against the first one, in seconds, and its standard deviation."""

    seconds: float
    deviation: float


@dataclass(frozen=True)
class Label:
    """What a sensor met a feature by."""

    at: Floats  # (m,) its sensor coordinates
    # its place among the sensor's of the frame, from 0; None without single ones
    detection: int | None = None


@dataclass(frozen=True)
class MeasuredPoint:
    """Where sensors together put a feature, by what they met it by."""

    at: Floats  # (3,) in the world
    residual: float  # root mean square distance from what each saw of it, length units


@dataclass(frozen=True)
class SensorReport:
    """How one sensor took part in an estimate."""

    # Whether the pose rests on it.  Not without features, where it was left out, and where it meets
    # none of the body; of a frame without a pose, by the likeliest one.
    used: bool
    # share of the sensor's feature density that the pose accounts for, 0 to 1
    explained: float | None = None
    rms: float | None = None  # residual of the explained features, px or length units
    why: str | None = None  # why a sensor with features was not used
    # How far off each feature in view was met, px or length units, by what it is called; None where
    # it was not met.
    residuals: Mapping[str, float | None] = field(default_factory=dict)
    # What each feature was met by, where `mixpose.run` was asked for labels.
    labels: Mapping[str, Label] = field(default_factory=dict)


@dataclass(frozen=True)
class Offsets:
    """By how much a sensor met the features of a pose; n of them are in view."""

    features: Indices  # (n,) their places in the body
    met: Mask  # (n,)
    offsets: Floats  # (n, m) observed minus predicted place, sensor units; 0 where it was not met
    # (n, m, 3) derivative of the predicted place by a shift of the body in the world
    by_shift: Floats
    # (n, m) place of what met each, sensor units; the prediction where it was not met
    observed: Floats
    shared: Mask  # (n,) whether another feature was met by the same detection
    # (n,) how much each tells, as its noise goes: 1, or less where what met it is cut or shared
    weights: Floats

    @property
    def rms(self) -> float:
        """Root mean square, sensor units, of those that were met by what each tells."""
        weights = self.weights * self.met
        squares = float(weights @ np.vecdot(self.offsets, self.offsets))
        return math.sqrt(squares / max(float(weights.sum()), 1e-12))


@dataclass(frozen=True)
class Hypothesis:
    """A pose that explains a frame, with its share of belief among its rivals."""

    T_world_object: Floats
    weight: float


def label_of(name: str, instance: int | None) -> str:
    """What a body is called in one word: its name, of identical ones with a number."""
    return name if instance is None else f"{name}-{instance}"


Status: TypeAlias = Literal["ok", "ambiguous", "lost"]


@dataclass(frozen=True)
class Estimate:
    """The pose of one frame; the fields of a pose line, but for those called no part of it."""

    frame: int
    time_s: float | None
    object: str
    status: Status
    T_world_object: Floats | None  # (4, 4); None when the status is "lost"
    # (6, 6) in the order and axes of `mixpose.rigid`, lengths² and radians²
    covariance: Floats | None
    # 0 to 1: how well the predicted densities meet the observed ones, over all sensors; None where
    # a file does not say, as `latency_ms` is then.
    score: float | None
    sensors: Mapping[str, SensorReport]
    hypotheses: tuple[Hypothesis, ...] = ()
    latency_ms: float | None = field(default=0.0, compare=False)
    # of identical bodies, from 0; None where the session has one of this name
    instance: int | None = None
    # Probability that the truth is within the pose's own 99.9 % ellipsoid; 0 where the frame is
    # lost, None where a file does not say.
    confidence: float | None = None
    # Which of `mixpose.tracking.proposers` or `refinements` the pose came from; empty without one.
    # No part of the pose line.
    proposer: str = field(default="", compare=False)
    # Standard deviations of a feature, by sensor, of the objectives that the pose was fitted by, in
    # their order; empty where it was not fitted to this frame. No part of the pose line.
    blurs: tuple[Mapping[str, float], ...] = field(default=(), compare=False, repr=False)
    # Where the body was searched for: guesses made, tested on everything, and refined.
    guesses: tuple[int, int, int] | None = field(default=None, compare=False)
    # How late sensors are beyond what the session says, as far as the frames so far show it; no
    # part of the pose line.
    delays: Mapping[str, DelaySeen] = field(default_factory=dict, compare=False)
    # Why a frame is ambiguous, other than for its rivals.
    doubt: str = field(default="", compare=False)
    # Works out `offsets`.
    measured: Callable[[], Mapping[str, Offsets]] = field(default=dict, compare=False, repr=False)
    # Features that sensors together put in space without the pose, where `mixpose.run` was asked
    # for labels.
    points: Mapping[str, MeasuredPoint] = field(default_factory=dict)
    # (3,) of the body in its own coordinates; None where it has no tip
    tip_object: Floats | None = field(default=None, compare=False)
    filled: bool = False  # whether nothing was measured: the pose is what frames around it say
    ahead_s: float = 0.0  # how much later than its frame the pose is, of one that was foretold

    @cached_property
    def offsets(self) -> Mapping[str, Offsets]:
        """By how much each sensor met the features of the best pose."""
        return self.measured()

    @property
    def whole_rms(self) -> Mapping[str, float | None]:
        """As `SensorReport.rms` by sensor; what is known to be cut or shared counts less."""
        offsets = self.offsets
        return {
            name: offsets[name].rms if name in offsets and one.rms is not None else one.rms
            for name, one in self.sensors.items()
        }

    @property
    def tip(self) -> Floats | None:
        """Where the tip is in the world, (3,); None without a tip or a pose."""
        T, tip = self.T_world_object, self.tip_object
        return None if T is None or tip is None else T[:3, :3] @ tip + T[:3, 3]

    @property
    def tip_covariance(self) -> Floats | None:
        """Of the tip, (3, 3), as far as the pose errs; None without a tip or a covariance."""
        tip, C, T = self.tip, self.covariance, self.T_world_object
        if tip is None or C is None or T is None:
            return None
        J = np.eye(3, 6)
        J[:, 3:] = np.cross(np.eye(3), tip - T[:3, 3]).T  # a turn w moves it by w × arm
        return np.asarray(J @ C @ J.T)

    @property
    def label(self) -> str:
        """The body in one word."""
        return label_of(self.object, self.instance)
