"""Detect repeated frames: of a frozen sensor, or doubled ones."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from mixpose.records import PointPattern, RawFrame

_STRIDE = 37  # every 37th row and column of an image are compared first


def shown_by(frame: RawFrame) -> NDArray[Any] | None:
    """Return the image of a frame, or its detections; None for another pattern."""
    if isinstance(frame.data, PointPattern):
        return frame.data.points
    return frame.data if isinstance(frame.data, np.ndarray) else None


def is_same(before: NDArray[Any] | None, now: NDArray[Any]) -> bool:
    """Test whether two frames are equal to the last digit; with noise they never are."""
    if before is None or before.shape != now.shape:
        return False
    few = np.array_equal(before[::_STRIDE, ::_STRIDE], now[::_STRIDE, ::_STRIDE])
    return few and bool(np.array_equal(before, now))
