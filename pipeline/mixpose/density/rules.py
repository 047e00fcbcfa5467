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
    cut: float = constant(5.0, "standard deviations at which sums end: the tail holds 6e-7")
    paper_reach: float = constant(
        4.0, "margin of a window around the predicted samples, in standard deviations"
    )
    negligible: float = constant(
        16.0, "exponent at which two features do not overlap: 1e-7, as single precision rounds"
    )
    hat: float = constant(0.3, "of a grid's step: a narrower blur is linear interpolation")
    least_value: float = constant(
        1e-30, "of a grid: what is normalised by less overflows in single precision"
    )
    nearest: float = constant(
        0.9, "radii by distance from a sensor, the most that a sphere is taken to have"
    )
    tile: int = constant(
        24,
        "cells along the part of a tile that is looked up: half of its six standard deviations is "
        "as far as a fit moves; larger ones are drawn for little use",
    )
    grid_tile: int = constant(18, "the same of grey values alone, at least")
    own_tiles: int = constant(
        1200,
        "places that have tiles of their own: with 600 features in two cameras a fit takes two "
        "thirds of what it takes on pages",
    )
    window_cells: int = constant(1_500_000, "of a dense window; a larger one gets coarser")
    pages: int = constant(
        250_000,
        "of a sensor's plane; detections that are too far from their middle for it are left out, "
        "and pages of grey values are larger",
    )
    widest: float = constant(
        4000.0, "extent of features over the narrowest blur: so many a plane's pages hold"
    )
    side: int = constant(32000, "of an array and of maps: cv2.remap takes less than 32767")
    exact_channels: tuple[int, ...] = constant(
        (1, 3, 4), "that cv2.remap of OpenCV 5 looks up exactly; others to 1/32 of a cell"
    )
    few: int = constant(48, "points up to which all pairs at once are faster than neighbours")
    few_pairs: int = constant(5000, "of tiles and detections: all are faster than sorting")
    tiles_at_once: int = constant(
        64, "that are drawn together: they have room for as many detections each"
    )
    pages_at_once: int = constant(
        400, "that are drawn together: what is made for them stays in the cache"
    )
    held: int = constant(2**18, "samples, or pairs of features, that are held in memory at once")

    @property
    def overlap(self) -> float:
        """Standard deviations beyond which two features do not overlap."""
        return math.sqrt(2 * self.negligible)

    @property
    def far(self) -> float:
        """An index outside any array, of which cv2.remap can still tell 32 parts as integers."""
        return -32.0 * self.side


DRAWING = DrawingRules()
