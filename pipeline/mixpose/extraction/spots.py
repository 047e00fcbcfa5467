"""Centres of small blobs: the centroid of their grey values, to hundredths of a pixel."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from mixpose.extraction.contours import Contour, cut_out, on_border
from mixpose.extraction.threshold import Foreground

# The background of a spot is looked for this far around it.
MARGIN_PX = 3

# The centroid leaves out what is below this share of the peak: halo, flare, noise.  More would
# pull the centre towards pixels, less lets in more noise.
CENTROID_SHARE = 0.1

# The step at the rim, as a share of the whole signal, tells things from tips of soft light.
LEAST_STEP_SHARE = 0.4

# Spots that touch: longer than wide, and apart at a level that rises by a ratio.  Either peak
# must rise above that level by a share of itself, and out of the noise.
LONG = 1.35
LEVEL_RATIO = 1.25
MOST_PARTS = 8
PROMINENCE_SHARE = 0.3
PROMINENCE_NOISE_FACTOR = 4.0


def find_spots(scene: Foreground, contour: Contour, level: float) -> list[tuple[float, float]]:
    """Centre of a small blob, or the centres of the blobs that touch in it.

    Parameters
    ----------
    scene : Foreground
    contour : (n, 1, 2) int32
        What is above the level.
    level : float

    Returns
    -------
    list of (u, v)
        In pixels of the window; none if the blob is cut by its border or does not stand out.
    """
    box = cv2.boundingRect(contour)
    u, v, width, height = box
    # First what is cheap: most of the specks of a busy scene are dim.
    highest = cv2.minMaxLoc(scene.grey[v : v + height, u : u + width])[1] - scene.zero
    if highest < scene.least_peak or on_border(scene, box):
        return []
    patch, inside, (u0, v0) = cut_out(scene, contour, box, MARGIN_PX)
    frame = np.concatenate([patch[0], patch[-1], patch[:, 0], patch[:, -1]])
    frame.partition(frame.size // 2)
    base = float(frame[frame.size // 2])
    peak = cv2.minMaxLoc(patch, inside)[1]
    if scene.judged and peak - base < LEAST_STEP_SHARE * peak:
        return []
    if scene.judged and peak - level < PROMINENCE_SHARE * peak:
        return []
    base = min(base, level)
    parts = come_apart(scene, contour, patch, inside, level)
    centres = []
    for part, valley in parts or [(inside, level)]:
        top = cv2.minMaxLoc(patch, part)[1] if parts else peak
        cut = max(valley, base + CENTROID_SHARE * (top - base))
        mean_u, mean_v = _centroid(np.maximum(patch - np.float32(cut), 0) * part, part)
        centres.append((u0 + mean_u, v0 + mean_v))
    return centres


def _centroid(weights: NDArray[np.float32], part: NDArray[np.uint8]) -> tuple[float, float]:
    moments = cv2.moments(weights)
    if moments["m00"] <= 0:
        # Nothing but rounding above the cut: all of its pixels alike.
        moments = cv2.moments(part)
    return moments["m10"] / moments["m00"], moments["m01"] / moments["m00"]


def come_apart(
    scene: Foreground,
    contour: Contour,
    patch: NDArray[np.float32],
    inside: NDArray[np.uint8],
    level: float,
) -> list[tuple[NDArray[np.uint8], float]]:
    """Parts of a long blob that come apart at a higher level.

    Parameters
    ----------
    scene : Foreground
    contour : (n, 1, 2) int32
        Outline of the blob.
    patch : (h, w) float32
        Signal in a box about the blob.
    inside : (h, w) uint8
        1 inside of the blob, else 0.
    level : float
        Level of the contour.

    Returns
    -------
    list of (part, level)
        (h, w) uint8 mask of each part, and the level that sets them apart; none if none does,
        or if what is above the level is all that is asked for.
    """
    if not (scene.judged and _long(contour)):
        return []
    signal = patch * inside
    least_rise = PROMINENCE_NOISE_FACTOR * scene.noise
    highest = (1 - PROMINENCE_SHARE) * float(signal.max())
    while (level := level * LEVEL_RATIO) < highest:
        count, labels = cv2.connectedComponents((signal > level).view(np.uint8))
        if not 2 < count <= MOST_PARTS + 1:
            continue
        parts = [(labels == k).view(np.uint8) for k in range(1, count)]
        tops = [cv2.minMaxLoc(signal, part)[1] for part in parts]
        prominent = [
            (part, level)
            for part, top in zip(parts, tops, strict=True)
            if top >= scene.least_peak and top - level >= max(PROMINENCE_SHARE * top, least_rise)
        ]
        if len(prominent) > 1:
            return prominent
    return []


def _long(contour: Contour) -> bool:
    _, (a, b), _ = cv2.minAreaRect(contour)
    return bool(max(a, b) + 1 > LONG * (min(a, b) + 1))
