"""Estimation: annealed descent near a start, judgement of the result, tracking."""

from __future__ import annotations

from mixpose.estimation.accuracy import expected_covariance
from mixpose.estimation.assessment import Assessment, assess
from mixpose.estimation.expectation import Encounter, Expectation
from mixpose.estimation.local import Fit, fit_near, free_mask
from mixpose.estimation.options import EstimatorOptions
from mixpose.estimation.single import estimate_pose
from mixpose.estimation.track import Track, predict
from mixpose.estimation.tracker import Tracker

__all__ = [
    "Assessment",
    "Encounter",
    "EstimatorOptions",
    "Expectation",
    "Fit",
    "Track",
    "Tracker",
    "assess",
    "estimate_pose",
    "expected_covariance",
    "fit_near",
    "free_mask",
    "predict",
]
