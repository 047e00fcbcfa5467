"""A warm estimate: the features of a frame are found, the pose is a few pixels from its prediction.

Two pinhole cameras of 1280x1024 px see the paper's body of six markers from one metre.  The literal
method is given the same detections and starts, and the paper's own settings: features of standard
deviation 5 in the image and in the body, R = 1000 samples, the same mirrored pairs for all
features, which serve it best.

The fit alone is timed with the drawing of its densities, on observations seen before; what
a tracker does with a frame, from its prediction to the judgement of the pose, on ones that are new
in every call.
"""

from __future__ import annotations

import argparse
import cProfile
import pstats
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray
from paper.measurements import sum_of_gaussians
from paper.systems import POINTS, draw, pose
from scipy.spatial.transform import Rotation

from benchmarks.literal import Camera, LiteralObjective, samples_of
from benchmarks.search_cases import looking_at
from benchmarks.timing import PROCESSOR, Task, medians, show
from mixpose.body import Body, PointFeature
from mixpose.density import Observation
from mixpose.fit import EstimatorOptions, fit_near
from mixpose.objective import View
from mixpose.records import Estimate, PointPattern
from mixpose.rigid import rotation_angle_deg, transform
from mixpose.sensors import PinholeCamera
from mixpose.tracking import Track, Tracker

Floats: TypeAlias = NDArray[np.float64]

TRIALS = 12
FOCAL = 900.0
RESOLUTION = (1280, 1024)
CENTRE = np.array([90.0, 40.0, 20.0])  # about where the paper's poses put the body
NOISE_PX = 0.2
SIGMA_PX = 1.5
START_DEG, START_MM = 0.4, 1.5  # standard deviations along and about each axis: about 2.5 px
UNCERTAINTY = np.array([3.0] * 3 + [np.radians(1.0)] * 3)
"""What a tracker assumes of a steady motion."""

ROUNDS, CALLS = 15, 5
WARM_FRAMES = 8  # of steady motion before the frame that is timed
STEP = np.array([0.01, -0.008, 0.012, 0.8, -0.6, 0.5])  # of the six numbers, a frame
PERIOD_S = 0.02

PAPER_SIGMA_PX, PAPER_SPREAD, PAPER_SAMPLES = 5.0, 5.0, 1000

BODY = Body("paper", tuple(PointFeature(point) for point in POINTS))


@dataclass(frozen=True)
class Trial:
    """A frame, its true pose and its start, both (6,) as in the paper."""

    sensors: tuple[PinholeCamera, ...]
    detections: tuple[Floats, ...]
    truth: Floats
    start: Floats

    @property
    def views(self) -> list[View]:
        return views_of(self.sensors, self.detections)

    @property
    def labelled(self) -> Floats:
        """Detections of the first camera in the order of the markers, for `cv2.solvePnP`."""
        y = self.sensors[0].project(transform(pose(self.truth), POINTS))[0]
        nearest = np.linalg.norm(self.detections[0] - y[:, None], axis=2).argmin(axis=1)
        return np.asarray(self.detections[0][nearest])


def run(_: argparse.Namespace) -> dict[str, Any]:
    trials = [trial(seed) for seed in range(TRIALS)]
    exact = [literal_objective(each, 0.0, 1) for each in trials]
    sampled = [literal_objective(each, PAPER_SPREAD, PAPER_SAMPLES) for each in trials]
    literal = [f.estimate(t.start) for f, t in zip(sampled, trials, strict=True)]
    frames = {
        "two cameras": [warm(t) for t in trials],
        "one camera": [warm(t, cameras=1) for t in trials],
        "solvePnP": [solve_pnp(t) for t in trials],
    }
    advances = {
        "two cameras": [advance(t) for t in trials],
        "one camera": [advance(t, cameras=1) for t in trials],
    }
    ms = by_frame(frames, rounds=ROUNDS, calls=CALLS)
    advance_ms = by_frame(advances, rounds=ROUNDS, calls=CALLS)
    slow = {
        "ours": frames["two cameras"],
        "literal": searches(sampled, trials),
        "literal exact": searches(exact, trials),
    }
    compared = by_frame(slow, rounds=1, calls=1)
    typical = {name: float(np.median(each)) for name, each in (ms | compared).items()}
    ours = [warm(t)() for t in trials]
    figures = {
        "ms_median": typical["two cameras"],
        "ms_mean": float(np.mean(ms["two cameras"])),
        "ms_slowest": max(ms["two cameras"]),
        "advance_ms": spread_of(advance_ms["two cameras"]),
        "advance_one_camera_ms": spread_of(advance_ms["one camera"]),
        "advance_one_camera_calls": float(np.median([calls_of(advance(t, 1)) for t in trials])),
        "literal_ratio": typical["literal"] / typical["ours"],
        "literal_exact_ratio": typical["literal exact"] / typical["ours"],
        "ratio_to_solvepnp": typical["one camera"] / typical["solvePnP"],
        "one_camera_ms": typical["one camera"],
        "solvepnp_ms": typical["solvePnP"],
        "literal_ms": typical["literal"],
        **errors(ours, trials, ""),
        **errors([pose(beta) for beta in literal], trials, "literal_"),
        **errors([pose(t.start) for t in trials], trials, "start_"),
    }
    report(figures)
    return figures


