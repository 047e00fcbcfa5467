"""Fit: a pose near a start, through narrowing blurs."""

from mixpose.fit.near import (
    EstimatorOptions as EstimatorOptions,
    Fit as Fit,
    FitRules as FitRules,
    SearchName as SearchName,
    blur_schedule as blur_schedule,
    fit_near as fit_near,
    fit_together as fit_together,
    free_mask as free_mask,
)
