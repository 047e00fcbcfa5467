"""Sensors that look at a world in motion: late ones, and those that read row after row.

All features of a moving body share one motion, so that a sensor which sees each of them at its own
moment is a sensor like any other: a map from world points at the common time to what it measures.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import ClassVar, Literal, Self

import numpy as np

from mixpose.records import Floats, Mask
from mixpose.rigid import cross, inverse, perturb
from mixpose.sensors import batch
from mixpose.sensors.base import Rays, Sensor


@dataclass(frozen=True)
class Motion:
    """How the world moves, or a body in it."""

    T_world_object: Floats  # (4, 4) at the common time; the body turns about its origin
    velocity: Floats  # (6,) twist per second, as of `mixpose.rigid.perturb`
    # (6,) per second more: in 6 ms a hand at 0.3 m/s leaves a straight course by 0.05 mm
    acceleration: Floats = field(default_factory=lambda: np.zeros(6))

    def after(self, seconds: float) -> Floats:
        """Where points go in some seconds, as a motion (4, 4) of the world."""
        twist = (self.velocity + 0.5 * seconds * self.acceleration) * seconds
        return np.asarray(perturb(self.T_world_object, twist) @ self._back)

    @cached_property
    def _back(self) -> Floats:
        """From the world to the body."""
        return inverse(self.T_world_object)


def in_motion(sensor: Sensor, motion: Motion, delay: float, readout: float) -> Sensor:
    """A sensor that sees what moves, as a map from points at the common time.

    Its middle row is read `delay` seconds after that, its last `readout` seconds after the first.
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

    dimension: ClassVar[int] = 2
    unit: ClassVar[Literal["px", "length"]] = "px"

    @property
    def lower(self) -> Floats:
        """The image's upper left corner (2,)."""
        return self.sensor.lower

    @property
    def upper(self) -> Floats:
        """The image's lower right corner (2,)."""
        return self.sensor.upper

    def project(self, points_world: Floats) -> tuple[Floats, Mask]:
        """Pixels (..., 2) of world points (..., 3), and which of them the camera sees."""
        y, _, visible = self.linearise(points_world)
        return y, visible

    def linearise(self, points_world: Floats) -> tuple[Floats, Floats, Mask]:
        """As `project`, with the Jacobian (..., 2, 3) in between."""
        shape = points_world.shape[:-1]
        y, J, visible = self._batch.linearise(points_world.reshape(-1, 3))
        return y.reshape(*shape, 2), J.reshape(*shape, 2, 3), visible.reshape(shape)

    def towards(self, points_world: Floats) -> Floats:
        """Directions (..., 3) from world points (..., 3) to the sensor, as of the middle row."""
        T = self._at_middle
        return self.sensor.towards(points_world @ T[:3, :3].T + T[:3, 3]) @ T[:3, :3]

    def rays(self, y: Floats) -> Rays | None:
        """Lines of sight of detections (M, 2), as of the middle row."""
        return self.sensor.moved(self._at_middle).rays(y)

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

    @cached_property
    def _at_middle(self) -> Floats:
        """Where points are when the middle row is read, as a motion (4, 4) of the world."""
        return self.motion.after(self.delay)

    @cached_property
    def _batch(self) -> RollingBatch:
        return RollingBatch([self])


