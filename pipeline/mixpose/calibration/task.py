"""What is to be calibrated, from what."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from mixpose.body import Body
from mixpose.calibration.alone import Hypotheses
from mixpose.calibration.frames import SeenFrame
from mixpose.calibration.rig import Kind, Rig
from mixpose.records import Floats
from mixpose.sensors import CalibrationError, CloudSensor

Progress = Callable[[str, int, int], None]
"""Called with a stage, how much of it is done, and of how much."""


def silent(stage: str, done: int, total: int) -> None:
    """Progress that nobody watches."""


@dataclass(frozen=True, eq=False)
class Task:
    """A calibration to be made."""

    rig: Rig  # as it is believed to be
    body: Body
    frames: tuple[SeenFrame, ...]
    sigmas: Floats  # (L,): σ_ε by sensor
    free: Mapping[int, tuple[Kind, ...]]  # free parameters by sensor
    body_free: bool = False  # whether marker coordinates are free
    # (6,): world directions of the body's poses that are not known
    pose_free: NDArray[np.bool_] = field(default_factory=lambda: np.ones(6, dtype=np.bool_))
    T_held: Floats | None = None  # (4, 4): where the other directions stay
    # (float or None, float or None): half-widths in degrees and length of where the body is about
    # `T_held`
    around: tuple[float | None, float | None] = (None, None)
    # whether a frame's pose tells of the next one's where sensors alone tell little
    fuse: bool = True
    # (4, 4) each: poses of the body by frame number, where they are known
    known: Mapping[int, Floats] | None = None
    # (int, int): sensors whose distance is known, and right in `rig`
    length: tuple[int, int] | None = None
    # by sensor, how far what is held of it may be off
    errors: Mapping[int, CalibrationError] = field(default_factory=dict)

    @property
    def cameras(self) -> tuple[int, ...]:
        """Sensors that know a pose alone."""
        alone = [
            hasattr(one, "camera_matrix") or isinstance(one, CloudSensor)
            for one in self.rig.sensors
        ]
        return tuple(np.flatnonzero(alone).tolist())

    @property
    def times_matter(self) -> bool:
        """Whether sensors look at other moments than the frames' common times."""
        kinds = {kind for each in self.free.values() for kind in each}
        late = any(
            frame.time_s is not None and abs(time - frame.time_s) > 1e-9
            for frame in self.frames
            for time in frame.times.values()
        )
        return late or bool(kinds & {"delay", "drift"}) or bool(self.rig.delays.any())


Known = Mapping[tuple[int, int], Hypotheses]
"""Hypotheses of single sensors, by frame number and sensor."""
