"""What planned systems will achieve: predicted accuracy, confirmed by simulation, and advice."""

from __future__ import annotations

from mixpose.design.advice import (
    MarkerMove,
    NewSensor,
    best_marker_move,
    best_new_sensor,
    noise_to_equal,
)
from mixpose.design.confirmation import Confirmation, confirm
from mixpose.design.poses import spread_poses
from mixpose.design.prediction import Plan, Prediction, Summary, plan_of, predict, summarise
from mixpose.design.study import Request, Study, study

__all__ = [
    "Confirmation",
    "MarkerMove",
    "NewSensor",
    "Plan",
    "Prediction",
    "Request",
    "Study",
    "Summary",
    "best_marker_move",
    "best_new_sensor",
    "confirm",
    "noise_to_equal",
    "plan_of",
    "predict",
    "spread_poses",
    "study",
    "summarise",
]
