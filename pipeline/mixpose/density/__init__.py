"""Densities g_l of where features are: blur, normalisation, windows, tiles, levels of blur."""

from mixpose.density.atlas import Atlas as Atlas
from mixpose.density.grid import (
    FAR as FAR,
    Density as Density,
    Window as Window,
    remap as remap,
    render as render,
)
from mixpose.density.observation import (
    Observation as Observation,
    all_pairs as all_pairs,
    close_pairs as close_pairs,
    matched_atlas as matched_atlas,
    peak as peak,
    self_overlap as self_overlap,
)
from mixpose.density.rules import DRAWING as DRAWING
