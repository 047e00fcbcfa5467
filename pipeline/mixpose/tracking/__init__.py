"""Tracking: propose, fit, judge, decide, follow, from frame to frame."""

from __future__ import annotations

from mixpose.body import ASIDE
from mixpose.tracking.gating import Expectation, are_as_good, have_fewer, is_convincing
from mixpose.tracking.in_motion import UNKNOWN_S
from mixpose.tracking.rules import Rules
from mixpose.tracking.track import Companion, Prediction, Track, predict
from mixpose.tracking.tracker import Tracker, estimate_pose

__all__ = [
    "ASIDE",
    "UNKNOWN_S",
    "Companion",
    "Expectation",
    "Prediction",
    "Rules",
    "Track",
    "Tracker",
    "are_as_good",
    "estimate_pose",
    "have_fewer",
    "is_convincing",
    "predict",
]
