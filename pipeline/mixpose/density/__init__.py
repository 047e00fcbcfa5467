"""Densities g_l of where features are: blur, normalisation, windows, pages, levels of blur."""

from __future__ import annotations

from mixpose.density.atlas import Atlas
from mixpose.density.blur import render
from mixpose.density.features_met import AssociationRules, crowding, features_met, surplus
from mixpose.density.grid import FAR, FLOOR, Density, Window
from mixpose.density.observation import Observation, matched_atlas
from mixpose.density.overlap import close_pairs, peak, self_overlap
from mixpose.density.weighting import weighted

__all__ = [
    "FAR",
    "FLOOR",
    "AssociationRules",
    "Atlas",
    "Density",
    "Observation",
    "Window",
    "close_pairs",
    "crowding",
    "features_met",
    "matched_atlas",
    "peak",
    "render",
    "self_overlap",
    "surplus",
    "weighted",
]
