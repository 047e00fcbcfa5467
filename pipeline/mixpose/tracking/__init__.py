"""Tracking: propose, fit, judge, decide, follow, from frame to frame."""

from __future__ import annotations

from mixpose.body import ASIDE
from mixpose.tracking.gating import (
    Expectation,
    WindowedScene,
    are_as_good,
    have_fewer,
    is_convincing,
)
from mixpose.tracking.rules import Rules, SceneRules
from mixpose.tracking.scene import Outcome, Scene
from mixpose.tracking.track import UNKNOWN_S, Companion, Prediction, Track, predict
from mixpose.tracking.tracked_body import TrackedBody
from mixpose.tracking.tracker import Tracker, estimate_pose

__all__ = [
    "ASIDE",
    "UNKNOWN_S",
    "Companion",
    "Expectation",
    "Outcome",
    "Prediction",
    "Rules",
    "Scene",
    "SceneRules",
    "Track",
    "TrackedBody",
    "Tracker",
    "WindowedScene",
    "are_as_good",
    "estimate_pose",
    "have_fewer",
    "is_convincing",
    "predict",
]
