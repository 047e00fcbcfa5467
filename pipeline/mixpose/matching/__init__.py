"""Matching: which feature is met by which detection, and how large their errors are."""

from __future__ import annotations

from mixpose.matching.associate import associate
from mixpose.matching.detections import crowding
from mixpose.matching.errors import (
    ErrorRules,
    Noise,
    NoiseEstimate,
    errors_seen,
    log_likelihood,
    pooled,
)
from mixpose.matching.matches import Matches
from mixpose.matching.rules import AssociationRules

__all__ = [
    "AssociationRules",
    "ErrorRules",
    "Matches",
    "Noise",
    "NoiseEstimate",
    "associate",
    "crowding",
    "errors_seen",
    "log_likelihood",
    "pooled",
]
