"""What an objective is, and what it knows of each sensor.

An objective maps poses to numbers to be maximised.  `linearise` gives what an optimiser needs at
one pose: value, gradient, and a curvature that is positive semidefinite (minus the Hessian,
without the terms that can make it indefinite).  Order and axes of the six numbers are those of
`mixpose.rigid`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

from mixpose.density import Observation
from mixpose.sensors import Sensor

Floats: TypeAlias = NDArray[np.float64]


@dataclass(frozen=True)
class View:
    """One sensor with what it observed.

    Attributes
    ----------
    name : str
    sensor : Sensor
    observation : Observation
    """

    name: str
    sensor: Sensor
    observation: Observation


class Quadratic(NamedTuple):
    """Second-order model of an objective at a pose: value + gᵀδ − ½ δᵀCδ.

    Attributes
    ----------
    value : float
    gradient : (6,) float64
    curvature : (6, 6) float64
        Symmetric, positive semidefinite.
    hessian : (6, 6) float64 or None
        Minus the second derivative itself, where it is known; may be indefinite.
    """

    value: float
    gradient: Floats
    curvature: Floats
    hessian: Floats | None = None


class Objective(Protocol):
    """A function of the pose, to be maximised."""

    def value(self, T_world_object: Floats) -> Floats:
        """Values (...,) at poses (..., 4, 4)."""
        ...

    def linearise(self, T_world_object: Floats) -> Quadratic:
        """Value, gradient and curvature at one pose (4, 4)."""
        ...


def facing(
    sensor: Sensor, T_world_object: Floats, points_world: Floats, normals: Floats | None
) -> NDArray[np.bool_]:
    """Which features turn their face to a sensor: (..., n), true where normals are not known.

    Parameters
    ----------
    sensor : Sensor
    T_world_object : (..., 4, 4) array
    points_world : (..., n, 3) array
    normals : (n, 3) array or None
        In the object's frame.
    """
    if normals is None:
        return np.ones(points_world.shape[:-1], dtype=np.bool_)
    outward = normals @ np.swapaxes(T_world_object[..., :3, :3], -1, -2)
    return np.asarray((outward * sensor.towards(points_world)).sum(axis=-1) > 0)


def pose_jacobian(by_world: Floats, T_world_object: Floats, points: Floats) -> Floats:
    """Chain the Jacobian (..., n, m, 3) by world points into (..., n, m, 6) by the pose's twist.

    A turn ω about the object's origin moves R z by ω × R z, and a · (ω × x) = ω · (x × a).
    """
    arms = points @ np.swapaxes(T_world_object[..., :3, :3], -1, -2)
    x, y, z = arms[..., 0, None], arms[..., 1, None], arms[..., 2, None]
    a, b, c = by_world[..., 0], by_world[..., 1], by_world[..., 2]
    J = np.empty((*by_world.shape[:-1], 6))
    J[..., :3] = by_world
    J[..., 3] = y * c - z * b
    J[..., 4] = z * a - x * c
    J[..., 5] = x * b - y * a
    return J


def region_of_interest(sensor: Sensor, y: Floats, margin: float) -> tuple[Floats, Floats]:
    """Box (lower, upper) around projected points (n, m), within the sensor.

    Parameters
    ----------
    sensor : Sensor
    y : (n, m) array
        Visible points, at least one.
    margin : float
        Sensor units added on every side.
    """
    lower = np.maximum(y.min(axis=0) - margin, sensor.lower)
    upper = np.minimum(y.max(axis=0) + margin, sensor.upper)
    return lower, upper
