"""Sensors that see a body in motion: with a delay, or row after row.

All features of a moving body share one motion, so that a sensor that sees them at different times
is a sensor like any other: a map from world points at the common time to measurements.
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
    """The motion of a body, or of the world."""

    T_world_object: Floats  # (4, 4) at the common time; the body turns about its origin
    velocity: Floats  # (6,) twist per second, as of `mixpose.rigid.perturb`
    # (6,) twist per second²: in 6 ms a hand at 0.3 m/s deviates from a straight line by 0.05 mm
    acceleration: Floats = field(default_factory=lambda: np.zeros(6))

    def after(self, seconds: float) -> Floats:
        """Return the motion (4, 4) of world points from the common time to `seconds` later."""
        twist = (self.velocity + 0.5 * seconds * self.acceleration) * seconds
        return np.asarray(perturb(self.T_world_object, twist) @ self._back)

    @cached_property
    def _back(self) -> Floats:
        """Motion (4, 4) from the world to the body."""
        return inverse(self.T_world_object)


def in_motion(sensor: Sensor, motion: Motion, delay: float, readout: float) -> Sensor:
    """Return a sensor of a moving body, as a map from points at the common time.

    Its middle row is read `delay` seconds later, its last row `readout` seconds after the first.
    """
    if not motion.velocity.any() or not (delay or readout):
        return sensor
    if not readout:
        return sensor.moved(motion.after(delay))
    return RollingSensor(sensor, motion, delay, readout)


@dataclass(frozen=True, eq=False)
class RollingSensor:
    """A camera that reads one row after the other while the body moves."""

    sensor: Sensor
    motion: Motion
    delay: float
    readout: float

    dimension: ClassVar[int] = 2
    unit: ClassVar[Literal["px", "length"]] = "px"

    @property
    def lower(self) -> Floats:
        """Upper left corner (2,) of the image."""
        return self.sensor.lower

    @property
    def upper(self) -> Floats:
        """Lower right corner (2,) of the image."""
        return self.sensor.upper

    def project(self, points_world: Floats) -> tuple[Floats, Mask]:
        """Return pixels (..., 2) of world points (..., 3), and which of them the camera sees."""
        y, _, visible = self.linearise(points_world)
        return y, visible

    def linearise(self, points_world: Floats) -> tuple[Floats, Floats, Mask]:
        """Return pixels as `project`, their Jacobian (..., 2, 3), and the mask."""
        shape = points_world.shape[:-1]
        y, J, visible = self._batch.linearise(points_world.reshape(-1, 3))
        return y.reshape(*shape, 2), J.reshape(*shape, 2, 3), visible.reshape(shape)

    def towards(self, points_world: Floats) -> Floats:
        """Return directions (..., 3) from points (..., 3) to the sensor, for the middle row."""
        T = self._at_middle
        return self.sensor.towards(points_world @ T[:3, :3].T + T[:3, 3]) @ T[:3, :3]

    def rays(self, y: Floats) -> Rays | None:
        """Return lines of sight of detections (M, 2), at the time of the middle row."""
        return self.sensor.moved(self._at_middle).rays(y)

    def moved(self, motion: Floats) -> Self:
        """Return a sensor that sees points x where this one sees ``motion @ x``."""
        back = inverse(motion)
        T = back @ self.motion.T_world_object
        velocity, acceleration = (
            (twist.reshape(2, 3) @ back[:3, :3].T).reshape(6)
            for twist in (self.motion.velocity, self.motion.acceleration)
        )
        return replace(
            self, sensor=self.sensor.moved(motion), motion=Motion(T, velocity, acceleration)
        )

    @cached_property
    def _at_middle(self) -> Floats:
        """Motion (4, 4) of world points until the middle row is read."""
        return self.motion.after(self.delay)

    @cached_property
    def _batch(self) -> RollingBatch:
        return RollingBatch([self])


class RollingBatch:
    """Cameras that read one row after the other, each with its motion."""

    def __init__(self, cameras: Sequence[RollingSensor]) -> None:
        motions = [camera.motion for camera in cameras]
        self._static = batch.side_by_side(tuple([camera.sensor for camera in cameras]))
        # components first, then sensors: (3, L, 1) and (6, L, 1)
        self._origin = np.array([motion.T_world_object[:3, 3] for motion in motions]).T[..., None]
        self._velocity = np.array([motion.velocity for motion in motions]).T[..., None]
        self._acceleration = np.array([motion.acceleration for motion in motions]).T[..., None]
        self._delay = np.array([[camera.delay] for camera in cameras])
        rows = [(row_span(camera.sensor), middle_row(camera.sensor)) for camera in cameras]
        spans, self._middle = np.array(rows).T[..., None]
        self._per_row = np.array([[camera.readout] for camera in cameras]) / spans
        # places and velocities when middle rows are read, of the origin, and per arm from there
        ends = np.concatenate([np.zeros((3, 1)), np.eye(3)], axis=1)[:, None]
        places, velocities, _ = self._move(ends, self._delay)
        states = np.concatenate([places, velocities]).swapaxes(0, 1)  # (L, 6, 4)
        self._of_origin, self._by_arm = states[..., :1], states[..., 1:] - states[..., :1]

    def towards(self, points_world: Floats) -> Floats:
        """As `SensorBatch.towards`, at the times of the middle rows."""
        turns = self._by_arm[:, :3]
        arms = points_world.T - self._origin.swapaxes(0, 1)
        places = turns @ arms + self._of_origin[:, :3]
        return np.asarray(self._static.towards(places.swapaxes(1, 2)) @ turns)

    def linearise(self, points_world: Floats) -> tuple[Floats, Floats, Mask]:
        """As `SensorBatch.linearise`, at the time at which the row that a point has then is read.

        One Newton step from the middle row leaves an error of second order in the rows by which
        the image moves while a row is read.
        """
        per_row = self._per_row
        points = points_world if points_world.ndim > 2 else points_world[None]
        x = points.transpose(2, 0, 1)
        arms = np.subtract(x, self._origin, order="C")
        at_middle = (self._by_arm @ arms.swapaxes(0, 1) + self._of_origin).swapaxes(1, 2)
        y, J, visible = self._static.linearise(at_middle[..., :3])
        row_speed = np.vecdot(J[:, :, 1], at_middle[..., 3:])
        late = per_row * (y[..., 1] - self._middle)
        lag = np.where(visible, late / (1 - per_row * row_speed), 0.0)
        places, velocities, turns = self._move(arms, self._delay + lag)
        y, J, visible = self._static.linearise(places.transpose(1, 2, 0))
        by_place = J.transpose(3, 2, 0, 1)  # (3, 2, L, n)
        by_time = (by_place * velocities[:, None]).sum(axis=0)
        by_point = _turned(by_place, -turns[:, None])
        # the time depends on the row, and the image on both: y(x, t(x))
        by_row = by_point[:, 1] * (per_row / (1 - per_row * by_time[1]))
        by_point += by_time * by_row[:, None]
        return y, by_point.transpose(2, 3, 1, 0), visible

    def _move(self, arms: Floats, seconds: Floats) -> tuple[Floats, Floats, Floats]:
        """Return places and velocities of arms (3, L, n) after seconds (L, n or 1), and turns."""
        gain = seconds * self._acceleration
        twists = (self._velocity + 0.5 * gain) * seconds
        rates, turns = self._velocity + gain, twists[3:]
        moved = _turned(arms, turns) + twists[:3]
        return self._origin + moved, rates[:3] + cross(rates[3:], moved), turns


def side_by_side(sensors: Sequence[Sensor]) -> batch.SensorBatch:
    """Return a batch of sensors of any kinds, moving ones among them."""
    rolling = [sensor for sensor in sensors if isinstance(sensor, RollingSensor)]
    if rolling and len(rolling) == len(sensors):
        return RollingBatch(rolling)
    return batch.side_by_side(tuple(sensors))


def row_span(sensor: Sensor) -> float:
    """Return the number of rows from the first of an image to the last."""
    return float(sensor.upper[1] - sensor.lower[1]) - 1.0


def middle_row(sensor: Sensor) -> float:
    """Return the row in the middle of an image."""
    return float(sensor.lower[1] + sensor.upper[1]) / 2


def read_times(sensor: Sensor, y: Floats, delay: float, readout: float) -> Floats:
    """Return the seconds (...,) after the common time at which pixels (..., m) are read."""
    if not readout:
        return np.full(y.shape[:-1], delay)
    return np.asarray(delay + readout * (y[..., 1] - middle_row(sensor)) / row_span(sensor))


def _turned(points: Floats, vectors: Floats) -> Floats:
    """Return points (3, ...) turned by small rotation vectors (3, ...), to the third order."""
    once = cross(vectors, points)
    angle2 = (vectors * vectors).sum(axis=0)
    turned = points + (1 - angle2 / 6) * once + (0.5 - angle2 / 24) * cross(vectors, once)
    return np.asarray(turned)
