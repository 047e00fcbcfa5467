"""What the sensors saw, frame by frame, as a calibration takes it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from mixpose.records import Floats


@dataclass(frozen=True, eq=False)
class SeenFrame:
    """Detections of one frame."""

    number: int
    time_s: float | None  # common time of the frame
    points: Mapping[int, Floats]  # (M, m) each: detections by sensor
    times: Mapping[int, float]  # when each sensor says that it took the frame
