"""Provide the base of pose writers: plain, finite numbers, and times for formats with times."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from typing import Any, TextIO

import numpy as np
from numpy.typing import ArrayLike

from mixpose.errors import RecordingError
from mixpose.poses.header import Header
from mixpose.records import Estimate, Floats

NO_TIMES = "# time is the frame number: the recording has no times"


class PoseWriter(ABC):
    """Writes estimates to a text stream as they come; the stream stays open."""

    _has_times: bool | None = None  # the first frame decides

    def __init__(self, stream: TextIO, header: Header, first_line: str = "") -> None:
        self._stream, self._header = stream, header
        if first_line:
            self._stream.write(f"{first_line}\n")
            self._stream.flush()

    def write(self, estimate: Estimate) -> None:
        """Write a frame and flush it; raises ValueError if a number is not finite."""
        require_finite(estimate)
        self._write(estimate)
        self._stream.flush()

    def close(self) -> None:
        """Write what is pending and flush."""
        self._stream.flush()

    @abstractmethod
    def _write(self, estimate: Estimate) -> None:
        """Write a frame."""

    def _time_of(self, estimate: Estimate, format_name: str) -> float:
        """Return the time in s, or the frame number; RecordingError if earlier frames differ."""
        has_time = estimate.time_s is not None
        if self._has_times is None and not has_time:
            self._stream.write(f"{NO_TIMES}\n")
        if self._has_times not in (None, has_time):
            text = "a time" if has_time else "no time"
            raise RecordingError(
                f"frame {estimate.frame} has {text}, unlike the frames before it: format "
                f"{format_name!r} needs times for all frames or for none; give the sensors times, "
                "or write jsonl"
            )
        self._has_times = has_time
        return float(plain(estimate.frame if estimate.time_s is None else estimate.time_s))


def plain(values: ArrayLike | None) -> Any:
    """Convert to nested lists of floats, or a float, without negative zeros; None stays None."""
    if values is None:
        return None
    # -0.0 + 0.0 is 0.0, so that equal poses are equal bytes
    return (np.asarray(values, dtype=np.float64) + 0.0).tolist()


def pose_of(estimate: Estimate) -> Floats | None:
    """Return T_world_object (4, 4) of an estimate; None for a lost frame."""
    return None if estimate.status == "lost" else estimate.T_world_object


def require_finite(estimate: Estimate) -> None:
    """Raise a ValueError, with frame and field, for a NaN or an infinity: a fault of mixpose."""
    names = ("time_s", "T_world_object", "covariance", "score", "confidence", "latency_ms")
    values: dict[str, Floats | float | None] = {name: getattr(estimate, name) for name in names}
    for name, report in estimate.sensors.items():
        values[f"sensors.{name}.explained"] = report.explained
        values[f"sensors.{name}.rms"] = report.rms
    for rank, rival in enumerate(estimate.hypotheses):
        values[f"hypotheses.{rank}.T_world_object"] = rival.T_world_object
        values[f"hypotheses.{rank}.weight"] = rival.weight
    for field, value in values.items():
        if value is not None and not _is_finite(value):
            raise ValueError(f"frame {estimate.frame}: {field} is not finite")


def _is_finite(value: Floats | float) -> bool:
    if not isinstance(value, np.ndarray):
        return math.isfinite(value)  # ten times as fast as NumPy for a single number
    return bool(np.isfinite(value).all())
