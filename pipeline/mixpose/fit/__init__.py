"""Fit: a pose near a start, through narrowing blurs."""

from mixpose.fit.near import (
    EstimatorOptions as EstimatorOptions,
    Fit as Fit,
    SearchName as SearchName,
    blur_schedule as blur_schedule,
    blurs_by_view as blurs_by_view,
    fit_near as fit_near,
    fit_together as fit_together,
    free_mask as free_mask,
    narrowing as narrowing,
    widest_blurs as widest_blurs,
)
from mixpose.fit.probable import FitRules as FitRules
