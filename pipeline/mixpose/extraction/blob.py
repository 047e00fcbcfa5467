"""One blob, what makes it one, and by how much its centre may err."""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from mixpose.constants import constant
from mixpose.extraction.ellipse import Rim
from mixpose.extraction.shape import longer_than_alike
from mixpose.records import Floats


@dataclass(frozen=True)
class BlobRules:
    """What a blob is."""

    small_area: float = constant(
        100.0, "px up to which the centroid of grey values is the better centre, above it the rim"
    )
    solidity: float = constant(
        0.9, "of its convex hull, that a blob without an elliptical rim fills"
    )
    waist: float = constant(1.0, "px below its hull, at least, of an outline between two")
    step: int = constant(3, "px, width of the rings between which the step at an outline is taken")
    level_ratio: float = constant(
        1.4, "by which the level is higher at which what has no shape is searched again"
    )
    core_ratio: float = constant(
        3.0, "peak by median from which a core may be the feature, the rest what it lights"
    )
    large: float = constant(20.0, "px: the radius from which what is seen of a rim locates a disk")
    whole: float = constant(0.97, "of the rim that is seen of whole disks")
    exact: float = constant(2.0, "of the usual residual of rims, up to which disks are whole")
    rough: float = constant(0.9, "by radius^1.5 in px: what pixels change the length by, in 1 %")
    off_centre: float = constant(1.5, "radii per length by width beyond 1: of a cut disk, in 68 %")
    alike: int = constant(3, "others of one size, length and direction: by chance hardly so many")
    by_rim: float = constant(0.3, "of what grey values show, that what is seen of a rim is off by")
    beside: float = constant(2.0, "px outside of a rim that its grey values reach: optics blur it")
    usual: float = constant(3.0, "of the lower quartile, beyond which grey values show a cut: 4 %")
    finest: float = constant(0.01, "px, that this is at least: pixels alone make as much")


BLOBS = BlobRules()


class Blob(NamedTuple):
    """One blob: centre in pixels of the window, area in px, and the rim of a disk."""

    u: float
    v: float
    area: float
    length: float = 1.0  # by width
    turn: float = 0.0  # of its length from the rows, radians
    rim: Rim | None = None
    off: float | None = None  # px by which its centre may be off, where its grey values tell
    carries: bool = False  # whether it has something far brighter on it: features, or a highlight
    size: float | None = None  # px at half of its height, of what has no rim


def usually_off(blobs: Sequence[Blob]) -> float:
    """By how much centres of whole blobs seem off for noise, px: the lower quartile."""
    told = sorted([blob.off for blob in blobs if blob.off is not None])
    return max(told[(len(told) - 1) // 4] if told else 0.0, BLOBS.finest)


def deviations_of(blobs: Sequence[Blob], usual: float) -> Floats:
    """By how much more than others the centres of blobs (M,) may err, px: of those that are cut.

    A disk of which something is hidden, or that is merged with something, is longer than wide by as
    much as its centre is off, in radii.  So are oblique ones and streaks, but several alike, and
    with all of a rim.  What little is hidden shows in grey values, beyond what noise makes.
    """
    if not blobs:
        return np.zeros(0)
    table = np.array([(one.area, one.length, one.turn, one.off or 0.0) for one in blobs])
    radii, lengths, off = np.sqrt(table[:, 0] / np.pi), table[:, 1], table[:, 3]
    longer = lengths / np.sort(lengths)[(len(blobs) + 3) // 4 - 1] - 1
    # by how much a whole blob may be longer than others; all of a rim tells by itself
    margins, shares = BLOBS.rough / radii**1.5, np.ones(len(blobs))
    rims = [(k, one.rim) for k, one in enumerate(blobs) if one.rim is not None]
    residual = statistics.median_low([rim.residual for _, rim in rims]) if rims else 0.0
    for k, rim in rims:
        is_cut = rim.coverage < BLOBS.whole or rim.residual > BLOBS.exact * residual
        is_cut &= radii[k] < BLOBS.large
        margins[k], shares[k] = (0.0, BLOBS.by_rim) if is_cut else (np.inf, 1.0)
    if np.count_nonzero(longer > margins):  # as a rule all are round
        longer = np.minimum(longer, longer_than_alike(table[:, :3], BLOBS.alike))
    shown = np.where(off > BLOBS.usual * usual, shares * off, 0.0)
    return np.asarray(np.maximum(BLOBS.off_centre * radii * (longer - margins), shown))
