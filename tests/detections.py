"""What sensors would detect of a body: shuffled, without labels, some hidden, some false."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from mixpose.body import Body, PointFeature
from mixpose.density import Observation
from mixpose.objective import View
from mixpose.records import PointPattern
from mixpose.rigid import from_rotation_vector, perturb, transform
from mixpose.sensors import Sensor

Floats = NDArray[np.float64]
TRUTH = from_rotation_vector([0.3, 0.2, -0.5], [45.0, 30.0, 5.0])
ALL_FREE = np.ones(6, dtype=np.bool_)
EIGHT = Body(
    "eight",
    tuple(PointFeature(point) for point in np.random.default_rng(0).uniform(-80, 80, (8, 3))),
)


def view_of(name: str, sensor: Sensor, points: Floats, sigma: float = 1.5) -> View:
    """Detections (M, m) of equal weight."""
    return View(name, sensor, Observation(PointPattern(points, np.ones(len(points))), sigma))


def detect(
    sensors: Sequence[Sensor],
    body: Body,
    T: Floats,
    *,
    noise: float = 0.0,
    hidden: int = 0,
    false: int = 0,
    sigma: float = 1.5,
    seed: int = 0,
) -> list[View]:
    """Shuffled, unlabelled detections of a body, some hidden, some false."""
    rng = np.random.default_rng(seed)
    views = []
    for k, sensor in enumerate(sensors):
        y, visible = sensor.project(transform(T, body.means))
        y = y[visible] + rng.normal(0, noise, y[visible].shape) if noise else y[visible]
        y = y[rng.permutation(len(y))[hidden:]]
        clutter = rng.uniform(y.min(axis=0) - 100, y.max(axis=0) + 100, (false, y.shape[1]))
        views.append(view_of(str(k), sensor, np.concatenate([y, clutter]), sigma))
    return views


def random_start(seed: int, length: float = 6.0, angle_deg: float = 3.0) -> Floats:
    """A pose near `TRUTH`, uniform within a length and an angle along and about each axis."""
    rng = np.random.default_rng(seed)
    return perturb(TRUTH, rng.uniform(-1, 1, 6) * np.repeat([length, np.radians(angle_deg)], 3))
