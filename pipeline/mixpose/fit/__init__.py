"""Fit: a pose near a start, through narrowing blurs."""

from __future__ import annotations

from mixpose.fit.blur_schedule import ScheduleRules, blur_schedule
from mixpose.fit.near import Climbed, Fit, FitRules, fit_near, fit_together
from mixpose.fit.options import EstimatorOptions, SearchName, free_mask

__all__ = [
    "Climbed",
    "EstimatorOptions",
    "Fit",
    "FitRules",
    "ScheduleRules",
    "SearchName",
    "blur_schedule",
    "fit_near",
    "fit_together",
    "free_mask",
]
