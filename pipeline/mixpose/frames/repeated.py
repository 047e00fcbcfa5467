"""Frames that show the same as the one before: a sensor that is frozen, or frames doubled."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from mixpose.records import PointPattern, RawFrame

_PIXELS = 37  # of an image every so many are compared first


def shown_by(frame: RawFrame) -> NDArray[Any] | None:
    """The image of a frame, or its detections; None of another pattern."""
    if isinstance(frame.data, PointPattern):
        return frame.data.points
    return frame.data if isinstance(frame.data, np.ndarray) else None


def is_same(before: NDArray[Any] | None, now: NDArray[Any]) -> bool:
    """Whether two frames show the same, to the last digit; noise never does."""
    if before is None or before.shape != now.shape:
        return False
    few = np.array_equal(before[::_PIXELS, ::_PIXELS], now[::_PIXELS, ::_PIXELS])
    return few and bool(np.array_equal(before, now))
