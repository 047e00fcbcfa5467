"""Estimates as the plain, finite numbers that text formats hold."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from mixpose.records import Estimate, Floats


def plain(values: ArrayLike) -> Any:
    """Nested lists of floats (or one float) without negative zeros; any shape."""
    # -0.0 + 0.0 is 0.0: equal poses are equal bytes.
    return (np.asarray(values, dtype=np.float64) + 0.0).tolist()


def plain_or_none(values: ArrayLike | None) -> Any:
    """`plain`, with None left as None."""
    return None if values is None else plain(values)


def pose_of(estimate: Estimate) -> Floats | None:
    """T_world_object (4, 4) of an estimate; None for a lost frame."""
    return None if estimate.status == "lost" else estimate.T_world_object


def require_finite(estimate: Estimate) -> None:
    """Refuse an estimate that holds a NaN or an infinity.

    Raises ValueError naming frame and field.  No format has a place for such values, and an
    estimate that holds one is a fault of the program, not of its user.
    """
    values: dict[str, Floats | float | None] = {
        "time_s": estimate.time_s,
        "T_world_object": estimate.T_world_object,
        "covariance": estimate.covariance,
        "score": estimate.score,
        "confidence": estimate.confidence,
        "latency_ms": estimate.latency_ms,
    }
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
        return math.isfinite(value)  # ten times as fast as NumPy on one number
    return bool(np.isfinite(value).all())
