"""A body in several sensors at once.

For the handful of points that a body has, one call for all sensors costs hardly more than one for
one.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from mixpose.body import Body
from mixpose.objective.base import facing
from mixpose.sensors import Sensor, bank

Floats: TypeAlias = NDArray[np.float64]

_LIFT = np.zeros((9, 3))
_LIFT[[1, 5, 6], [2, 0, 1]] = 1.0  # x ↦ −[x]× as a matrix of nine rows
_LIFT[[2, 3, 7], [1, 2, 0]] = -1.0


class Projected(NamedTuple):
    """A body in L sensors at one pose.

    Attributes
    ----------
    y : (L, n, m) float64
    J : (L, n, m, 6) float64
        By the twist of the pose; zero where a feature is not seen.
    seen : (L, n) bool
        In view, and facing the sensor where normals are known.
    faced : (L, n) bool
        Facing the sensor, in view or not.
    weights : (L, n) float64
        Zero where a feature is not seen.
    """

    y: Floats
    J: Floats
    seen: NDArray[np.bool_]
    faced: NDArray[np.bool_]
    weights: Floats


class Gaze:
    """Sensors of one dimension that look at a body."""

    def __init__(self, sensors: Sequence[Sensor], body: Body) -> None:
        self.sensors = tuple(sensors)
        self.points = body.nodes.points
        self.weights = body.nodes.weights
        self.ones = np.ones(len(self.points))
        self.is_even = bool((self.weights == 1.0).all())
        self.normals = body.node_normals
        self._bank = bank(self.sensors)
        self._everything = np.ones((len(self.sensors), len(self.points)), dtype=np.bool_)
        self._by_twist = np.zeros((len(self.points), 3, 6))
        self._by_twist[:, :, :3] = np.eye(3)
        self._last: tuple[bytes, Projected] | None = None

    def project(self, T_world_object: Floats) -> Projected:
        """Where the sensors see the body at a pose (4, 4); not to be written to.

        The last answer is kept: what one step ends with, the next begins with.
        """
        key = T_world_object.tobytes()
        if self._last is None or self._last[0] != key:
            self._last = key, self._project(T_world_object)
        return self._last[1]

    def _project(self, T_world_object: Floats) -> Projected:
        arms = self.points @ T_world_object[:3, :3].T
        points_world = arms + T_world_object[:3, 3]
        y, by_world, seen = self._bank.linearise(points_world)
        faced = self._everything
        if self.normals is not None:
            each = [facing(one, T_world_object, points_world, self.normals) for one in self.sensors]
            faced = np.array(each)
            seen &= faced
        by_twist = self._by_twist.copy()
        by_twist[:, :, 3:] = (arms @ _LIFT.T).reshape(-1, 3, 3)
        return Projected(y, by_world @ by_twist, seen, faced, self.weights * seen)


def gazes_of(sensors: Sequence[Sensor], body: Body) -> list[Gaze]:
    """Sensors side by side, those of each dimension together."""
    dimensions = sorted({sensor.dimension for sensor in sensors})
    return [Gaze([one for one in sensors if one.dimension == m], body) for m in dimensions]
