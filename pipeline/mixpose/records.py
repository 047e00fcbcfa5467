"""The frozen records that pass from stage to stage.

    frames -> FrameSet -> extraction -> Pattern (g0) -> density (g) -> estimator -> Estimate

Sensor coordinates y are what the sensor measures: pixels (u right, v down, pixel centres at
integers) for cameras, lengths for ranges.  A camera has m = 2 coordinates, a range m = 1.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
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

    Attributes
    ----------
    points : (M, m) float64
        Feature positions in sensor coordinates.
    weights : (M,) float64
        Positive weight of each point; 1 for a plain detection.
    deviations : (M,) float64
        By how much more than others each may err, in sensor units; 0 but for blobs that are cut.
    radii : (M,) float64
        Of a disk of as much area as is seen of each, sensor units; 0 where that is not known.
    is_sized : bool
        Whether deviations are those of spots that have not the size of a marker.

    Raises
    ------
    ValueError
        If shapes do not match, a value is not finite or a weight is negative.
    """

    points: Floats
    weights: Floats
    deviations: Floats = field(default_factory=lambda: np.zeros(()))
    radii: Floats = field(default_factory=lambda: np.zeros(()))
    is_sized: bool = False

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
        fields = self.points, self.weights, self.deviations, self.radii
        points, weights, deviations, radii = [one[chosen] for one in fields]
        return PointPattern(points, weights, deviations, radii, self.is_sized)

    def weighed(self, deviation: float) -> PointPattern:
        """With weights as exact as detections are beside those that err by a deviation."""
        return replace(self, weights=self.weights / (1 + (self.deviations / deviation) ** 2))

    def __post_init__(self) -> None:
        points = np.asarray(self.points, dtype=np.float64)
        weights = np.asarray(self.weights, dtype=np.float64)
        object.__setattr__(self, "points", points)
        object.__setattr__(self, "weights", weights)
        object.__setattr__(self, "deviations", np.broadcast_to(self.deviations, weights.shape))
        object.__setattr__(self, "radii", np.broadcast_to(self.radii, weights.shape))
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
    """Feature pattern g0 as values on a regular grid: grey values or a range profile.

    Attributes
    ----------
    values : (H, W) float32
        Non-negative values after extraction; a range profile has H = 1.
    origin : (m,) float64
        Sensor coordinates of ``values[0, 0]``, u first.
    step : float
        Sensor units from one grid point to the next.
    """

    values: NDArray[np.float32]
    origin: Floats
    step: float

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
    """When a frame was taken, by the steady clock of this machine.

    Attributes
    ----------
    seconds : float
        Of `time.monotonic`.
    of : {"capture", "arrival"}
        What happened then: "capture" where the source tells, else "arrival".
    """

    seconds: float
    of: Literal["capture", "arrival"]


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
    """What a sensor met a feature by.

    Attributes
    ----------
    at : (m,) float64
        Its sensor coordinates.
    detection : int or None
        Its place among the sensor's detections of the frame, from 0; None where there are no single
        ones.
    """

    at: Floats
    detection: int | None = None


@dataclass(frozen=True)
class MeasuredPoint:
    """Where sensors together put a feature, by what they met it by.

    Attributes
    ----------
    at : (3,) float64
        In the world.
    residual : float
        Root mean square distance, in length units, from what each of them saw of it.
    """

    at: Floats
    residual: float


@dataclass(frozen=True)
class SensorReport:
    """How one sensor took part in an estimate.

    Attributes
    ----------
    used : bool
        Whether the sensor had a frame with features in it.
    explained : float or None
        Share of the sensor's feature density that the pose accounts for, 0 to 1.
    rms : float or None
        Residual of the explained features, px or length units.
    why : str or None
        Why a sensor with features was not used.
    residuals : mapping of str to float or None
        How far off each feature in view was met, px or length units, by what it is called; None
        where it was not met.
    labels : mapping of str to Label
        What each feature was met by, where `mixpose.run` was asked for labels.
    """

    used: bool
    explained: float | None = None
    rms: float | None = None
    why: str | None = None
    residuals: Mapping[str, float | None] = field(default_factory=dict)
    labels: Mapping[str, Label] = field(default_factory=dict)


