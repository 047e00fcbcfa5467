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
    """A calibration to be made.

    Attributes
    ----------
    rig : Rig
        As it is believed to be.
    body : Body
    frames : tuple of SeenFrame
    sigmas : (L,) float64
        σ_ε by sensor.
    free : mapping of int to tuple of kinds
        Free parameters by sensor.
    body_free : bool
        Whether marker coordinates are free.
    pose_free : (6,) bool
        World directions of the body's poses that are not known.
    T_held : (4, 4) float64 or None
        Where the other directions stay.
    around : (float or None, float or None)
        Half-widths in degrees and length of where the body is about `T_held`.
    fuse : bool
        Whether a frame's pose tells of the next one's where sensors alone tell little.
    known : mapping of int to (4, 4) float64, or None
        Poses of the body by frame number, where they are known.
    length : (int, int) or None
        Sensors whose distance is known, and right in `rig`.
    errors : mapping of int to CalibrationError
        By sensor, how far what is held of it may be off.
    """

    rig: Rig
    body: Body
    frames: tuple[SeenFrame, ...]
    sigmas: Floats
    free: Mapping[int, tuple[Kind, ...]]
    body_free: bool = False
    pose_free: NDArray[np.bool_] = field(default_factory=lambda: np.ones(6, dtype=np.bool_))
    T_held: Floats | None = None
    around: tuple[float | None, float | None] = (None, None)
    fuse: bool = True
    known: Mapping[int, Floats] | None = None
    length: tuple[int, int] | None = None
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
