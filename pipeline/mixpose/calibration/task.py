"""What is to be calibrated, from what."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from mixpose.calibration.rig import Kind, Rig
from mixpose.records import Floats, Mask
from mixpose.sensors import CalibrationError, CloudSensor

Progress = Callable[[str, int, int], None]
"""Called with a stage, how much of it is done, and of how much."""


def silent(stage: str, done: int, total: int) -> None:
    """Progress that nobody watches."""


@dataclass(frozen=True, eq=False)
class SeenFrame:
    """Detections of one frame."""

    number: int
    time_s: float | None  # common time of the frame
    points: Mapping[int, Floats]  # detections (M, m) by sensor
    times: Mapping[int, float]  # when each sensor says that it took the frame

    def without(self, sensors: Collection[int]) -> SeenFrame:
        """The frame without what some sensors saw."""
        return replace(self, points={s: y for s, y in self.points.items() if s not in sensors})


@dataclass(frozen=True, eq=False)
class Hypotheses:
    """Poses that explain what one sensor saw."""

    poses: Floats  # (H, 4, 4): T_sensor_object, most evident first; none where nothing convinces
    evidence: Floats  # (H,): log-odds against clutter


NOTHING = Hypotheses(np.zeros((0, 4, 4)), np.zeros(0))
Known = dict[tuple[int, int], Hypotheses]
"""Hypotheses of single sensors, by frame number and sensor."""


@dataclass(frozen=True, eq=False)
class Task:
    """A calibration to be made."""

    rig: Rig  # as it is believed to be
    frames: tuple[SeenFrame, ...]
    sigmas: Floats  # (L,): σ_ε by sensor
    free: Mapping[int, tuple[Kind, ...]]  # free parameters by sensor
    body_free: bool = False  # whether marker coordinates are free
    # (6,): world directions of the body's poses that are not known
    pose_free: Mask = field(default_factory=lambda: np.ones(6, dtype=np.bool_))
    T_held: Floats | None = None  # (4, 4): where the other directions stay
    # half-widths in degrees and length of where the body is about `T_held`
    around: tuple[float | None, float | None] = (None, None)
    fuse: bool = True  # whether a frame's pose tells of the next one's
    known: Mapping[int, Floats] | None = None  # poses by frame number, where they are known
    length: tuple[int, int] | None = None  # sensors whose distance is known
    errors: Mapping[int, CalibrationError] = field(default_factory=dict)  # of what is held

    @property
    def cameras(self) -> tuple[int, ...]:
        """Sensors that know a pose alone."""
        return tuple(
            k
            for k, one in enumerate(self.rig.sensors)
            if hasattr(one, "camera_matrix") or isinstance(one, CloudSensor)
        )

    @property
    def times_matter(self) -> bool:
        """Whether sensors look at other moments than the frames' common times."""
        kinds = {kind for each in self.free.values() for kind in each}
        late = any(
            frame.time_s is not None and abs(time - frame.time_s) > 1e-9
            for frame in self.frames
            for time in frame.times.values()
        )
        return late or bool(kinds & {"delay", "drift"}) or self.rig.is_late