@dataclass(frozen=True)
class Offsets:
    """By how much a sensor met the features of a pose; n of them are in view.

    Attributes
    ----------
    features : (n,) int
        Their places in the body.
    met : (n,) bool
    offsets : (n, m) float64
        Observed minus predicted place, sensor units; 0 where it was not met.
    by_shift : (n, m, 3) float64
        Derivative of the predicted place by a shift of the body in the world.
    observed : (n, m) float64
        Place of what met each, sensor units; that of the prediction where it was not met.
    shared : (n,) bool
        Whether another feature was met by the same detection.
    """

    features: NDArray[np.intp]
    met: NDArray[np.bool_]
    offsets: Floats
    by_shift: Floats
    observed: Floats
    shared: Mask


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
    """The pose of one frame; the fields of a pose line.

    Attributes
    ----------
    T_world_object : (4, 4) float64 or None
        None when the status is "lost".
    covariance : (6, 6) float64 or None
        In the order and axes of `mixpose.rigid`, squared lengths and radians.
    confidence : float or None
        Probability that the truth is within the pose's own 99.9 % ellipsoid; 0 where the frame is
        lost, None where a file does not say.
    score : float or None
        0 to 1: how well the predicted densities meet the observed ones, over all sensors; None
        where a file does not say, as `latency_ms` is then.
    instance : int or None
        Which of identical bodies, from 0; None where the session has one of this name.
    proposer : str
        Which of `mixpose.tracking.proposers` the pose came from; empty without a pose.  It is no
        part of the pose line.
    blurs : tuple of mapping of str to float
        Standard deviations of a feature, by sensor, of the objectives that the pose was fitted by,
        in their order; empty where it was not fitted to this frame.  No part of the pose line.
    guesses : tuple of int or None
        Where the body was searched for: guesses made, tested on everything, and refined.
    delays : mapping of str to DelaySeen
        How late sensors are beyond what the session says, as far as the frames so far show it; no
        part of the pose line.
    doubt : str
        Why a frame is ambiguous, other than for its rivals; no part of it either.
    measured : callable
        Works out `offsets`.
    points : mapping of str to MeasuredPoint
        Features that sensors together put in space without the pose, where `mixpose.run` was asked
        for labels.
    tip_object : (3,) float64 or None
        The tip of the body in its own coordinates; None where it has none.
    filled : bool
        Whether nothing was measured in this frame: its pose is what frames around it say.
    """

    frame: int
    time_s: float | None
    object: str
    status: Status
    T_world_object: Floats | None
    covariance: Floats | None
    score: float | None
    sensors: Mapping[str, SensorReport]
    hypotheses: tuple[Hypothesis, ...] = ()
    latency_ms: float | None = field(default=0.0, compare=False)
    instance: int | None = None
    confidence: float | None = None
    proposer: str = field(default="", compare=False)
    blurs: tuple[Mapping[str, float], ...] = field(default=(), compare=False, repr=False)
    guesses: tuple[int, int, int] | None = field(default=None, compare=False)
    delays: Mapping[str, DelaySeen] = field(default_factory=dict, compare=False)
    doubt: str = field(default="", compare=False)
    measured: Callable[[], Mapping[str, Offsets]] = field(default=dict, compare=False, repr=False)
    points: Mapping[str, MeasuredPoint] = field(default_factory=dict)
    tip_object: Floats | None = field(default=None, compare=False)
    filled: bool = False

    @property
    def offsets(self) -> Mapping[str, Offsets]:
        """By how much each sensor met the features of the best pose."""
        return self.measured()

    @property
    def tip(self) -> Floats | None:
        """Where the tip is in the world, (3,); None without a tip or a pose."""
        T = self.T_world_object
        return (
            None if T is None or self.tip_object is None else T[:3, :3] @ self.tip_object + T[:3, 3]
        )

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
