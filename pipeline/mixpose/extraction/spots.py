"""Centres of small blobs: the centroid of their grey values, to hundredths of a pixel."""

from __future__ import annotations

from functools import lru_cache
from typing import cast

import cv2
import numpy as np
from numpy.typing import NDArray

from mixpose.extraction.contours import Contour, filled, on_border, signal_about
from mixpose.extraction.threshold import Foreground, above
from mixpose.records import Floats

# The background of a spot is looked for this far around it.
MARGIN_PX = 3

# The centroid leaves out what is below this share of the peak: halo, flare, noise.  More would
# pull the centre towards pixels, less lets in more noise.
CENTROID_SHARE = 0.1

# The step at the rim, as a share of the whole signal, tells things from tips of soft light.
LEAST_STEP_SHARE = 0.4

# Spots that touch: longer than wide, and apart at a level that rises by a ratio.  Either peak
# must rise above that level by a share of itself, and out of the noise.  With a share of 0.2 and a
# ratio of 1.1 equal spots part at 3 instead of 4 times their width, but 0.14 px off: poses of
# `data/synthetic/one_camera_video` are none the better (0.0084 to 0.0082 degrees).
LONG = 1.35
LEVEL_RATIO = 1.25
MOST_PARTS = 8
PROMINENCE_SHARE = 0.3
PROMINENCE_NOISE_FACTOR = 4.0

# Patches of so many shapes are prepared for.
SHAPES = 256


def find_spots(
    scene: Foreground, contour: Contour, area: float, level: float
) -> list[tuple[float, float]]:
    """Centre of a small blob, or the centres of the blobs that touch in it.

    Parameters
    ----------
    scene : Foreground
    contour : (n, 1, 2) int32
        What is above the level.
    area : float
        Number of pixels that it encloses.
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
    patch, corner = signal_about(scene, box, MARGIN_PX)
    frame = patch.take(_border(*patch.shape))
    frame.partition(frame.size // 2)
    base = float(frame[frame.size // 2])
    # The usual blob has the patch for itself, and nothing else there needs to be masked.
    alone = np.count_nonzero(patch > level) == area
    inside = None if alone else filled(contour, patch.shape, corner)
    peak = cv2.minMaxLoc(patch, inside)[1]
    if scene.judged and peak - base < LEAST_STEP_SHARE * peak:
        return []
    if scene.judged and peak - level < PROMINENCE_SHARE * peak:
        return []
    base = min(base, level)
    parts = come_apart(scene, contour, patch, inside, level)
    centres = []
    whole: list[tuple[NDArray[np.uint8] | None, float]] = [(inside, level)]
    for part, valley in parts or whole:
        top = cv2.minMaxLoc(patch, part)[1] if parts else peak
        cut = max(valley, base + CENTROID_SHARE * (top - base))
        weights = np.maximum(patch - np.float32(cut), 0)
        if part is not None:
            weights *= part
        if not (moments := _moments(weights))[0] > 0:
            # Nothing but rounding above the cut: all of its pixels alike.
            moments = _moments(above(patch, level) if part is None else part)
        total, by_u, by_v = moments
        centres.append((corner[0] + by_u / total, corner[1] + by_v / total))
    return centres


def _moments(weights: NDArray[np.float32] | NDArray[np.uint8]) -> list[float]:
    """Sum of weights, and of weights by u and by v."""
    return cast("list[float]", (monomials(*weights.shape) @ weights.ravel()).tolist())


@lru_cache(maxsize=SHAPES)
def monomials(rows: int, columns: int) -> Floats:
    """1, u and v of every pixel of a patch (3, rows * columns)."""
    v, u = np.indices((rows, columns), dtype=np.float64).reshape(2, -1)
    return np.array([np.ones(u.size), u, v])


@lru_cache(maxsize=SHAPES)
def _border(rows: int, columns: int) -> NDArray[np.intp]:
    """Places of the outermost pixels of a patch, corners twice."""
    places = np.arange(rows * columns).reshape(rows, columns)
    return np.concatenate([places[0], places[-1], places[:, 0], places[:, -1]])


def come_apart(
    scene: Foreground,
    contour: Contour,
    patch: NDArray[np.float32],
    inside: NDArray[np.uint8] | None,
    level: float,
) -> list[tuple[NDArray[np.uint8], float]]:
    """Parts of a long blob that come apart at a higher level.

    A watershed (`skimage.segmentation`) from peaks as prominent parts no more pairs (6 px apart,
    one 2.5 times brighter: 16 of 30 to 26) in three times the time, and a photograph of 8
    megapixels takes it more than a minute.

    Parameters
    ----------
    scene : Foreground
    contour : (n, 1, 2) int32
        Outline of the blob.
    patch : (h, w) float32
        Signal in a box about the blob.
    inside : (h, w) uint8 or None
        1 inside of the blob, else 0; None where nothing else is above the level.
    level : float
        Level of the contour.

    Returns
    -------
    list of (part, level)
        (h, w) uint8 mask of each part, and the level that sets them apart; none if none does,
        or if what is above the level is all that is asked for.
    """
    if not (scene.judged and is_long(contour)):
        return []
    signal = patch if inside is None else patch * inside
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


def is_long(contour: Contour) -> bool:
    """Whether a blob is so long that it may be several."""
    _, (a, b), _ = cv2.minAreaRect(contour)
    return bool(max(a, b) + 1 > LONG * (min(a, b) + 1))
