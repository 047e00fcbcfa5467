"""Random bodies and poses as sensors would report them, for measuring the search."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from mixpose.body import Body, PointFeature
from mixpose.density import Observation
from mixpose.objective import View
from mixpose.records import GridPattern, Pattern, PointPattern
from mixpose.rigid import from_parts, perturb, transform, twist_between
from mixpose.sensors import ParallelBeam, PinholeCamera, RangeSensor, Sensor

Floats: TypeAlias = NDArray[np.float64]

NOISE_PX = 0.3
SIGMA_PX = 1.5  # what a session assumes that does not say
CUBE = 200.0
DISTANCE = 1000.0
RESOLUTION = (1280, 1024)
RANGE_SOURCES = np.array([[0, -1000.0, 0], [1000.0, 0, 0], [0, 0, 1000.0]])
RANGE_CUBE = 120.0
RANGE_SIGMA = 5.0
BY_CHANCE = 1e-4  # share of fits with known identities that are farther off than counts as right


@dataclass(frozen=True)
class Row:
    """One line of the table: sensors, and what happens to the features in each view.

    Attributes
    ----------
    sensors : str
        Key of `SENSORS`.
    features, hidden, false : int
        Markers of the body; markers that a view misses; false detections per view, every other
        one anywhere in the image and the rest within the body's bounding box in it.
    wanted : float
        Share of frames aimed at whose pose, the first hypothesis, is right.
    """

    sensors: str
    features: int
    hidden: int
    false: int
    wanted: float

    @property
    def name(self) -> str:
        return f"{self.sensors} {self.features}/{self.hidden}/{self.false}"


@dataclass(frozen=True)
class Trial:
    """What the search is given, and the pose that it should find."""

    views: list[View]
    body: Body
    T_world_object: Floats
    distance: float
    largest_angle_deg: float = 1.0
    largest_shift: float = 0.005
    labels: list[NDArray[np.intp]] = field(default_factory=list)
    covariance: Floats | None = None  # of a fit that is told which detection is whose


ROWS = (
    Row("2 pinhole", 6, 0, 0, 0.99),
    Row("2 pinhole", 6, 1, 3, 0.99),
    Row("2 pinhole", 8, 2, 4, 0.99),
    Row("2 pinhole", 6, 2, 4, 0.95),
    Row("2 pinhole", 8, 4, 8, 0.95),
    Row("1 pinhole", 5, 0, 5, 0.99),
    Row("1 pinhole", 5, 0, 10, 0.99),
    Row("1 pinhole", 8, 2, 5, 0.99),
    Row("1 pinhole", 8, 3, 5, 0.99),
    Row("1 pinhole", 5, 1, 5, 0.80),
    Row("2 parallel", 6, 0, 0, 0.99),
    Row("2 parallel", 6, 1, 2, 0.99),
    Row("3 ranges", 6, 0, 0, 0.95),
)


def looking_at(eye: Floats, target: Floats) -> Floats:
    """T_sensor_world of a camera at `eye` that looks at `target`, its x axis level."""
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    R = np.array([right, np.cross(forward, right), forward])
    return from_parts(R, -R @ eye)


def pinhole(rng: np.random.Generator, eye: Floats, focal: tuple[float, float]) -> PinholeCamera:
    f = rng.uniform(*focal)
    K = np.array([[f, 0, 639.5], [0, f, 511.5], [0, 0, 1]])
    return PinholeCamera(K, np.zeros(0), RESOLUTION, looking_at(eye, np.zeros(3)))


def two_pinholes(rng: np.random.Generator) -> list[Sensor]:
    eyes = np.array([[0.0, -DISTANCE, 0.0], [DISTANCE, 0.0, 0.0]])
    return [pinhole(rng, eye, (800.0, 1000.0)) for eye in eyes]


def three_pinholes(rng: np.random.Generator) -> list[Sensor]:
    """Those two and one above between them."""
    eye = DISTANCE * np.array([0.55, -0.55, 0.63])
    return [*two_pinholes(rng), pinhole(rng, eye, (800.0, 1000.0))]


def one_pinhole(rng: np.random.Generator) -> list[Sensor]:
    return [pinhole(rng, np.array([0.0, -DISTANCE, 0.0]), (800.0, 800.0))]


def two_parallel(_: np.random.Generator) -> list[Sensor]:
    """The paper's cameras: (cos γ x + sin γ y, z) with γ = 0 and π/2, one unit per px."""
    cameras: list[Sensor] = []
    for gamma in (0.0, np.pi / 2):
        c, s = np.cos(gamma), np.sin(gamma)
        R = np.array([[c, s, 0], [0, 0, 1], [s, -c, 0]])
        cameras.append(
            ParallelBeam(1.0, np.array([300.0, 300.0]), (601, 601), from_parts(R, np.zeros(3)))
        )
    return cameras