def spread_of(ms: Sequence[float]) -> dict[str, float]:
    """Median, mean and slowest frame."""
    return {"median": float(np.median(ms)), "mean": float(np.mean(ms)), "slowest": max(ms)}


def calls_of(task: Task) -> int:
    """How many functions, Python's, NumPy's and OpenCV's, a task calls when it is warm."""
    task()
    with cProfile.Profile() as profile:
        task()
    return int(pstats.Stats(profile).total_calls)  # type: ignore[attr-defined]


def report(figures: dict[str, Any]) -> None:
    print("pose: six markers, detections given, start about 2.5 px off")
    for text, key in (("two cameras", "advance_ms"), ("one camera", "advance_one_camera_ms")):
        for kind, value in figures[key].items():
            show(f"a tracked frame, {text}, new observations, {kind}, ms", value)
    show("a tracked frame, one camera: calls of functions", figures["advance_one_camera_calls"])
    show("two cameras, median frame, ms", figures["ms_median"], at_most=0.7)
    show("the same, mean, ms", figures["ms_mean"])
    show("the same, slowest frame, ms", figures["ms_slowest"])
    show("one camera, ms", figures["one_camera_ms"])
    show("cv2.solvePnP, markers matched, ms", figures["solvepnp_ms"])
    show("one camera / cv2.solvePnP", figures["ratio_to_solvepnp"], at_most=8)
    show("literal, ms", figures["literal_ms"])
    show("literal / two cameras", figures["literal_ratio"], at_least=300)
    show("literal with exact features (R = 1) / two cameras", figures["literal_exact_ratio"])
    for unit, key in (("°", "error_deg"), ("mm", "error_mm")):
        show(f"median error at the start, {unit}", figures[f"start_{key}"])
        show(f"median error of the literal method, {unit}", figures[f"literal_{key}"])
        show(f"median error, {unit}", figures[key], at_most=figures[f"literal_{key}"])


def estimate(views: Sequence[View], T_start: Floats) -> Floats:
    """What is measured: the pipeline's estimate of six numbers near a prediction.

    What stays the same from frame to frame, the sensors side by side, a tracker has at hand.
    """
    samples = BODY.means[:, None]  # the matched objective integrates without samples
    options = EstimatorOptions()
    return fit_near(views, BODY, T_start, UNCERTAINTY, options, samples).T_world_object


def warm(one: Trial, cameras: int = 2) -> Callable[[], Floats]:
    """The estimate of a frame seen by the first cameras."""
    views = one.views[:cameras]
    return partial(estimate, views, pose(one.start))


def warmed(one: Trial, cameras: int) -> tuple[Tracker, Track]:
    """A tracker after frames of steady motion that lead to the start of a trial."""
    rng = np.random.default_rng(0)
    sensors = one.sensors[:cameras]
    path = [one.start - (WARM_FRAMES - k) * STEP for k in range(WARM_FRAMES)]
    tracker = Tracker.create(BODY, EstimatorOptions(), pose(path[0]))
    track = tracker.begin()
    for frame, beta in enumerate(path):
        seen = views_of(sensors, [detected(sensor, beta, rng) for sensor in sensors])
        track, _ = tracker.advance(track, frame, frame * PERIOD_S, seen)
    return tracker, track


def advance(one: Trial, cameras: int = 2) -> Callable[[], Estimate]:
    """A frame of a warm track, as a run has it: its observations are new in every call.

    They are made here, for all calls of the rounds that are timed and of the one before.
    """
    tracker, track = warmed(one, cameras)
    fresh = iter([one.views[:cameras] for _ in range((ROUNDS + 1) * CALLS)])

    def estimated() -> Estimate:
        return tracker.advance(track, WARM_FRAMES, WARM_FRAMES * PERIOD_S, next(fresh))[1]

    return estimated


