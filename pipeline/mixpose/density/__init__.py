"""Densities g_l of where features are: blur, normalisation, windows, levels of blur."""

from __future__ import annotations

from mixpose.density.atlas import Atlas
from mixpose.density.blur import render
from mixpose.density.grid import FAR, FLOOR, Density, Window
from mixpose.density.mixture import FEW, Mixture
from mixpose.density.observation import STEPS_PER_SIGMA, TILE_REACH, Observation
from mixpose.density.overlap import close_pairs, peak, self_overlap
from mixpose.density.weighting import weighted

__all__ = [
    "FAR",
    "FEW",
    "FLOOR",
    "STEPS_PER_SIGMA",
    "TILE_REACH",
    "Atlas",
    "Density",
    "Mixture",
    "Observation",
    "Window",
    "close_pairs",
    "peak",
    "render",
    "self_overlap",
    "weighted",
]
