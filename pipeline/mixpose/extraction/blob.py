"""The record of a blob, the rules for blobs, and the errors of their centres."""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from mixpose.constants import constant
from mixpose.extraction.ellipse import Rim
from mixpose.extraction.shape import excess_lengths
from mixpose.records import Floats


@dataclass(frozen=True)
class BlobRules:
    """Rules for blobs and the errors of their centres."""

    small_area: float = constant(
        100.0, "px up to which the centroid of grey values is the better centre; above, the rim"
    )
    solidity: float = constant(
        0.9, "share of its convex hull that a blob without an elliptical rim must fill"
    )
    waist: float = constant(1.0, "px that the waist between two blobs is below the hull")
    step: int = constant(3, "px, width of the two rings whose difference is the step at an outline")
    level_ratio: float = constant(
        1.4, "from level to level at which a region without a shape is searched again"
    )
    core_ratio: float = constant(
        3.0, "peak by median from which the core may be the feature, and the region lit by it"
    )
    large: float = constant(20.0, "px: radius from which the visible part of a rim locates a disk")
    whole: float = constant(0.97, "share of the rim that is visible of whole disks")
    exact: float = constant(2.0, "times the usual residual of rims, up to which disks are whole")
    rough: float = constant(0.9, "by radius^1.5 in px: change of the length by pixels, in 1 %")
    off_centre: float = constant(1.5, "radii per length by width beyond 1, of a cut disk, in 68 %")
    alike: int = constant(3, "others of one size, length and direction: hardly so many by chance")
    by_rim: float = constant(0.3, "error of a centre by the visible rim, over that by grey values")
    beside: float = constant(2.0, "px that grey values reach beyond a rim: optics blur it")
    usual: float = constant(3.0, "times the lower quartile, beyond which errors show a cut: 4 %")
    finest: float = constant(0.01, "px, the least of this quartile: pixels alone make as much")


BLOBS = BlobRules()


class Blob(NamedTuple):
    """One blob: centre in pixels of the window, area in px, and the rim of a disk."""

    u: float
    v: float
    area: float
    length: float = 1.0  # length by width
    direction: float = 0.0  # of its length, radians from the rows
    rim: Rim | None = None
    error: float | None = None  # px, of its centre, where grey values show it
    has_core: bool = False  # whether something on it is far brighter: features or a highlight
    size: float | None = None  # area in px at half of its height, without a rim


def usual_error(blobs: Sequence[Blob]) -> float:
    """Return the lower quartile of the centres' errors, px: that of whole blobs by noise."""
    errors = sorted([blob.error for blob in blobs if blob.error is not None])
    return max(errors[(len(errors) - 1) // 4] if errors else 0.0, BLOBS.finest)


def deviations_of(blobs: Sequence[Blob], usual: float) -> Floats:
    """Estimate by how much more than others the centres of cut blobs may err, px (M,).

    A disk that is partly hidden or merged is longer than wide by as much as its centre is off, in
    radii.  Oblique disks and streaks are long too, but several are alike, and their rims whole.
    Where little is hidden, grey values show an error beyond that of noise.
    """
    if not blobs:
        return np.zeros(0)
    table = np.array([(*blob[2:5], blob.error or 0.0) for blob in blobs])  # area, length, direction
    radii, lengths, errors = np.sqrt(table[:, 0] / np.pi), table[:, 1], table[:, 3]
    excess = lengths / np.sort(lengths)[(len(blobs) + 3) // 4 - 1] - 1
    # by how much a whole blob may be longer than others; a whole rim excludes a cut
    margins, shares = BLOBS.rough / radii**1.5, np.ones(len(blobs))
    rims = [(k, blob.rim) for k, blob in enumerate(blobs) if blob.rim is not None]
    residual = statistics.median_low([rim.residual for _, rim in rims]) if rims else 0.0
    for k, rim in rims:
        is_cut = rim.coverage < BLOBS.whole or rim.residual > BLOBS.exact * residual
        is_cut &= radii[k] < BLOBS.large
        margins[k], shares[k] = (0.0, BLOBS.by_rim) if is_cut else (np.inf, 1.0)
    if np.count_nonzero(excess > margins):  # mostly all are round
        excess = np.minimum(excess, excess_lengths(table[:, :3], BLOBS.alike))
    visible = np.where(errors > BLOBS.usual * usual, shares * errors, 0.0)
    return np.asarray(np.maximum(BLOBS.off_centre * radii * (excess - margins), visible))
