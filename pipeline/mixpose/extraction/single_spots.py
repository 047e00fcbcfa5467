"""Centres of many spots at once, of those that are small, round and alone: the usual ones.

The same as `spots.find_spots` finds, in a few steps for all together.  Weighted centroids of
`skimage.measure.regionprops_table` are as good (0.012 to 0.013 px in `data/synthetic/two_cameras`),
but a frame takes 3.1 ms with them and 0.5 ms so.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from mixpose.extraction.contours import Contour
from mixpose.extraction.shape import Patches, areas_at_half, centroids
from mixpose.extraction.spots import SPOTS, Spot, find_spots, is_long
from mixpose.extraction.threshold import Foreground
from mixpose.records import Floats, Mask

FEWEST = 3  # for which it pays
WIDEST_PX = 15


def all_spots(
    scene: Foreground, contours: Sequence[Contour], areas: Floats, levels: Floats
) -> list[list[Spot]]:
    """What `find_spots` gives for each of several small blobs, of areas (K,) above levels (K,)."""
    found: list[list[Spot]] = [[] for _ in contours]
    bright, usual = _bright(scene, contours, levels)
    if len(usual) >= FEWEST and float(levels.min()) > 0:
        own, boxes = (np.array(one) for one in zip(*usual, strict=True))
        *seen, sure = _together(scene, boxes, areas[own], levels[own])
        told = (one[sure].tolist() for one in (own, *seen))
        for k, centre, apart, size, stands_out in zip(*told, strict=True):
            if not stands_out:
                bright.remove(k)
            elif not (scene.judged and is_long(contours[k])):
                bright.remove(k)
                found[k] = [Spot(centre[0], centre[1], apart, size)]
    for k in bright:
        found[k] = find_spots(scene, contours[k], areas[k], float(levels[k]))
    return found


def _bright(
    scene: Foreground, contours: Sequence[Contour], levels: Floats
) -> tuple[set[int], list[tuple[int, tuple[int, int, int, int]]]]:
    """Which contours may be spots by what is brightest; with boxes, those well inside and small."""
    rows, columns = scene.grey.shape
    inner_v, inner_u = rows - WIDEST_PX - SPOTS.margin, columns - WIDEST_PX - SPOTS.margin
    bright, usual = set(), []
    least = np.full(len(levels), scene.least_peak)
    if scene.judged:
        least = np.maximum(least, levels / (1 - SPOTS.prominence))
    for k, (contour, lowest) in enumerate(
        zip(contours, (least + scene.zero).tolist(), strict=True)
    ):
        u, v, width, height = cv2.boundingRect(contour)
        highest = cv2.minMaxLoc(scene.grey[v : v + height, u : u + width])[1]
        if highest >= lowest:
            bright.add(k)
            small = width <= WIDEST_PX and height <= WIDEST_PX
            if small and SPOTS.margin <= u < inner_u and SPOTS.margin <= v < inner_v:
                usual.append((k, (u, v, width, height)))
    return bright, usual


def _together(
    scene: Foreground, boxes: NDArray[np.intp], areas: Floats, levels: Floats
) -> tuple[Floats, Floats, Floats, Mask, Mask]:
    """Centres (K, 2), how far they may be off, areas, which stand out, and which need no mask."""
    signal, corners, base, peak = Patches.about(scene, boxes, SPOTS.margin)
    level = levels.astype(np.float32)[:, None, None]
    alone = (signal > level).reshape(len(boxes), -1).sum(axis=1) == areas
    bright = np.ones(len(boxes), dtype=np.bool_)
    if scene.judged:
        bright = (peak - base >= SPOTS.min_step * peak) & (peak - levels >= SPOTS.prominence * peak)
    base = np.minimum(base, levels)
    sizes = areas_at_half(signal, base, peak)
    cut = np.maximum(levels, base + SPOTS.centroid * (peak - base)).astype(np.float32)
    weights = np.maximum(signal - cut[:, None, None], 0)
    centres, off = centroids(weights)
    alone &= np.isfinite(off)
    return centres + corners, off, sizes, bright, alone