def three_ranges(_: np.random.Generator) -> list[Sensor]:
    return [RangeSensor(source) for source in RANGE_SOURCES]


SENSORS: dict[str, Callable[[np.random.Generator], list[Sensor]]] = {
    "2 pinhole": two_pinholes,
    "3 pinhole": three_pinholes,
    "1 pinhole": one_pinhole,
    "2 parallel": two_parallel,
    "3 ranges": three_ranges,
}


def trial(row: Row, seed: int, *, sigma: float = SIGMA_PX) -> Trial:
    """A random body in a random pose, as the sensors of a row see it.

    Parameters
    ----------
    row : Row
    seed : int
    sigma : float
        σ_ε that the observations claim, px; the detections themselves err by `NOISE_PX`.
    """
    rng = np.random.default_rng([seed, row.features, row.hidden, row.false])
    sensors = SENSORS[row.sensors](rng)
    ranges = row.sensors == "3 ranges"
    cube = RANGE_CUBE if ranges else CUBE
    points = rng.uniform(-cube / 2, cube / 2, (row.features, 3))
    body = Body("random", tuple(PointFeature(point) for point in points))
    R = Rotation.random(rng=rng).as_matrix()
    T = from_parts(R, rng.uniform(-50, 50, 3) - (0 if ranges else R @ points.mean(axis=0)))
    labels: list[NDArray[np.intp]] = []
    if ranges:
        views = [_profile(f"range{k}", s, T, points) for k, s in enumerate(sensors)]
    else:
        views = [
            _detections(f"camera{k}", s, T, points, row, rng, sigma, labels)
            for k, s in enumerate(sensors)
        ]
    # the depth that one camera finds errs by 0.5 % itself
    limits = (3.0, 0.02) if row.sensors == "1 pinhole" else (1.0, 0.005)
    return Trial(views, body, T, DISTANCE, *limits, labels)


def range_profile(ranges: Floats) -> GridPattern:
    """A noiseless range profile, one unit per bin, features of standard deviation 5."""
    first = np.floor(ranges.min() - 60.0)
    bins = first + np.arange(int(ranges.max() - first + 60.0))
    bells = np.exp(-0.5 * ((bins - ranges[:, None]) / RANGE_SIGMA) ** 2)
    return GridPattern(bells.sum(axis=0, keepdims=True).astype(np.float32), bins[:1], 1.0)


def _profile(name: str, sensor: Sensor, T: Floats, points: Floats) -> View:
    pattern = range_profile(sensor.project(transform(T, points))[0][:, 0])
    return View(name, sensor, Observation(pattern, RANGE_SIGMA, intrinsic=RANGE_SIGMA))


def _detections(
    name: str,
    sensor: Sensor,
    T: Floats,
    points: Floats,
    row: Row,
    rng: np.random.Generator,
    sigma: float,
    labels: list[NDArray[np.intp]],
) -> View:
    """Noisy features without the hidden ones, among false detections, in random order."""
    y, seen = sensor.project(transform(T, points))
    assert seen.all(), "the body is in full view"
    kept = rng.permutation(len(points))[row.hidden :]
    found = y[kept] + NOISE_PX * rng.standard_normal((len(kept), 2))
    false = false_detections(sensor, (y.min(axis=0), y.max(axis=0)), row.false, rng)
    label = np.concatenate([kept, np.full(row.false, -1)])
    order = rng.permutation(len(label))
    labels.append(label[order])
    detections = np.concatenate([found, false])[order]
    weights = rng.uniform(0.5, 2.0, len(detections))
    return View(name, sensor, Observation(PointPattern(detections, weights), sigma))


def false_detections(
    sensor: Sensor, box: tuple[Floats, Floats], count: int, rng: np.random.Generator
) -> Floats:
    """Every other one uniform in the whole image, the rest uniform in a box."""
    anywhere = rng.uniform(sensor.lower, sensor.upper, (count, 2))
    near = rng.uniform(box[0], box[1], (count, 2))
    return np.where(np.arange(count)[:, None] % 2 == 0, anywhere, near)


