"""Centres of small blobs: the centroid of their grey values, to hundredths of a pixel."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from mixpose.constants import constant
from mixpose.extraction.contours import Contour, filled, on_border, signal_about
from mixpose.extraction.shape import areas_at_half, background, centroids
from mixpose.extraction.threshold import Foreground, above


@dataclass(frozen=True)
class SpotRules:
    """What a small blob is, and which are several that touch.

    Of equal spots, a prominence of 0.2 and a ratio of 1.1 part those that are 3 instead of 4 times
    their width apart, but 0.14 px off: poses of `data/synthetic/one_camera_video` are none the
    better (0.0084 to 0.0082 degrees).
    """

    margin: int = constant(3, "px around a spot in which its background is looked for")
    centroid: float = constant(
        0.1,
        "of the peak, below which is left out of the centroid as halo, flare and noise: more would "
        "pull it towards pixels, less lets in more noise",
    )
    min_step: float = constant(0.4, "at the rim, of the whole signal: tips of soft light have less")
    long: float = constant(1.35, "length by width from which a blob may be several that touch")
    level_ratio: float = constant(1.25, "from level to level at which they may come apart")
    max_parts: int = constant(8, "into which a blob comes apart: more are noise")
    prominence: float = constant(0.3, "of itself, that a part's peak rises above that level")
    prominence_noise_factor: float = constant(4.0, "the same, of the noise")


SPOTS = SpotRules()


class Spot(NamedTuple):
    """What is found of a small blob."""

    u: float  # centre, px of the window
    v: float
    off: float  # px by which that may be off
    size: float  # px at half of its height


def find_spots(scene: Foreground, contour: Contour, area: float, level: float) -> list[Spot]:
    """The spot of a small blob, or those of blobs that touch in it.

    The contour encloses `area` px that are above the level.  There is none if the border of the
    window cuts the blob or it does not stand out.
    """
    box = cv2.boundingRect(contour)
    u, v, width, height = box
    # First what is cheap: most of the specks of a busy scene are dim.
    highest = cv2.minMaxLoc(scene.grey[v : v + height, u : u + width])[1] - scene.zero
    if highest < scene.least_peak or on_border(scene, box):
        return []
    patch, corner = signal_about(scene, box, SPOTS.margin)
    base = background(patch)
    # The usual blob has the patch for itself, and nothing else there needs to be masked.
    alone = np.count_nonzero(patch > level) == area
    inside = None if alone else filled(contour, patch.shape, corner)
    peak = cv2.minMaxLoc(patch, inside)[1]
    if scene.judged and peak - base < SPOTS.min_step * peak:
        return []
    if scene.judged and peak - level < SPOTS.prominence * peak:
        return []
    base = min(base, level)
    parts = come_apart(scene, contour, patch, inside, level)
    own = patch if inside is None else patch * inside
    size = float(areas_at_half(own[None], np.array([base]), np.array([peak]))[0])
    spots = []
    whole: list[tuple[NDArray[np.uint8] | None, float]] = [(inside, level)]
    for part, valley in parts or whole:
        top = cv2.minMaxLoc(patch, part)[1] if parts else peak
        cut = max(valley, base + SPOTS.centroid * (top - base))
        weights = np.maximum(patch - np.float32(cut), 0)
        if part is not None:
            weights *= part
        if not weights.any():
            # Nothing but rounding above the cut: all of its pixels alike.
            weights = above(patch, level) if part is None else part
        (centre,), (off,) = (one.tolist() for one in centroids(weights[None]))
        u, v = corner[0] + centre[0], corner[1] + centre[1]
        spots.append(Spot(u, v, off, size / max(len(parts), 1)))
    return spots


def come_apart(
    scene: Foreground,
    contour: Contour,
    patch: NDArray[np.float32],
    inside: NDArray[np.uint8] | None,
    level: float,
) -> list[tuple[NDArray[np.uint8], float]]:
    """Masks (h, w) of the parts of a long blob that come apart at a higher level, with that level.

    `patch` (h, w) is the signal about the blob, `inside` 1 within it, or None where nothing else is
    above its level.  There are no parts where all that is above the level is asked for.

    A watershed (`skimage.segmentation`) from peaks as prominent parts no more pairs (6 px apart,
    one 2.5 times brighter: 16 of 30 to 26) in three times the time, and a photograph of 8
    megapixels takes it more than a minute.
    """
    if not (scene.judged and is_long(contour)):
        return []
    signal = patch if inside is None else patch * inside
    least_rise = SPOTS.prominence_noise_factor * scene.noise
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
            if top >= scene.least_peak and top - level >= max(SPOTS.prominence * top, least_rise)
        ]
        if len(prominent) > 1:
            return prominent
    return []


def is_long(contour: Contour) -> bool:
    """Whether a blob is so long that it may be several."""
    _, (a, b), _ = cv2.minAreaRect(contour)
    return bool(max(a, b) + 1 > SPOTS.long * (min(a, b) + 1))
