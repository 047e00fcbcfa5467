"""What the sensors saw, frame by frame, as a calibration takes it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from mixpose.records import Floats


@dataclass(frozen=True, eq=False)
class SeenFrame:
    """Detections of one frame.

    Attributes
    ----------
    number : int
    time_s : float or None
        Common time of the frame.
    points : mapping of int to (M, m) float64
        Detections by sensor.
    times : mapping of int to float
        When each sensor says that it took the frame.
    """

    number: int
    time_s: float | None
    points: Mapping[int, Floats]
    times: Mapping[int, float]