class RollingBatch:
    """Cameras side by side that read one row after the other, each with its motion."""

    def __init__(self, cameras: Sequence[RollingSensor]) -> None:
        motions = [camera.motion for camera in cameras]
        self._still = batch.side_by_side(tuple([camera.sensor for camera in cameras]))
        # components first, then sensors: (3, L, 1) and (6, L, 1)
        self._origin = np.array([one.T_world_object[:3, 3] for one in motions]).T[..., None]
        self._velocity = np.array([one.velocity for one in motions]).T[..., None]
        self._acceleration = np.array([one.acceleration for one in motions]).T[..., None]
        self._delay = np.array([[camera.delay] for camera in cameras])
        rows = [(rows_apart(one.sensor), middle_row(one.sensor)) for one in cameras]
        apart, self._middle = np.array(rows).T[..., None]
        self._per_row = np.array([[camera.readout] for camera in cameras]) / apart
        # places and velocities when the middle rows are read, of the origin and by arms from there
        ends = np.concatenate([np.zeros((3, 1)), np.eye(3)], axis=1)[:, None]
        at, speeds, _ = self._moved(ends, self._delay)
        both = np.concatenate([at, speeds]).swapaxes(0, 1)  # (L, 6, 4)
        self._of_origin, self._by_arm = both[..., :1], both[..., 1:] - both[..., :1]

    def towards(self, points_world: Floats) -> Floats:
        """As `SensorBatch.towards`, as of the middle rows."""
        turns = self._by_arm[:, :3]
        arms = points_world.T - self._origin.swapaxes(0, 1)
        at = turns @ arms + self._of_origin[:, :3]
        return np.asarray(self._still.towards(at.swapaxes(1, 2)) @ turns)

    def linearise(self, points_world: Floats) -> tuple[Floats, Floats, Mask]:
        """As `SensorBatch.linearise`, where t solves t = moment of the row that is seen at t.

        One Newton step from the middle row leaves the square of the share of the readout in which
        the image moves a row.
        """
        per_row = self._per_row
        each = points_world if points_world.ndim > 2 else points_world[None]
        x = each.transpose(2, 0, 1)
        arms = np.subtract(x, self._origin, order="C")
        early = (self._by_arm @ arms.swapaxes(0, 1) + self._of_origin).swapaxes(1, 2)
        y, J, visible = self._still.linearise(early[..., :3])
        speed = np.vecdot(J[:, :, 1], early[..., 3:])
        wanted = per_row * (y[..., 1] - self._middle)
        lag = np.where(visible, wanted / (1 - per_row * speed), 0.0)
        at, speeds, turned = self._moved(arms, self._delay + lag)
        y, J, visible = self._still.linearise(at.transpose(1, 2, 0))
        by_place = J.transpose(3, 2, 0, 1)  # (3, 2, L, n)
        by_time = (by_place * speeds[:, None]).sum(axis=0)
        by_point = _turned(by_place, -turned[:, None])
        # as t moves with the row, so does the image: y(x, t(x))
        by_row = by_point[:, 1] * (per_row / (1 - per_row * by_time[1]))
        by_point += by_time * by_row[:, None]
        return y, by_point.transpose(2, 3, 1, 0), visible

    def _moved(self, arms: Floats, seconds: Floats) -> tuple[Floats, Floats, Floats]:
        """Where arms (3, L, n) are after seconds (L, n) or (L, 1), their velocities, and turns."""
        more = seconds * self._acceleration
        twists = (self._velocity + 0.5 * more) * seconds
        rates, turned = self._velocity + more, twists[3:]
        moved = _turned(arms, turned) + twists[:3]
        return self._origin + moved, rates[:3] + cross(rates[3:], moved), turned


def side_by_side(sensors: Sequence[Sensor]) -> batch.SensorBatch:
    """Put sensors of any kinds side by side."""
    rolling = [one for one in sensors if isinstance(one, RollingSensor)]
    if rolling and len(rolling) == len(sensors):
        return RollingBatch(rolling)
    return batch.side_by_side(tuple(sensors))


def rows_apart(sensor: Sensor) -> float:
    """Rows from the first of an image to the last."""
    return float(sensor.upper[1] - sensor.lower[1]) - 1.0


def middle_row(sensor: Sensor) -> float:
    """The row in the middle of an image."""
    return float(sensor.lower[1] + sensor.upper[1]) / 2


def moments(sensor: Sensor, y: Floats, delay: float, readout: float) -> Floats:
    """Seconds (...,) after the common time at which pixels (..., m) are read."""
    if not readout:
        return np.full(y.shape[:-1], delay)
    return np.asarray(delay + readout * (y[..., 1] - middle_row(sensor)) / rows_apart(sensor))


def _turned(points: Floats, vectors: Floats) -> Floats:
    """Points (3, ...) turned by small rotation vectors (3, ...), to the third order."""
    once = cross(vectors, points)
    angle2 = (vectors * vectors).sum(axis=0)
    turned = points + (1 - angle2 / 6) * once + (0.5 - angle2 / 24) * cross(vectors, once)
    return np.asarray(turned)
