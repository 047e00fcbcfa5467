"""Densities g_l of where features are: blur, normalisation, windows, tiles, levels of blur."""

from __future__ import annotations

from mixpose.density.atlas import Atlas
from mixpose.density.blur import render
from mixpose.density.extraction_error import (
    ErrorRules,
    Noise,
    Offsets,
    Seen,
    errors_seen,
    log_likelihood,
    pooled,
    sums_of,
)
from mixpose.density.features_met import (
    AssociationRules,
    FeaturesMet,
    crowding,
    features_met,
    surplus,
)
from mixpose.density.grid import FAR, Density, Window
from mixpose.density.observation import Observation, matched_atlas
from mixpose.density.overlap import close_pairs, peak, self_overlap
from mixpose.density.rules import DRAWING, DrawingRules

__all__ = [
    "DRAWING",
    "FAR",
    "AssociationRules",
    "Atlas",
    "Density",
    "DrawingRules",
    "ErrorRules",
    "FeaturesMet",
    "Noise",
    "Observation",
    "Offsets",
    "Seen",
    "Window",
    "close_pairs",
    "crowding",
    "errors_seen",
    "features_met",
    "log_likelihood",
    "matched_atlas",
    "peak",
    "pooled",
    "render",
    "self_overlap",
    "sums_of",
    "surplus",
]
