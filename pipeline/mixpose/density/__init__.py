"""Densities g_l of features: blur, normalisation, windows, tiles, levels of blur."""

from mixpose.density.atlas import Atlas as Atlas, remap as remap
from mixpose.density.blur import DRAWING as DRAWING
from mixpose.density.observation import (
    Density as Density,
    Observation as Observation,
    Window as Window,
    all_pairs as all_pairs,
    close_pairs as close_pairs,
    matched_atlas as matched_atlas,
    nearest_of as nearest_of,
    pairs_by_picture as pairs_by_picture,
    peak as peak,
    render as render,
    self_overlap as self_overlap,
)
