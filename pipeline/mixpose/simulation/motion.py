"""The motion of a simulated body, and the moments at which a sensor sees it.

Motion is smooth, does not repeat, and is known exactly.  Sensors may be late, and cameras read
their rows one after the other: the time of a frame is that at which its middle row is read, in the
middle of the row's exposure.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.random import Generator

from mixpose.records import Floats
from mixpose.rigid import TWIST_NAMES, from_parts, rotation_matrix
from mixpose.sensors import Sensor
from mixpose.simulation.options import Purpose, generator

# A slow swing and a faster, smaller one added to it, per axis.
_SHARES = np.array([0.7, 0.3])
_FREQUENCIES = np.array([[0.6, 1.1], [1.5, 2.3]])  # lowest, highest; in swings per period
# Every axis begins a little off the centre, so that a session's [start] is near but not exact.
_FIRST = 0.07

PoseAt: TypeAlias = Callable[[float], Floats]
"""Function from seconds, of the recording or after a frame, to a pose (4, 4)."""

_ROUNDS = 6  # each multiplies the error by the share of rows crossed in a readout: 0.001
_BLUR_STEPS = 9  # positions of a moving marker that are summed in an exposure


@dataclass(frozen=True)
class Swing:
    """Sums of K sinusoids, one sum per world axis."""

    amplitudes: Floats  # (K, 3)
    frequencies_hz: Floats  # (K, 3)
    phases: Floats  # (K, 3), radians

    def at(self, times_s: Floats) -> Floats:
        """Return values (..., 3) at times (...)."""
        angles = 2 * np.pi * self.frequencies_hz * np.asarray(times_s)[..., None, None]
        return np.asarray((self.amplitudes * np.sin(angles + self.phases)).sum(axis=-2))


@dataclass(frozen=True)
class Motion:
    """A body that swings and turns about a central pose."""

    T_world_object: Floats  # (4, 4), the central pose
    pivot: Floats  # (3,), the point of the object, in its own frame, about which it turns
    shift: Swing  # displacement of the pivot, length units
    turn: Swing  # rotation vector in world axes, radians

    def poses(self, times_s: Floats) -> Floats:
        """Return poses T_world_object (..., 4, 4) at times (...) in seconds."""
        R_centre, t_centre = self.T_world_object[:3, :3], self.T_world_object[:3, 3]
        R = rotation_matrix(self.turn.at(times_s)) @ R_centre
        pivot_world = R_centre @ self.pivot + t_centre + self.shift.at(times_s)
        return from_parts(R, pivot_world - R @ self.pivot)

    def pose(self, time_s: float) -> Floats:
        """Return the pose (4, 4) at a time."""
        return self.poses(np.array(time_s))

    @property
    def reach(self) -> float:
        """Largest distance of the pivot from its central place."""
        return float(np.linalg.norm(self.shift.amplitudes.sum(axis=0)))


def plan_motion(
    T_world_object: Floats,
    pivot: Floats,
    *,
    translation: float,
    rotation_deg: float,
    period_s: float,
    free: tuple[str, ...] = TWIST_NAMES,
    seed: int = 0,
) -> Motion:
    """Choose a motion about a central pose (4, 4) and the pivot (3,) in the object's frame.

    With fewer than six of the world-frame directions `free` it turns about its origin instead, as a
    turn about any other point would move the origin.  `translation` and `rotation_deg` are maxima
    per world axis; the slow swing takes about `period_s`.
    """
    rng = generator(seed, Purpose.MOTION)
    is_free = np.array([name in free for name in TWIST_NAMES], dtype=np.float64)
    if not is_free.all():
        pivot = np.zeros(3)
    return Motion(
        T_world_object=np.asarray(T_world_object, dtype=np.float64),
        pivot=np.asarray(pivot, dtype=np.float64),
        shift=_swing(translation * is_free[:3], period_s, rng),
        turn=_swing(np.radians(rotation_deg) * is_free[3:], period_s, rng),
    )


def _swing(amplitudes: Floats, period_s: float, rng: Generator) -> Swing:
    low, high = _FREQUENCIES[:, :1], _FREQUENCIES[:, 1:]
    first = np.arcsin(_FIRST) * rng.choice([-1.0, 1.0], 3)
    # each sinusoid begins rising or falling by chance
    falling = rng.random((len(_SHARES), 3)) < 0.5
    return Swing(
        amplitudes=_SHARES[:, None] * amplitudes,
        frequencies_hz=(low + (high - low) * rng.random((len(_SHARES), 3))) / period_s,
        phases=np.where(falling, np.pi - first, first),
    )


@dataclass(frozen=True)
class Shutter:
    """The timing of a sensor."""

    delay_s: float = 0.0  # after the common time
    readout_s: float = 0.0  # from the first row to the last
    exposure_s: float = 0.0  # during which a row collects light
    rows: int = 0  # of an image; 0 for other sensors

    @property
    def is_ideal(self) -> bool:
        """Whether everything is seen at the common time."""
        return not (self.delay_s or self.readout_s or self.exposure_s)

    def poses(self, sensor: Sensor, point: Floats, pose_after: PoseAt) -> list[Floats]:
        """Return the poses at which a point (3,) of a body is seen, for parts of the exposure."""
        if self.is_ideal:
            return [pose_after(0.0)]
        steps = _BLUR_STEPS if self.exposure_s else 1
        shares = (np.arange(steps) + 0.5) / steps - 0.5
        return [
            pose_after(self._moment(sensor, point, pose_after, share * self.exposure_s))
            for share in shares.tolist()
        ]

    def _moment(self, sensor: Sensor, point: Floats, pose_after: PoseAt, offset_s: float) -> float:
        first = moment = self.delay_s + offset_s
        if not self.readout_s:
            return moment
        for _ in range(_ROUNDS):
            T = pose_after(moment)
            y, visible = sensor.project(T[:3, :3] @ point + T[:3, 3])
            if not visible:
                break
            moment = first + self.readout_s * (float(y[1]) / (self.rows - 1) - 0.5)
        return moment
