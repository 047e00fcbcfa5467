"""Fit: a pose near a start, through narrowing blurs."""

from __future__ import annotations

from mixpose.fit.near import (
    Fit as Fit,
    blur_schedule as blur_schedule,
    fit_near as fit_near,
    fit_together as fit_together,
)
from mixpose.fit.options import (
    EstimatorOptions as EstimatorOptions,
    FitRules as FitRules,
    SearchName as SearchName,
    free_mask as free_mask,
)
