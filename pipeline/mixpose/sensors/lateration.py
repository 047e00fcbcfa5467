"""The range sensor (lateration): distance from a fixed position."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import ClassVar, Literal, Self

import numpy as np

from mixpose.records import Floats, Mask
from mixpose.sensors.base import hide, within


@dataclass(frozen=True, eq=False)
class RangeSensor:
    """Measures distances: range = ‖x_world − position‖ + range_bias."""

    position: Floats  # (3,) the lateration source γ_l in the world
    range_bias: float = 0.0  # constant part of every reading, length units
    range_limits: tuple[float, float] | None = None  # smallest and largest reading; None: no limits
    lower: Floats = field(init=False, repr=False)
    upper: Floats = field(init=False, repr=False)

    dimension: ClassVar[int] = 1
    unit: ClassVar[Literal["px", "length"]] = "length"

    def __post_init__(self) -> None:
        object.__setattr__(self, "position", np.asarray(self.position, dtype=np.float64))
        low, high = self.range_limits or (-np.inf, np.inf)
        object.__setattr__(self, "lower", np.array([low], dtype=np.float64))
        object.__setattr__(self, "upper", np.array([high], dtype=np.float64))

    def project(self, points_world: Floats) -> tuple[Floats, Mask]:
        """Return ranges (..., 1) of world points (..., 3), and which lie within the limits."""
        y = np.linalg.norm(points_world - self.position, axis=-1, keepdims=True) + self.range_bias
        visible = within(y, self.lower, self.upper)
        hide(y, visible)
        return np.asarray(y), visible

    def linearise(self, points_world: Floats) -> tuple[Floats, Floats, Mask]:
        """Return ranges, their Jacobian (..., 1, 3): unit vectors to the points, and the mask."""
        away = points_world - self.position
        distance = np.linalg.norm(away, axis=-1, keepdims=True)
        y = distance + self.range_bias
        J = (away / np.maximum(distance, np.finfo(np.float64).tiny))[..., None, :]
        visible = within(y, self.lower, self.upper)
        hide(y, visible, J)
        return np.asarray(y), np.asarray(J), visible

    def towards(self, points_world: Floats) -> Floats:
        """Return vectors (..., 3) from world points (..., 3) to the lateration source."""
        return np.asarray(self.position - points_world)

    def rays(self, y: Floats) -> None:
        """Return None: a range defines a sphere, not a line."""
        return

    def moved(self, motion: Floats) -> Self:
        """Return a sensor whose ranges of points x are this one's of ``motion @ x``."""
        # distances are the same if the source moves back instead of the points moving
        return replace(self, position=motion[:3, :3].T @ (self.position - motion[:3, 3]))
