"""Sensors that look at a world in motion: late ones, and those that read row after row.

All features of a moving body share one motion, so that a sensor which sees each of them at its own
moment is a sensor like any other: a map from world points at the common time to what it measures.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal, Self

import numpy as np

from mixpose.rigid import inverse, perturb
from mixpose.sensors.base import Floats, Mask, Sensor, hide
from mixpose.sensors.rays import Rays


@dataclass(frozen=True)
class Motion:
    """How the world moves, or a body in it.

    Attributes
    ----------
    T_world_object : (4, 4) float64
        The pose at the common time; the body turns about its origin.
    velocity : (6,) float64
        Twist per second, as of `mixpose.rigid.perturb`.
    acceleration : (6,) float64
        Per second more: in 6 ms a hand at 0.3 m/s leaves a straight course by 0.05 mm.
    """

    T_world_object: Floats
    velocity: Floats
    acceleration: Floats = field(default_factory=lambda: np.zeros(6))

    def after(self, seconds: float) -> Floats:
        """Where points go in some seconds, as a motion (4, 4) of the world."""
        twist = (self.velocity + 0.5 * seconds * self.acceleration) * seconds
        return np.asarray(perturb(self.T_world_object, twist) @ inverse(self.T_world_object))


def in_motion(sensor: Sensor, motion: Motion, delay: float, readout: float) -> Sensor:
    """A sensor that sees what moves, as a map from points at the common time.

    Parameters
    ----------
    sensor : Sensor
    motion : Motion
    delay : float
        Seconds after the common time at which the middle row is read.
    readout : float
        Seconds from the first row to the last.
    """
    if not motion.velocity.any() or not (delay or readout):
        return sensor
    if not readout:
        return sensor.moved(motion.after(delay))
    return RollingSensor(sensor, motion, delay, readout)


@dataclass(frozen=True, eq=False)
class RollingSensor:
    """A camera that reads one row after the other while what it sees moves."""

    sensor: Sensor
    motion: Motion
    delay: float
    readout: float

    @property
    def dimension(self) -> int:
        """m, the number of sensor coordinates."""
        return self.sensor.dimension

    @property
    def unit(self) -> Literal["px", "length"]:
        """What the sensor coordinates count."""
        return self.sensor.unit

    @property
    def lower(self) -> Floats:
        """Smallest measurable coordinates (m,)."""
        return self.sensor.lower

    @property
    def upper(self) -> Floats:
        """Largest measurable coordinates (m,)."""
        return self.sensor.upper

    def moments(self, y: Floats) -> Floats:
        """Seconds (...,) after the common time at which pixels (..., 2) are read."""
        return moments(self.sensor, y, self.delay, self.readout)

    def project(self, points_world: Floats) -> tuple[Floats, Mask]:
        """Pixels (..., 2) of world points (..., 3), and which of them the camera sees."""
        y, _, visible = self.linearise(points_world)
        return y, visible

    def linearise(self, points_world: Floats) -> tuple[Floats, Floats, Mask]:
        """As `project`, with the Jacobian (..., 2, 3) in between.

        The moment t solves t = moment of the row that is seen at t.  One Newton step from the
        middle row leaves the square of the share of the readout in which the image moves a row.
        """
        shape = points_world.shape[:-1]
        x = points_world.reshape(-1, 3)
        per_row = self._per_row
        at, R = self._moved(x, np.full(len(x), self.delay))
        y, J, visible = self.sensor.linearise(at)
        seconds = np.full(len(x), self.delay)
        speed = (J[:, 1] * self._speeds(at, seconds)).sum(axis=1)
        wanted = self.moments(y) - self.delay
        lag = np.where(visible, wanted / (1 - per_row * speed), 0.0)
        seconds = self.delay + lag
        at, R = self._moved(x, seconds)
        y, J, visible = self.sensor.linearise(at)
        by_time = np.einsum("nij,nj->ni", J, self._speeds(at, seconds))
        J = J @ R
        # as t moves with the row, so does the image: y(x, t(x))
        by_point = per_row * J[:, 1] / (1 - per_row * by_time[:, 1])[:, None]
        J = J + by_time[:, :, None] * by_point[:, None]
        hide(y, visible, J)
        return y.reshape(*shape, 2), J.reshape(*shape, 2, 3), visible.reshape(shape)

    def towards(self, points_world: Floats) -> Floats:
        """Directions (..., 3) from world points (..., 3) to the sensor."""
        return self.sensor.moved(self.motion.after(self.delay)).towards(points_world)

    def rays(self, y: Floats) -> Rays | None:
        """Lines of sight of detections (M, 2), as of the middle row."""
        return self.sensor.moved(self.motion.after(self.delay)).rays(y)

    def moved(self, motion: Floats) -> Self:
        """The sensor that sees points x where this one sees ``motion @ x``."""
        T = inverse(motion) @ self.motion.T_world_object
        turned = inverse(motion)[:3, :3]
        velocity, acceleration = (
            (one.reshape(2, 3) @ turned.T).reshape(6)
            for one in (self.motion.velocity, self.motion.acceleration)
        )
        return replace(
            self, sensor=self.sensor.moved(motion), motion=Motion(T, velocity, acceleration)
        )

    @property
    def _per_row(self) -> float:
        return self.readout / rows_apart(self.sensor)

    def _moved(self, x: Floats, seconds: Floats) -> tuple[Floats, Floats]:
        """Points (n, 3) after some seconds each, and the turns (n, 3, 3) that they made."""
        origin, t = self.motion.T_world_object[:3, 3], seconds[:, None]
        twists = (self.motion.velocity + 0.5 * t * self.motion.acceleration) * t
        R = _turns(twists[:, 3:])
        return origin + twists[:, :3] + np.einsum("nij,nj->ni", R, x - origin), R

    def _speeds(self, x: Floats, seconds: Floats) -> Floats:
        """Velocities (n, 3) of points of the body (n, 3), but for how far its origin moved."""
        twists = self.motion.velocity + seconds[:, None] * self.motion.acceleration
        arms = x - self.motion.T_world_object[:3, 3]
        return np.asarray(twists[:, :3] + np.cross(twists[:, 3:], arms))


def rows_apart(sensor: Sensor) -> float:
    """Rows from the first of an image to the last."""
    return float(sensor.upper[1] - sensor.lower[1]) - 1.0


def moments(sensor: Sensor, y: Floats, delay: float, readout: float) -> Floats:
    """Seconds (...,) after the common time at which pixels (..., m) are read."""
    if not readout:
        return np.full(y.shape[:-1], delay)
    middle = (sensor.lower[1] + sensor.upper[1]) / 2
    return np.asarray(delay + readout * (y[..., 1] - middle) / rows_apart(sensor))


def _turns(vectors: Floats) -> Floats:
    """Rotation matrices (n, 3, 3) of small rotation vectors (n, 3), to the third order."""
    angle2 = (vectors * vectors).sum(axis=1)[:, None, None]
    x, y, z = vectors.T
    o = np.zeros_like(x)
    K = np.stack([o, -z, y, z, o, -x, -y, x, o], axis=1).reshape(-1, 3, 3)
    return np.asarray(np.eye(3) + (1 - angle2 / 6) * K + (0.5 - angle2 / 24) * K @ K)
