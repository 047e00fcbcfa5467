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
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

Floats: TypeAlias = NDArray[np.float64]
Singles: TypeAlias = NDArray[np.float32]
Indices: TypeAlias = NDArray[np.intp]
Mask: TypeAlias = NDArray[np.bool_]
Image: TypeAlias = NDArray[np.uint8] | NDArray[np.uint16] | NDArray[np.float32]


if TYPE_CHECKING:  # which fields there are, and of which types
    from dataclasses import replace as replace  # noqa: PLC0414, exported
else:

    def replace(record: Any, /, **changes: Any) -> Any:
        """Return a record with other fields, in a third of the time of the standard library's.

        Records that check or complete their fields do so again.
        """
        kind, known = type(record), record.__dict__
        names = kind.__match_args__
        # without what was computed from others
        old = known if len(known) == len(names) else {name: known[name] for name in names}
        fields = {**old, **changes}
        if len(fields) > len(names):
            raise TypeError(f"{kind.__name__}: found {[*changes]}; allowed: {[*names]}")
        changed = object.__new__(kind)
        object.__setattr__(changed, "__dict__", fields)
        if hasattr(kind, "__post_init__"):
            changed.__post_init__()
        return changed


@dataclass(frozen=True)
class PointPattern:
    """Feature pattern g0 as a sum of weighted points.

    Raises `ValueError` if shapes do not match, a value is not finite or a weight is negative.
    """

    points: Floats  # (M, m) in sensor coordinates
    weights: Floats  # (M,) positive; 1 for a plain detection
    # (M,) standard deviation beyond that of other points, sensor units; 0 but for cut blobs
    deviations: Floats = field(default_factory=lambda: np.zeros(()))
    # (M,) radius of a disk of the visible area, sensor units; 0 where that is unknown
    radii: Floats = field(default_factory=lambda: np.zeros(()))
    # (M, 2) probability that a point is cut or merged unnoticed, and its error then, sensor units
    cut: Floats | None = None

    is_uniform: bool = field(init=False, default=True)  # whether all `deviations` are 0

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
        """Return the pattern of the chosen (M,) points."""
        return self._with(
            self.deviations[chosen],
            None if self.cut is None else self.cut[chosen],
            points=self.points[chosen],
            weights=self.weights[chosen],
            radii=self.radii[chosen],
        )

    def with_errors(self, deviations: Floats, cut: Floats | None) -> PointPattern:
        """Return the pattern with other `deviations` (M,) and `cut` (M, 2)."""
        unchanged = {"points": self.points, "weights": self.weights, "radii": self.radii}
        return self._with(deviations, cut, **unchanged)

    def _with(self, deviations: Floats, cut: Floats | None, **fields: Floats) -> PointPattern:
        """Make a pattern of fields that were checked already."""
        pattern = object.__new__(PointPattern)
        is_uniform = not np.count_nonzero(deviations)
        pattern.__dict__.update(fields, deviations=deviations, cut=cut, is_uniform=is_uniform)
        return pattern

    def effective_weights(self, deviation: float) -> Floats:
        """Return the weights (M,), less by the errors of points, for others with a `deviation`."""
        if self.is_uniform:
            return self.weights
        return np.asarray(self.weights / (1 + (self.deviations / deviation) ** 2))

    def __post_init__(self) -> None:
        points = np.asarray(self.points, dtype=np.float64)
        weights = np.asarray(self.weights, dtype=np.float64)
        object.__setattr__(self, "points", points)
        object.__setattr__(self, "weights", weights)
        for name in ("deviations", "radii"):
            if (values := getattr(self, name)).shape != weights.shape:
                object.__setattr__(self, name, np.full(weights.shape, values))
        object.__setattr__(self, "is_uniform", not np.count_nonzero(self.deviations))
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
        """Positions (K, m) with feature density, and their weights (K,)."""
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
        """Positions (K, m) of values above a tenth of the largest, and these values (K,)."""
        rows, columns = np.nonzero(self.values > 0.1 * self.values.max())
        steps = np.stack([columns, rows], axis=1)[:, : self.dimension]
        weights = self.values[rows, columns].astype(np.float64)
        return self.origin + self.step * steps, weights


Pattern: TypeAlias = PointPattern | GridPattern


@dataclass(frozen=True)
class Moment:
    """The time at which a frame was taken, by the monotonic clock of this machine."""

    seconds: float  # of `time.monotonic`
    event: Literal["capture", "arrival"]  # what is timed: capture where the source reports it


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
        """Time of the first sensor that has one, as for `time_s`; None in a recording."""
        moments = (frame.moment for frame in self.frames.values())
        return next((moment for moment in moments if moment is not None), None)


@dataclass(frozen=True)
class DelayEstimate:
    """Delay of a sensor against the first one, and its standard deviation, in seconds."""

    seconds: float
    deviation: float


@dataclass(frozen=True)
class Label:
    """The detection by which a sensor met a feature."""

    at: Floats  # (m,) sensor coordinates
    # its number among the sensor's detections of the frame, from 0; None in a density
    detection: int | None = None


@dataclass(frozen=True)
class MeasuredPoint:
    """The position of a feature by the detections of several sensors, without the pose."""

    at: Floats  # (3,) in the world
    residual: float  # root mean square distance from the sensors' detections, length units