def absent(row: Row, seed: int, *, sigma: float = SIGMA_PX) -> Trial:
    """The frames of a row with the body gone, and as many false features as were seen of it.

    Half of them lie where it would have been.  The pose of the trial is nowhere to be found.
    """
    present = trial(row, seed, sigma=sigma)
    rng = np.random.default_rng([seed, row.features, row.false, 1])
    count = row.features - row.hidden + row.false
    views = []
    for view in present.views:
        if isinstance(view.sensor, RangeSensor):
            ranges = rng.uniform(DISTANCE - RANGE_CUBE, DISTANCE + RANGE_CUBE, row.features)
            pattern: Pattern = range_profile(ranges)
        else:
            y, _ = view.sensor.project(transform(present.T_world_object, present.body.means))
            box = (y.min(axis=0), y.max(axis=0))
            points = false_detections(view.sensor, box, count, rng)
            pattern = PointPattern(points, rng.uniform(0.5, 2.0, count))
        old = view.observation
        views.append(replace(view, observation=replace(old, pattern=pattern)))
    return replace(present, views=views)


def sequence(row: Row, seed: int, frames: int) -> list[Trial]:
    """A body that moves on evenly; what is hidden and what is false differs from frame to frame."""
    first = trial(row, seed)
    rng = np.random.default_rng([seed, row.features, row.false, 2])
    step = np.concatenate([rng.uniform(-5.0, 5.0, 3), np.radians(rng.uniform(-1.0, 1.0, 3))])
    T, points, made = first.T_world_object, first.body.means, []
    for _ in range(frames):
        views = [
            _detections(v.name, v.sensor, T, points, row, rng, SIGMA_PX, []) for v in first.views
        ]
        made.append(replace(first, views=views, T_world_object=T, labels=[]))
        T = perturb(T, step)
    return made


def crowded_absent(features: int, false: int, seed: int) -> Trial:
    """Two cameras that see false detections alone, half of them where the body would be."""
    row = Row("2 pinhole", features, 0, 0, 1.0)
    present = trial(row, seed)
    rng = np.random.default_rng([seed, features, false, 3])
    views = []
    for view in present.views:
        y, _ = view.sensor.project(transform(present.T_world_object, present.body.means))
        points = false_detections(view.sensor, (y.min(axis=0), y.max(axis=0)), false, rng)
        seen = Observation(PointPattern(points, np.ones(false)), SIGMA_PX)
        views.append(replace(view, observation=seen))
    return replace(present, views=views)


def errors(found: Floats, truth: Trial) -> tuple[float, float]:
    """Angle in degrees and distance of the middle of the features, modulo symmetry."""
    best = (np.inf, np.inf)
    centre = truth.body.means.mean(axis=0)
    for symmetry in truth.body.symmetries:
        T = truth.T_world_object @ symmetry
        turn = found[:3, :3] @ T[:3, :3].T
        angle = float(np.degrees(np.linalg.norm(Rotation.from_matrix(turn).as_rotvec())))
        shift = transform(found, centre[None])[0] - transform(T, centre[None])[0]
        best = min(best, (angle, float(np.linalg.norm(shift))))
    return best


def errors_squared(found: Floats, covariance: Floats, truth: Trial) -> float:
    """Squared error of a pose in standard deviations of its covariance, modulo symmetry."""
    twists = twist_between(found, truth.T_world_object @ truth.body.symmetries)
    return float(np.min((twists @ np.linalg.inv(covariance) * twists).sum(axis=1)))


def is_right(found: Floats, truth: Trial) -> bool:
    """Whether a pose is the true one, within its angle and share of the distance.

    Or as near as a fit comes that is told which detection is whose: how a body as thin as a rod is
    turned about its axis is open by more than a degree.
    """
    angle, shift = errors(found, truth)
    if angle < truth.largest_angle_deg and shift < truth.largest_shift * truth.distance:
        return True
    if truth.covariance is None:
        return False
    return errors_squared(found, truth.covariance, truth) < float(chi2.ppf(1 - BY_CHANCE, 6))


def rows_named(names: Sequence[str]) -> list[Row]:
    """Rows whose names contain one of the given texts; all for none."""
    return [row for row in ROWS if not names or any(name in row.name for name in names)]
