"""The task of a calibration: rig, frames, and the parameters that are free."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from mixpose.calibration.rig import Kind, Rig
from mixpose.records import Floats, Mask
from mixpose.sensors import CalibrationError, CloudSensor

Progress = Callable[[str, int, int], None]
"""Called with the name of a stage, the steps done, and the steps in all."""


def silent(stage: str, done: int, total: int) -> None:
    """Ignore progress."""


@dataclass(frozen=True, eq=False)
class SeenFrame:
    """Detections of one frame."""

    number: int
    time_s: float | None  # common time of the frame
    points: Mapping[int, Floats]  # detections (M, m) by sensor
    times: Mapping[int, float]  # time stamps by sensor, seconds

    def without(self, sensors: Collection[int]) -> SeenFrame:
        """Return the frame without the detections of some sensors."""
        return replace(self, points={s: y for s, y in self.points.items() if s not in sensors})


@dataclass(frozen=True, eq=False)
class Hypotheses:
    """Poses that explain the detections of one sensor."""

    poses: Floats  # (H, 4, 4): T_sensor_object, most evident first; empty if none is convincing
    evidence: Floats  # (H,): log-odds against clutter


NOTHING = Hypotheses(np.zeros((0, 4, 4)), np.zeros(0))
Known = dict[tuple[int, int], Hypotheses]
"""Hypotheses of single sensors, by frame number and sensor."""


@dataclass(frozen=True, eq=False)
class Task:
    """A calibration to be made."""

    rig: Rig  # as the session has it
    frames: tuple[SeenFrame, ...]
    sigmas: Floats  # (L,): σ_ε by sensor
    free: Mapping[int, tuple[Kind, ...]]  # free parameters by sensor
    body_free: bool = False  # whether marker coordinates are free
    # (6,): world directions in which the body's poses are free
    pose_free: Mask = field(default_factory=lambda: np.ones(6, dtype=np.bool_))
    T_held: Floats | None = None  # (4, 4): pose whose other directions are held
    # largest turn in degrees and distance of the body from `T_held`
    around: tuple[float | None, float | None] = (None, None)
    fuse: bool = True  # whether the previous pose is a prior of the next one
    known: Mapping[int, Floats] | None = None  # known poses by frame number
    length: tuple[int, int] | None = None  # sensors whose distance is known
    errors: Mapping[int, CalibrationError] = field(default_factory=dict)  # of held parameters

    @property
    def cameras(self) -> tuple[int, ...]:
        """Return the sensors that determine a pose by themselves."""
        return tuple(
            k
            for k, sensor in enumerate(self.rig.sensors)
            if hasattr(sensor, "camera_matrix") or isinstance(sensor, CloudSensor)
        )

    @property
    def times_matter(self) -> bool:
        """Test whether sensors take frames at other moments than the frames' common times."""
        free = {kind for kinds in self.free.values() for kind in kinds}
        late = any(
            frame.time_s is not None and abs(time - frame.time_s) > 1e-9
            for frame in self.frames
            for time in frame.times.values()
        )
        return late or bool(free & {"delay", "drift"}) or self.rig.is_late