@dataclass(frozen=True)
class SensorReport:
    """The contribution of one sensor to an estimate."""

    # Whether the pose depends on it.  False without features, if it was excluded, and if it meets
    # no feature of the body; in a frame without a pose, at the likeliest one.
    used: bool
    # share of the sensor's feature density that the pose explains, 0 to 1
    explained: float | None = None
    rms: float | None = None  # residual of the explained features, px or length units
    why: str | None = None  # why a sensor with features was not used
    # Residual of each feature in view by its label, px or length units; None where it was not met.
    residuals: Mapping[str, float | None] = field(default_factory=dict)
    # Detection of each feature that was met, if `mixpose.run` was asked for labels.
    labels: Mapping[str, Label] = field(default_factory=dict)


@dataclass(frozen=True)
class Offsets:
    """Offsets of a sensor's detections from the features of a pose, of which n are in view."""

    features: NDArray[np.intp]  # (n,) their indices in the body
    met: NDArray[np.bool_]  # (n,) whether each has a detection
    offsets: Floats  # (n, m) detected minus predicted position, sensor units; 0 where not met
    # (n, m, 3) Jacobian of the predicted position by a shift of the body in the world
    by_shift: Floats
    # (n, m) position of the detection, sensor units; of the prediction where not met
    observed: Floats
    shared: Mask  # (n,) whether another feature was met by the same detection
    # (n,) weight by noise: 1, or less where the detection is cut or shared
    weights: Floats

    @property
    def rms(self) -> float:
        """Weighted root mean square of the offsets of features met, sensor units."""
        weights = self.weights * self.met
        squares = float(weights @ np.vecdot(self.offsets, self.offsets))
        return math.sqrt(squares / max(float(weights.sum()), 1e-12))


@dataclass(frozen=True)
class Hypothesis:
    """A pose that explains a frame, with its probability among its rivals."""

    T_world_object: Floats
    weight: float


def label_of(name: str, instance: int | None) -> str:
    """Return the label of a body: its name, with a number if there are identical ones."""
    return name if instance is None else f"{name}-{instance}"


Status: TypeAlias = Literal["ok", "ambiguous", "lost"]


@dataclass(frozen=True)
class Estimate:
    """The pose of one body in one frame: the fields of a pose line, and some that are not in it."""

    frame: int
    time_s: float | None
    object: str
    status: Status
    T_world_object: Floats | None  # (4, 4); None when the status is "lost"
    # (6, 6) in the order and axes of `mixpose.rigid`, lengths² and radians²
    covariance: Floats | None
    # 0 to 1: agreement of predicted and observed densities, over all sensors; None, like
    # `latency_ms`, where it was read from a file without it.
    score: float | None
    sensors: Mapping[str, SensorReport]
    hypotheses: tuple[Hypothesis, ...] = ()
    latency_ms: float | None = field(default=0.0, compare=False)
    # number among identical bodies, from 0; None if the session has only one of this name
    instance: int | None = None
    # Probability that the truth is within the pose's 99.9 % ellipsoid; 0 if the frame is lost, None
    # if it was read from a file without it.
    confidence: float | None = None
    # Function of `mixpose.tracking.proposers` or `refinements` that made the pose; empty without
    # one.  Not in the pose line.
    proposer: str = field(default="", compare=False)
    # Blurs by sensor of the objectives that the pose was fitted with, in their order; empty if it
    # was not fitted to this frame.  Not in the pose line.
    blurs: tuple[Mapping[str, float], ...] = field(default=(), compare=False, repr=False)
    # If the body was searched: guesses made, tested on all features and sensors, and refined.
    guesses: tuple[int, int, int] | None = field(default=None, compare=False)
    # Delays of sensors beyond those of the session, estimated from the frames so far.  Not in the
    # pose line.
    delays: Mapping[str, DelayEstimate] = field(default_factory=dict, compare=False)
    # Why a frame is ambiguous, if not for its rivals.
    doubt: str = field(default="", compare=False)
    # Computes `offsets`.
    measured: Callable[[], Mapping[str, Offsets]] = field(default=dict, compare=False, repr=False)
    # Features triangulated by several sensors without the pose, if `mixpose.run` was asked for
    # labels.
    points: Mapping[str, MeasuredPoint] = field(default_factory=dict)
    # (3,) tip in body coordinates; None without a tip
    tip_object: Floats | None = field(default=None, compare=False)
    filled: bool = False  # whether nothing was measured: the pose is from other frames
    ahead_s: float = 0.0  # time from the frame to the pose, seconds, of a pose that was foretold

    @cached_property
    def offsets(self) -> Mapping[str, Offsets]:
        """Offsets of each sensor's detections from the features of the best pose."""
        return self.measured()

    @property
    def weighted_rms(self) -> Mapping[str, float | None]:
        """`SensorReport.rms` by sensor, with less weight of detections that are cut or shared."""
        offsets = self.offsets
        return {
            name: offsets[name].rms if name in offsets and report.rms is not None else report.rms
            for name, report in self.sensors.items()
        }

    @property
    def tip(self) -> Floats | None:
        """Position of the tip in the world, (3,); None without a tip or a pose."""
        T = self.T_world_object
        return (
            None if T is None or self.tip_object is None else T[:3, :3] @ self.tip_object + T[:3, 3]
        )

    @property
    def tip_covariance(self) -> Floats | None:
        """Covariance (3, 3) of the tip by the pose's; None without a tip or a covariance."""
        tip, C, T = self.tip, self.covariance, self.T_world_object
        if tip is None or C is None or T is None:
            return None
        J = np.eye(3, 6)
        J[:, 3:] = np.cross(np.eye(3), tip - T[:3, 3]).T  # a turn w moves it by w × arm
        return np.asarray(J @ C @ J.T)

    @property
    def label(self) -> str:
        """Label of the body: its name, with a number if there are identical ones."""
        return label_of(self.object, self.instance)
