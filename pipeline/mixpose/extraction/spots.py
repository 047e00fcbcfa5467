"""Locate small blobs by the centroid of their grey values, to hundredths of a pixel.

The usual ones, which are small, round and alone, are located all at once, with the results of
`find_spots`, in a few steps for all.  Weighted centroids of `skimage.measure.regionprops_table` are
as good (0.012 to 0.013 px in `data/synthetic/two_cameras`), but take 3.1 ms per frame instead of
0.5 ms.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from mixpose.constants import constant
from mixpose.extraction.blob import Blob
from mixpose.extraction.contours import (
    Contour,
    is_on_border,
    length_by_width,
    mask_of,
    signal_about,
)
from mixpose.extraction.shape import Patches, areas_at_half_height, background, centroids
from mixpose.extraction.threshold import Foreground, above
from mixpose.records import Floats, Mask

FEWEST = 3  # spots for which locating them all at once is faster
WIDEST_PX = 15


@dataclass(frozen=True)
class SpotRules:
    """Rules for small blobs, and for splitting those that touch.

    A prominence of 0.2 and a ratio of 1.1 would split equal spots 3 instead of 4 times their width
    apart, but 0.14 px off: poses of `data/synthetic/one_camera_video` do not improve (0.0084 to
    0.0082 degrees).
    """

    margin: int = constant(3, "px around a spot, whose outermost pixels are its background")
    centroid: float = constant(
        0.1,
        "of the peak: pixels below are halo, flare and noise, and not in the centroid; a higher "
        "share would pull it towards pixel centres, a lower one lets in more noise",
    )
    min_step: float = constant(0.4, "at the rim, of the peak's signal: soft light has less")
    long: float = constant(1.35, "length by width from which a blob may be several that touch")
    level_ratio: float = constant(1.25, "from level to level at which they are split")
    max_parts: int = constant(8, "into which a blob is split: more are noise")
    prominence: float = constant(0.3, "of a part's peak, by which it must rise above that level")
    prominence_noise_factor: float = constant(4.0, "the same, in times the noise")


SPOTS = SpotRules()


def find_spots(scene: Foreground, contour: Contour, area: float, level: float) -> list[Blob]:
    """Return the spot of a small region, or those of several that touch in it.

    The contour encloses `area` px above the level.  There is no spot if the border of the window
    cuts the region, or it does not stand out.
    """
    box = cv2.boundingRect(contour)
    u, v, width, height = box
    # The cheap test comes first: most specks of a busy scene are dim.
    highest = cv2.minMaxLoc(scene.grey[v : v + height, u : u + width])[1] - scene.zero
    if highest < scene.least_peak or is_on_border(scene, box):
        return []
    patch, corner = signal_about(scene, box, SPOTS.margin)
    base = background(patch)
    # Mostly nothing else is in the patch, so that it needs no mask.
    is_alone = np.count_nonzero(patch > level) == area
    inside = None if is_alone else mask_of(contour, patch.shape, corner)
    peak = cv2.minMaxLoc(patch, inside)[1]
    if scene.is_selective and peak - base < SPOTS.min_step * peak:
        return []
    if scene.is_selective and peak - level < SPOTS.prominence * peak:
        return []
    base = min(base, level)
    parts = split_long(scene, contour, patch, inside, level)
    own_signal = patch if inside is None else patch * inside
    size = float(areas_at_half_height(own_signal[None], np.array([base]), np.array([peak]))[0])
    shape, count = ((1.0, 0.0), len(parts)) if parts else (length_by_width(contour), 1)
    spots = []
    region: list[tuple[NDArray[np.uint8] | None, float]] = [(inside, level)]
    for part, valley in parts or region:
        top = cv2.minMaxLoc(patch, part)[1] if parts else peak
        cut = max(valley, base + SPOTS.centroid * (top - base))
        weights = np.maximum(patch - np.float32(cut), 0)
        if part is not None:
            weights *= part
        if not weights.any():
            # Only rounding errors are above the cut: all of its pixels count alike.
            weights = above(patch, level) if part is None else part
        (centre,), (error,) = (values.tolist() for values in centroids(weights[None]))
        u, v = corner[0] + centre[0], corner[1] + centre[1]
        spots.append(Blob(u, v, area / count, *shape, error=error, size=size / count))
    return spots


def split_long(
    scene: Foreground,
    contour: Contour,
    patch: NDArray[np.float32],
    inside: NDArray[np.uint8] | None,
    level: float,
) -> list[tuple[NDArray[np.uint8], float]]:
    """Split a long blob at a higher level; return masks (h, w) of its parts, with that level.

    `patch` (h, w) is the signal around the blob, `inside` 1 within it, or None where nothing else
    is above its level.  A blob is not split if features need not stand out.

    A watershed (`skimage.segmentation`) from peaks as prominent splits fewer pairs (6 px apart,
    one 2.5 times brighter: 16 of 30 to 26) in three times the time, and takes more than a minute
    for a photograph of 8 megapixels.
    """
    if not (scene.is_selective and is_long(contour)):
        return []
    signal = patch if inside is None else patch * inside
    min_rise = SPOTS.prominence_noise_factor * scene.noise
    highest = (1 - SPOTS.prominence) * float(signal.max())
    while (level := level * SPOTS.level_ratio) < highest:
        count, labels = cv2.connectedComponents((signal > level).view(np.uint8))
        if not 2 < count <= SPOTS.max_parts + 1:
            continue
        parts = [(labels == k).view(np.uint8) for k in range(1, count)]
        tops = [cv2.minMaxLoc(signal, part)[1] for part in parts]
        prominent = [
            (part, level)
            for part, top in zip(parts, tops, strict=True)
            if top >= scene.least_peak and top - level >= max(SPOTS.prominence * top, min_rise)
        ]
        if len(prominent) > 1:
            return prominent
    return []


def is_long(contour: Contour) -> bool:
    """Test whether a blob is so long that it may be several."""
    _, (a, b), _ = cv2.minAreaRect(contour)
    return bool(max(a, b) + 1 > SPOTS.long * (min(a, b) + 1))


def find_spots_together(
    scene: Foreground, contours: Sequence[Contour], areas: Floats, levels: Floats
) -> list[list[Blob]]:
    """Return the `find_spots` of several small regions, of areas (K,) above levels (K,)."""
    spots: list[list[Blob]] = [[] for _ in contours]
    bright, candidates = _find_bright(scene, contours, levels)
    if len(candidates) >= FEWEST and float(levels.min()) > 0:
        indices, boxes = (np.array(column) for column in zip(*candidates, strict=True))
        *values, is_alone = _measure(scene, boxes, areas[indices], levels[indices])
        lists = (column[is_alone].tolist() for column in (indices, areas[indices], *values))
        for k, area, (u, v), error, size, stands_out in zip(*lists, strict=True):
            if not stands_out:
                bright.remove(k)
            elif not (scene.is_selective and is_long(contours[k])):
                bright.remove(k)
                shape = length_by_width(contours[k])
                spots[k] = [Blob(u, v, area, *shape, error=error, size=size)]
    for k in bright:
        spots[k] = find_spots(scene, contours[k], float(areas[k]), float(levels[k]))
    return spots


def _find_bright(
    scene: Foreground, contours: Sequence[Contour], levels: Floats
) -> tuple[set[int], list[tuple[int, tuple[int, int, int, int]]]]:
    """Find contours bright enough for spots; of small ones away from the border also the boxes."""
    rows, columns = scene.grey.shape
    inner_v, inner_u = rows - WIDEST_PX - SPOTS.margin, columns - WIDEST_PX - SPOTS.margin
    bright, candidates = set(), []
    min_peaks = np.full(len(levels), scene.least_peak)
    if scene.is_selective:
        min_peaks = np.maximum(min_peaks, levels / (1 - SPOTS.prominence))
    for k, (contour, lowest) in enumerate(
        zip(contours, (min_peaks + scene.zero).tolist(), strict=True)
    ):
        u, v, width, height = cv2.boundingRect(contour)
        highest = cv2.minMaxLoc(scene.grey[v : v + height, u : u + width])[1]
        if highest >= lowest:
            bright.add(k)
            small = width <= WIDEST_PX and height <= WIDEST_PX
            if small and SPOTS.margin <= u < inner_u and SPOTS.margin <= v < inner_v:
                candidates.append((k, (u, v, width, height)))
    return bright, candidates


def _measure(
    scene: Foreground, boxes: NDArray[np.intp], areas: Floats, levels: Floats
) -> tuple[Floats, Floats, Floats, Mask, Mask]:
    """Return centres (K, 2), errors, areas, which spots stand out, and which need no mask."""
    signal, corners, base, peak = Patches.around(scene, boxes, SPOTS.margin)
    level = levels.astype(np.float32)[:, None, None]
    is_alone = (signal > level).reshape(len(boxes), -1).sum(axis=1) == areas
    bright = np.ones(len(boxes), dtype=np.bool_)
    if scene.is_selective:
        bright = (peak - base >= SPOTS.min_step * peak) & (peak - levels >= SPOTS.prominence * peak)
    base = np.minimum(base, levels)
    sizes = areas_at_half_height(signal, base, peak)
    cut = np.maximum(levels, base + SPOTS.centroid * (peak - base)).astype(np.float32)
    weights = np.maximum(signal - cut[:, None, None], 0)
    centres, errors = centroids(weights)
    is_alone &= np.isfinite(errors)
    return centres + corners, errors, sizes, bright, is_alone
