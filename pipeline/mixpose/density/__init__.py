"""Densities g_l of where features are: blur, normalisation, windows, tiles, levels of blur."""

from __future__ import annotations

from mixpose.density.atlas import Atlas
from mixpose.density.blur import render
from mixpose.density.grid import FAR, Density, Window
from mixpose.density.observation import Observation, matched_atlas
from mixpose.density.overlap import close_pairs, peak, self_overlap
from mixpose.density.rules import DRAWING, DrawingRules

__all__ = [
    "DRAWING",
    "FAR",
    "Atlas",
    "Density",
    "DrawingRules",
    "Observation",
    "Window",
    "close_pairs",
    "matched_atlas",
    "peak",
    "render",
    "self_overlap",
]
