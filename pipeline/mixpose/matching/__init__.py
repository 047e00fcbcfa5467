"""Matching: the detections that meet features, and the size of their errors."""

from mixpose.matching.associate import (
    AssociationRules as AssociationRules,
    associate as associate,
    crowding as crowding,
    owners_of as owners_of,
)
from mixpose.matching.matches import (
    LEAST_VARIANCE as LEAST_VARIANCE,
    ErrorRules as ErrorRules,
    Matches as Matches,
    NoiseEstimate as NoiseEstimate,
    errors_seen as errors_seen,
    log_likelihood as log_likelihood,
    pooled as pooled,
    residual_ratio as residual_ratio,
    welsch as welsch,
)
