"""How time grows with features and sensors of a warm estimate, and samples of the paper's value.

Beside it, what a frame costs in which the body is not: all guesses have to be refuted.
"""

from __future__ import annotations

import argparse
from functools import partial
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray
from paper.systems import SCENARIOS, pose, systems

from benchmarks.objective_case import scene, value_terms
from benchmarks.search_cases import looking_at
from benchmarks.timing import PROCESSOR, Task, medians, show, slope
from mixpose.body import Body, PointFeature
from mixpose.density import Observation
from mixpose.fit import EstimatorOptions, fit_near
from mixpose.objective import View
from mixpose.objective.paper import PaperObjective
from mixpose.records import PointPattern
from mixpose.rigid import perturb, transform
from mixpose.sensors import PinholeCamera
from mixpose.tracking import estimate_pose

Floats: TypeAlias = NDArray[np.float64]

FEATURES = (6, 20, 60, 200, 600)
SENSORS = (1, 2, 4, 8)
SAMPLES = (100, 300, 1000, 3000, 10000)
ABSENT = ((6, 8), (6, 20), (20, 40), (100, 40))
"""Features of a body that is not there, and false detections in each view."""
CUBE = 300.0
DISTANCE = 1000.0
NOISE_PX = 0.2
SIGMA_PX = 1.5
OFF = np.array([2.0, -1.5, 1.0, 0.006, -0.008, 0.004])  # mm and radians: about 3 px
UNCERTAINTY = np.array([3.0] * 3 + [np.radians(1.0)] * 3)


def run(_: argparse.Namespace) -> dict[str, Any]:
    print("scaling: slopes of time, both axes in logarithms; 1 is proportional")
    features = {float(n): estimate_task(n, 2) for n in FEATURES}
    sensors = {float(n): estimate_task(6, n) for n in SENSORS}
    samples = {float(n): value_task(n) for n in SAMPLES}
    return {
        **measured("features", features, rounds=5, calls=1),
        **measured("sensors", sensors, rounds=9, calls=3),
        **measured("samples", samples, rounds=15, calls=5),
        **absent(),
    }


def measured(name: str, tasks: dict[float, Task], *, rounds: int, calls: int) -> dict[str, Any]:
    """Slope over all sizes, and the steepest between two that follow each other."""
    by_name = {f"{size:g}": task for size, task in tasks.items()}
    seconds = list(medians(by_name, rounds=rounds, calls=calls, clock=PROCESSOR).values())
    sizes = list(tasks)
    for size, s in zip(sizes, seconds, strict=True):
        show(f"{size:g} {name}, ms", 1e3 * s)
    steepest = max(slope(sizes[k : k + 2], seconds[k : k + 2]) for k in range(len(sizes) - 1))
    figure = slope(sizes, seconds)
    show(f"slope over {name}", figure, at_most=1.1)
    show("the steepest between neighbours", steepest)
    ms = {f"{size:g}": 1e3 * s for size, s in zip(sizes, seconds, strict=True)}
    return {f"{name}_slope": figure, f"{name}_steepest": steepest, f"{name}_ms": ms}


def absent() -> dict[str, Any]:
    """Seconds of a frame without the body, for one camera and for two."""
    found = {}
    for sensors in (1, 2):
        tasks = {f"{n} features, {false}": absent_task(n, sensors, false) for n, false in ABSENT}
        seconds = medians(tasks, rounds=3, warm_up=0, clock=PROCESSOR)
        for name, s in seconds.items():
            show(f"no body ({name} false), cameras: {sensors}, s", s)
        found[f"absent_{sensors}_s"] = seconds
    return found


def absent_task(features: int, sensors: int, false: int) -> Task:
    """An estimate without a start from false detections alone."""
    rng = np.random.default_rng([features, sensors, false])
    body, cameras = random_body(features, rng), cameras_around(sensors)
    views = []
    for k, sensor in enumerate(cameras):
        found = rng.uniform((300, 200), (900, 800), (false, 2))
        views.append(view_of(f"camera {k}", sensor, found))
    return partial(estimate_pose, views, body)


def random_body(features: int, rng: np.random.Generator) -> Body:
    points = rng.uniform(-CUBE / 2, CUBE / 2, (features, 3))
    return Body("random", tuple(PointFeature(point) for point in points))


def cameras_around(count: int) -> list[PinholeCamera]:
    """Cameras on a circle, never two opposite each other."""
    K = np.array([[900.0, 0, 639.5], [0, 900.0, 511.5], [0, 0, 1]])
    angles = 2.4 * np.arange(count)
    eyes = DISTANCE * np.array([np.sin(angles), -np.cos(angles), np.full(count, 0.2)]).T
    poses = [looking_at(eye, np.zeros(3)) for eye in eyes]
    return [PinholeCamera(K, np.zeros(0), (1280, 1024), T) for T in poses]


def view_of(name: str, sensor: PinholeCamera, found: Floats) -> View:
    pattern = PointPattern(found, np.ones(len(found)))
    return View(name, sensor, Observation(pattern, SIGMA_PX))


def estimate_task(features: int, sensors: int) -> Task:
    """A warm estimate of a body of random points, seen by cameras on a circle around it."""
    rng = np.random.default_rng([features, sensors])
    body = random_body(features, rng)
    T = perturb(np.eye(4), np.array([5.0, -8.0, 3.0, 0.2, -0.3, 0.4]))
    views = []
    for k, sensor in enumerate(cameras_around(sensors)):
        y, seen = sensor.project(transform(T, body.means))
        assert seen.all(), "the body is in full view"
        found = rng.permutation(y + NOISE_PX * rng.standard_normal(y.shape))
        views.append(view_of(f"camera {k}", sensor, found))
    start, options = perturb(T, OFF), EstimatorOptions()
    return partial(fit_near, views, body, start, UNCERTAINTY, options, body.means[:, None])


def value_task(samples: int) -> Task:
    """One value of the paper's objective, as in the case `objective`, with R samples."""
    beta, seen, _, _ = scene()
    drawn = systems()[1].body(SCENARIOS[0]).sample(samples, seed=0)
    T = pose(beta)
    return partial(PaperObjective(value_terms(seen, drawn, T), drawn).value, T)