def views_of(sensors: Sequence[PinholeCamera], detections: Sequence[Floats]) -> list[View]:
    """What cameras detected, as new observations."""
    return [
        View(f"camera {k}", sensor, Observation(PointPattern(y, np.ones(len(y))), SIGMA_PX))
        for k, (sensor, y) in enumerate(zip(sensors, detections, strict=True))
    ]


def detected(sensor: PinholeCamera, beta: Floats, rng: np.random.Generator) -> Floats:
    """What a camera detects of the body, in random order."""
    y, seen = sensor.project(transform(pose(beta), POINTS))
    assert seen.all(), "the body is in full view"
    return np.asarray(rng.permutation(y + NOISE_PX * rng.standard_normal(y.shape)))


def trial(seed: int) -> Trial:
    """A pose and its start as in the paper, detections in random order."""
    rng = np.random.default_rng(seed)
    truth, _ = draw(rng)
    turn, shift = np.radians(START_DEG), START_MM
    start = truth + np.repeat([turn, shift], 3) * rng.standard_normal(6)
    K = np.array([[FOCAL, 0, 639.5], [0, FOCAL, 511.5], [0, 0, 1]])
    eyes = CENTRE + np.array([[0.0, -1000.0, 0.0], [1000.0, 0.0, 0.0]])
    sensors = tuple(
        PinholeCamera(K, np.zeros(0), RESOLUTION, looking_at(eye, CENTRE)) for eye in eyes
    )
    detections = [detected(sensor, truth, rng) for sensor in sensors]
    return Trial(sensors, tuple(detections), truth, start)


def literal_objective(frame: Trial, spread: float, samples: int) -> LiteralObjective:
    """The literal objective of a frame; the densities are made before anything is timed."""
    axes = [np.arange(size, dtype=np.float64) for size in RESOLUTION]
    cameras = []
    for sensor, y in zip(frame.sensors, frame.detections, strict=True):
        g = sum_of_gaussians(y, axes, PAPER_SIGMA_PX) / len(y)
        cameras.append(Camera(g, sensor.camera_matrix @ sensor.T_sensor_world[:3]))
    drawn = POINTS if samples == 1 else samples_of(POINTS, spread, samples, seed=0)
    return LiteralObjective(cameras, drawn)


def searches(objectives: Sequence[LiteralObjective], trials: Sequence[Trial]) -> list[Task]:
    return [partial(f.estimate, t.start) for f, t in zip(objectives, trials, strict=True)]


def solve_pnp(frame: Trial) -> Task:
    """OpenCV's iterative solution from the same start, knowing which detection is which marker."""
    sensor = frame.sensors[0]
    T = sensor.T_sensor_world @ pose(frame.start)
    turn, shift = Rotation.from_matrix(T[:3, :3]).as_rotvec(), T[:3, 3]
    y = frame.labelled

    def solve() -> object:
        return cv2.solvePnP(
            POINTS,
            y,
            sensor.camera_matrix,
            None,
            turn.copy(),
            shift.copy(),
            useExtrinsicGuess=True,
            flags=cv2.SOLVEPNP_ITERATIVE,
        )

    return solve


def by_frame(
    tasks: Mapping[str, Sequence[Task]], *, rounds: int, calls: int
) -> dict[str, list[float]]:
    """Median milliseconds of each frame's task; the frames of all tasks take turns."""
    named = {f"{name} {k}": task for name, each in tasks.items() for k, task in enumerate(each)}
    seconds = medians(named, rounds=rounds, calls=calls, clock=PROCESSOR)
    return {
        name: [1e3 * seconds[f"{name} {k}"] for k in range(len(each))]
        for name, each in tasks.items()
    }


def errors(found: Sequence[Floats], trials: Sequence[Trial], prefix: str) -> dict[str, float]:
    """Medians of the angle and of the distance of the features' middle."""
    pairs = [(T, pose(each.truth)) for T, each in zip(found, trials, strict=True)]
    angles = [float(rotation_angle_deg(T, truth)) for T, truth in pairs]
    centre = np.append(POINTS.mean(axis=0), 1.0)
    distances = [float(np.linalg.norm((T - truth) @ centre)) for T, truth in pairs]
    return {
        f"{prefix}error_deg": float(np.median(angles)),
        f"{prefix}error_mm": float(np.median(distances)),
    }
