"""When a sensor sees what: frames that are late, rows that are read one after the other.

A frame's time is that at which its middle row is read, in the middle of the row's exposure.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from mixpose.records import Floats
from mixpose.sensors import Sensor

# The pose (4, 4) so many seconds after the common time of the frame.
PoseAfter: TypeAlias = Callable[[float], Floats]

_ROUNDS = 6  # each leaves the share of a readout in which a feature crosses a row: a thousandth
_BLUR_STEPS = 9  # positions of a moving marker whose light a frame adds up


@dataclass(frozen=True)
class Shutter:
    """The timing of a sensor."""

    late_s: float = 0.0  # seconds after the common time
    readout_s: float = 0.0  # from the first row to the last
    exposure_s: float = 0.0  # for which a row collects light
    rows: int = 0  # of an image; 0 where there are none

    @property
    def is_ideal(self) -> bool:
        """Whether all is seen at the common time."""
        return not (self.late_s or self.readout_s or self.exposure_s)

    def poses(self, sensor: Sensor, point: Floats, pose_after: PoseAfter) -> list[Floats]:
        """The poses at which a point (3,) of a body is seen, one for each part of the exposure."""
        if self.is_ideal:
            return [pose_after(0.0)]
        steps = _BLUR_STEPS if self.exposure_s else 1
        shares = (np.arange(steps) + 0.5) / steps - 0.5
        return [
            pose_after(self._moment(sensor, point, pose_after, share * self.exposure_s))
            for share in shares.tolist()
        ]

    def _moment(self, sensor: Sensor, point: Floats, pose_after: PoseAfter, within: float) -> float:
        first = moment = self.late_s + within
        if not self.readout_s:
            return moment
        for _ in range(_ROUNDS):
            T = pose_after(moment)
            y, visible = sensor.project(T[:3, :3] @ point + T[:3, 3])
            if not visible:
                break
            moment = first + self.readout_s * (float(y[1]) / (self.rows - 1) - 0.5)
        return moment
