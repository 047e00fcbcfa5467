"""The options of feature extraction."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class ExtractOptions:
    """Options of feature extraction; the keys of ``[extract]`` in a session file."""

    method: str = "blobs"  # "blobs", "corners", "intensity", "log", or the user's "module:function"
    polarity: Literal["bright", "dark"] = "bright"  # compared with the surroundings of features
    # or "otsu", "local", "li", "triangle", "sauvola", or a grey level
    threshold: str | float = "auto"
    min_area: float = 3.0  # of a blob, px
    max_area: float | None = None  # px; None for no limit
    sigma: float = 1.5  # σ_ε, standard deviation of the extraction: px, or length units of ranges
    # Standard deviation of a feature itself in grey values ("intensity") and range profiles, in
    # the unit of `sigma`; 0 if much smaller.  For "log", the width of spots in px; 0 for 3.
    spot_sigma: float = 0.0
