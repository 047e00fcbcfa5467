"""How finely densities are drawn, how far they reach, and how much of them at once."""

from __future__ import annotations

import math
from dataclasses import dataclass

from mixpose.constants import constant


@dataclass(frozen=True)
class DrawingRules:
    """Lengths are in standard deviations of a feature, and in cells of an array."""

    steps_per_sigma: float = constant(
        4.0,
        "cells per standard deviation: places are 4e-4 standard deviations off at most, a part of "
        "what the best centres of blobs err by",
    )
    fine_steps: float = constant(
        48.0,
        "the same for grey values, which have no detection noise, at σ_ε: 2e-7 standard deviations",
    )
    reach: float = constant(
        4.25,
        "standard deviations around a detection that an atlas draws: features farther apart draw "
        "each other by less than 1e-3 σ_ε",
    )
    paper_reach: float = constant(
        4.0, "margin of a window around the predicted samples, in standard deviations"
    )
    cut: float = constant(5.0, "standard deviations at which sums end: the tail holds 6e-7")
    negligible: float = constant(
        16.0, "exponent at which two features do not overlap: 1e-7, as single precision rounds"
    )
    tile: int = constant(
        24,
        "cells along the part of a tile that is looked up, at least: half of its six standard "
        "deviations is as far as a fit moves; larger ones are drawn for little use",
    )
    own_tiles: int = constant(
        1200,
        "places that have tiles of their own: with 600 features in two cameras a fit takes two "
        "thirds of what it takes on pages",
    )
    window_cells: int = constant(1_500_000, "of a dense window; a larger one gets coarser")
    side: int = constant(32000, "of an array and of maps: cv2.remap takes less than 32767")
    exact_channels: tuple[int, ...] = constant(
        (1, 3, 4), "that cv2.remap of OpenCV 5 looks up exactly; others to 1/32 of a cell"
    )
    few_pairs: int = constant(
        64**2, "of points, or of tiles and detections: all at once are faster than neighbours"
    )
    held: int = constant(
        2**18,
        "samples, pairs of features, cells of tiles that are drawn together, or pages of a plane "
        "that are held at once; farther detections are left out, pages of grey values are larger",
    )

    @property
    def widest(self) -> float:
        """Extent of features over the narrowest blur that the pages of a plane hold."""
        return math.sqrt(2 * self.held) * self.tile / self.steps_per_sigma

    @property
    def far(self) -> float:
        """An index outside any array, of which cv2.remap can still tell 32 parts as integers."""
        return -32.0 * self.side


DRAWING = DrawingRules()
