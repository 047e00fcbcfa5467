"""The paper's set-up: object, three systems, five scenarios, and the poses that are drawn."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from mixpose.body import Body, PointFeature
from mixpose.sensors import ParallelBeam, RangeSensor, Sensor

Floats: TypeAlias = NDArray[np.float64]

POINTS = np.array(
    [
        [0, -25.0, -43.3],
        [100.0, -25.0, -43.3],
        [0, 61.6, -93.3],
        [100.0, 111.6, -6.7],
        [100.0, 25.0, 43.3],
        [0, 111.6, -6.7],
    ]
)

# Fields of view: every true feature is at least 6 σ from a border in the widest scenario, so that
# cutting the Gaussians off there changes nothing.  The paper does not state its own.
IMAGE_U = (-260, 340)
IMAGE_V = (-210, 240)
RANGE_LIMITS = (700.0, 1260.0)
START_ANGLE = math.radians(2.5)
START_SHIFT = 5.0
"""Starts are uniform within so much of the truth, to either side."""

RANGE_SOURCES = np.array([[0, -1000.0, 0], [1000.0, 0, 0], [0, 0, 1000.0]])

STRETCH = np.array([0.8, 1.0, 1.2])


@dataclass(frozen=True)
class Scenario:
    """What is done to the measurement.

    Attributes
    ----------
    name : str
    sigma : float
        σ_ε, standard deviation of a feature in the measurement.
    deformed : bool
        Whether the object is stretched before it is observed.
    times : float
        How much more it is stretched than in the paper.
    model_deformed : bool
        Whether the model knows.
    noisy : bool
        Whether noise of twice one feature's peak is added to every pixel or bin.
    """

    name: str
    sigma: float
    deformed: bool = False
    model_deformed: bool = False
    noisy: bool = False
    times: float = 1.0

    def observed(self, points: Floats) -> Floats:
        """The points (N, 3) of the object as it is observed."""
        return deformed(points, self.times) if self.deformed else points


SCENARIOS = (
    Scenario("I", 5.0),
    Scenario("II", 20.0),
    Scenario("III", 5.0, deformed=True),
    Scenario("III-as-printed", 5.0, deformed=True, model_deformed=True),
    Scenario("IV", 5.0, noisy=True),
)


@dataclass(frozen=True)
class System:
    """Sensors, and what the model knows of the features.

    Attributes
    ----------
    name : str
    sensors : tuple of Sensor
    spread : float
        Standard deviation σ of the features in the model; 0 for deltas.
    """

    name: str
    sensors: tuple[Sensor, ...]
    spread: float

    def body(self, scenario: Scenario) -> Body:
        """The object as the model has it."""
        points = deformed(POINTS) if scenario.model_deformed else POINTS
        covariance = self.spread**2 * np.eye(3)
        return Body("paper", tuple(PointFeature(point, covariance) for point in points))


def camera(gamma: float) -> ParallelBeam:
    """The parallel beam (cos γ x + sin γ y, z), one unit per pixel."""
    c, s = np.cos(gamma), np.sin(gamma)
    T = np.eye(4)
    T[:3, :3] = [[c, s, 0], [0, 0, 1], [s, -c, 0]]
    origin = -np.array([IMAGE_U[0], IMAGE_V[0]], dtype=np.float64)
    size = (IMAGE_U[1] - IMAGE_U[0] + 1, IMAGE_V[1] - IMAGE_V[0] + 1)
    return ParallelBeam(1.0, origin, size, T)


def systems(spread: float = 5.0) -> tuple[System, ...]:
    """Systems 1 to 3; the 6-D table has σ = 5 for the features, the objective maps have 10."""
    cameras = (camera(0.0), camera(np.pi / 2))
    ranges = tuple(RangeSensor(source, 0.0, RANGE_LIMITS) for source in RANGE_SOURCES)
    return System("1", cameras, 0.0), System("2", cameras, spread), System("3", ranges, spread)


def deformed(points: Floats, times: float = 1.0) -> Floats:
    """Scenario III: stretched about the centre of the features."""
    centre = points.mean(axis=0)
    return np.asarray(centre + (1 + times * (STRETCH - 1)) * (points - centre))


def pose(beta: Floats) -> Floats:
    """T_world_object (4, 4) of the paper's (φ1, φ2, φ3, w1, w2, w3), radians: R3 R2 R1 (z + w)."""
    T = np.eye(4)
    T[:3, :3] = rotation(beta)
    T[:3, 3] = T[:3, :3] @ beta[3:]
    return T


def rotation(beta: Floats) -> Floats:
    """R3(φ3) R2(φ2) R1(φ1)."""
    # scalars: many times faster than arrays of three, and the table takes millions of these
    angles = beta[:3].tolist()
    c1, c2, c3 = map(math.cos, angles)
    s1, s2, s3 = map(math.sin, angles)
    return np.array(
        [
            [c3 * c2, c3 * s2 * s1 - s3 * c1, c3 * s2 * c1 + s3 * s1],
            [s3 * c2, s3 * s2 * s1 + c3 * c1, s3 * s2 * c1 - c3 * s1],
            [-s2, c2 * s1, c2 * c1],
        ]
    )


def parameters(T_world_object: Floats) -> Floats:
    """The paper's six numbers (6,), radians, of a pose (4, 4)."""
    R = T_world_object[:3, :3]
    angles = Rotation.from_matrix(R).as_euler("xyz")
    return np.concatenate([angles, R.T @ T_world_object[:3, 3]])


def draw(rng: np.random.Generator) -> tuple[Floats, Floats]:
    """A true pose and a start, both (6,), from the intervals of the accuracy evaluation."""
    five = np.pi / 36
    truth = np.concatenate([rng.uniform(-five, five, 3), rng.uniform(35, 45, 3)])
    truth[2] -= np.pi / 3
    turn, shift = START_ANGLE, START_SHIFT
    off = np.concatenate([rng.uniform(-turn, turn, 3), rng.uniform(-shift, shift, 3)])
    return truth, truth + off
