"""Densities g_l of where features are: blur, normalisation, windows, tiles, levels of blur."""

from __future__ import annotations

from mixpose.density.atlas import Atlas
from mixpose.density.blur import render
from mixpose.density.grid import FAR, FLOOR, Density, Window
from mixpose.density.observation import MOST_SIGMAS, Observation, matched_atlas
from mixpose.density.overlap import close_pairs, peak, self_overlap

__all__ = [
    "FAR",
    "FLOOR",
    "MOST_SIGMAS",
    "Atlas",
    "Density",
    "Observation",
    "Window",
    "close_pairs",
    "matched_atlas",
    "peak",
    "render",
    "self_overlap",
]
