"""Clutter as it is: false points in space that all cameras see, and other bodies.

False detections that are drawn for each view alone hardly ever meet in space.  Real ones do: they
are screws, lamps, other bodies, and reflections of the body in a window or a polished floor.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from benchmarks.search_cases import CUBE, DISTANCE, NOISE_PX, SENSORS, SIGMA_PX, Trial
from mixpose.body import Body, PointFeature
from mixpose.density import Observation
from mixpose.judgement import expected_covariance
from mixpose.objective import View
from mixpose.records import PointPattern
from mixpose.rigid import from_parts, transform

Floats: TypeAlias = NDArray[np.float64]
Other: TypeAlias = Literal["points", "body", "triple", "mirror"]

NEAR = 200.0  # half-width about the origin in which other bodies are
SPREAD = 300.0  # half-width about the origin in which single points are


@dataclass(frozen=True)
class Scene:
    """One line of the table: a body of 5 to 8 markers, and what else is there.

    Attributes
    ----------
    sensors : str
        Key of `SENSORS`.
    other : str
        "points": as many false points as the body has markers; "body": another random body;
        "triple": another one, three of whose markers lie as three of the body's; "mirror": the
        body's mirror image.
    blind : bool
        Whether the first camera does not see the body, only what else is there.
    wanted : float
        Share of frames aimed at whose pose, the first hypothesis, is right.
    """

    sensors: str
    other: Other
    blind: bool = False
    wanted: float = 0.9

    @property
    def name(self) -> str:
        return f"{self.sensors} + {self.other}" + (", one blind" if self.blind else "")


SCENES = (
    Scene("2 pinhole", "points"),
    Scene("2 pinhole", "body"),
    Scene("2 pinhole", "triple"),
    Scene("2 pinhole", "mirror"),
    Scene("2 pinhole", "body", blind=True, wanted=0.5),
    Scene("3 pinhole", "mirror"),
    Scene("3 pinhole", "triple", blind=True),
    Scene("1 pinhole", "body", wanted=0.5),
)


def scene_trial(scene: Scene, seed: int, *, present: bool = True) -> Trial:
    """A random body among other things that all cameras see, or these alone."""
    rng = np.random.default_rng([seed, *scene.name.encode()])
    sensors = SENSORS[scene.sensors](rng)
    points = rng.uniform(-CUBE / 2, CUBE / 2, (int(rng.integers(5, 9)), 3))
    body = Body("random", tuple(PointFeature(point) for point in points))
    T = _anywhere(points, 50.0, rng)
    clutter = _clutter(scene.other, points, rng)
    views = []
    for k, sensor in enumerate(sensors):
        own = transform(T, points) if present and not (scene.blind and k == 0) else points[:0]
        y, seen = sensor.project(np.concatenate([own, clutter]))
        y = y[seen] + NOISE_PX * rng.standard_normal((int(seen.sum()), 2))
        single = rng.uniform(sensor.lower, sensor.upper, (int(rng.integers(0, 3)), 2))
        y = rng.permutation(np.concatenate([y, single]))
        weights = rng.uniform(0.5, 2.0, len(y))
        views.append(View(f"camera{k}", sensor, Observation(PointPattern(y, weights), SIGMA_PX)))
    alone = scene.sensors == "1 pinhole" or (scene.blind and scene.sensors == "2 pinhole")
    limits = (3.0, 0.02) if alone else (1.0, 0.005)
    seeing = sensors[1:] if scene.blind else sensors
    known, _ = expected_covariance(seeing, [NOISE_PX] * len(seeing), body, T, np.ones(6, bool))
    return Trial(views, body, T, DISTANCE, *limits, covariance=known)


def _anywhere(points: Floats, shift: float, rng: np.random.Generator) -> Floats:
    R = Rotation.random(rng=rng).as_matrix()
    return from_parts(R, rng.uniform(-shift, shift, 3) - R @ points.mean(axis=0))


def _clutter(other: Other, points: Floats, rng: np.random.Generator) -> Floats:
    """Points (n, 3) in the world."""
    n = len(points)
    if other == "points":
        return rng.uniform(-SPREAD, SPREAD, (n, 3))
    shape = rng.uniform(-CUBE / 2, CUBE / 2, (int(rng.integers(5, 9)), 3))
    if other == "triple":
        shape[:3] = points[rng.permutation(n)[:3]]
    elif other == "mirror":
        shape = points * np.array([-1.0, 1.0, 1.0])
    return transform(_anywhere(shape, NEAR, rng), shape)


def scenes_named(names: Sequence[str]) -> list[Scene]:
    """Scenes whose names contain one of the given texts; all for none."""
    return [scene for scene in SCENES if not names or any(name in scene.name for name in names)]
