"""Separate foreground from background: subtract the background, and choose the detection level.

All functions search bright features; for dark ones the grey values are inverted.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any, TypeAlias, cast

import cv2
import numpy as np
from numpy.typing import NDArray

from mixpose.constants import constant
from mixpose.extraction.background import Grey, background_tiles, interpolated, noise_of
from mixpose.extraction.options import ExtractOptions
from mixpose.records import Image

Window: TypeAlias = tuple[int, int, int, int]

RULES = ("auto", "otsu", "local", "li", "triangle", "sauvola")

# Rows that are searched for the peak first: it is usually in one of the brightest.
PEAK_ROWS = 4
BLOCK_ROWS = 64

# Steps of float values for the rules that use a histogram.
STEPS = 65535


@dataclass(frozen=True)
class ThresholdRules:
    """Rules for the detection level, and for the peaks of small blobs."""

    min_margin: int = constant(
        64, "px, the least margin around a window in which its background is sought: four tiles"
    )
    tail: float = constant(
        2.0, "widths of a spot beyond the level where grey values are kept: 4 from its centre"
    )
    noise_factor: float = constant(
        5.0, "times the noise, the least level: three pixels in ten million are above by chance"
    )
    faint: float = constant(
        0.08,
        "of the brightest feature, the least level: reflections, lens flare and dimly lit "
        "surroundings are fainter",
    )
    peak_noise_factor: float = constant(
        8.0, "times the noise, the least peak of a small blob, of which nothing else is known"
    )
    peak: float = constant(0.2, "of the brightest feature, the least peak of a small blob")
    local_box: float = constant(
        1 / 8, "of the shorter side of a window: the box that `local` and `sauvola` compare with"
    )
    sauvola_k: float = constant(
        0.2,
        "share of the range from an even mean to the brightest pixel, up to Sauvola's level: 0.2 "
        "to 0.5 are usual (Sauvola and Pietikäinen 2000); the lower finds more dim features",
    )


LEVELS = ThresholdRules()


@dataclass(frozen=True)
class Foreground:
    """A window of an image, prepared for the search of bright features.

    The signal is the grey value above the background: ``grey - zero``.
    """

    grey: Grey  # (H, W) features are bright
    zero: float  # grey value of the background; 0 if subtracted from `grey`, or the level is given
    level: float  # a pixel whose signal is above this level belongs to a feature
    noise: float  # standard deviation of a background pixel
    least_peak: float  # signal that the peak of a small feature must reach
    # Whether features must stand out from their surroundings.  False where the level is the user's
    # or Otsu's: then every region above it counts.
    is_selective: bool
    tops: Grey  # (H,) highest grey values of rows, to skip the many rows without features

    @cached_property
    def highest(self) -> float:
        """Highest grey value."""
        return float(self.tops.max())


def above(signal: Grey, level: float) -> NDArray[np.uint8]:
    """Return a mask (H, W) of a signal's pixels above a level: uint8 of zeros and ones."""
    if signal.dtype == np.float32:
        return np.asarray(signal > np.float32(level)).view(np.uint8)
    # An integer is above a level when it is above the whole number below that level; NumPy
    # does not compare unsigned integers with numbers out of their range.
    whole = math.floor(level)
    if whole < 0:
        return np.ones(signal.shape, np.uint8)
    return np.asarray(signal > min(whole, _highest(signal))).view(np.uint8)


def foreground(image: Image, options: ExtractOptions, window: Window) -> Foreground:
    """Subtract the background of a window, and choose the level for its features.

    The window is within the image and not empty.
    """
    bright, inner, threshold = _with_surroundings(image, options, window)
    noise = noise_of(bright)
    if threshold == "otsu" or not isinstance(threshold, str):
        grey = bright[inner]
        level = _histogram_level(grey, threshold) if isinstance(threshold, str) else threshold
        return Foreground(grey, 0.0, level, noise, 0.0, is_selective=False, tops=grey.max(axis=1))
    is_local = threshold in ("local", "sauvola")
    grey, zero = _without_background(bright, inner, noise, is_local=is_local)
    tops = grey.max(axis=1)
    if threshold in ("li", "triangle"):
        level = max(LEVELS.noise_factor * noise, _histogram_level(grey, threshold) - zero)
        least_peak = max(LEVELS.peak_noise_factor * noise, level)
        return Foreground(grey, zero, level, noise, least_peak, is_selective=True, tops=tops)
    peak = _peak(grey, tops) - zero
    level = max(LEVELS.noise_factor * noise, LEVELS.faint * peak)
    least_peak = max(LEVELS.peak_noise_factor * noise, LEVELS.peak * peak)
    if threshold == "sauvola":
        # By how much Sauvola's level is above the detection level.
        excess = np.maximum(_sauvola_above_mean(bright)[inner] - np.float32(level), 0)
        grey = grey.astype(np.float32) - excess
        tops = grey.max(axis=1)
    return Foreground(grey, zero, level, noise, least_peak, is_selective=True, tops=tops)


def feature_values(image: Image, options: ExtractOptions, window: Window) -> NDArray[np.float32]:
    """Return the grey values (v1 - v0, u1 - u0) of features above the background; 0 elsewhere.

    Values below the level are kept as far beyond as spots of `spot_sigma` reach: without tails an
    overlapping pair looks closer together than it is.
    """
    scene = foreground(image, options, window)
    grey, zero = scene.grey, scene.zero
    if not scene.is_selective:
        bright, inner, _ = _with_surroundings(image, options, window)
        grey, zero = _without_background(bright, inner, scene.noise, is_local=False)
    values = np.zeros(grey.shape, np.float32)
    # Rows without features, which are most, are skipped.
    rows = np.flatnonzero(above(scene.tops, scene.zero + scene.level))
    signal = grey[rows].astype(np.float32) - np.float32(zero)
    values[rows] = np.maximum(signal, 0) * above(scene.grey[rows], scene.zero + scene.level)
    reach = math.ceil(LEVELS.tail * options.spot_sigma)
    if reach and len(rows):
        is_near = cv2.dilate((values > 0).astype(np.uint8), np.ones((2 * reach + 1,) * 2, np.uint8))
        values = np.maximum(grey.astype(np.float32) - np.float32(zero), 0) * is_near
    return values


def _with_surroundings(
    image: Image, options: ExtractOptions, window: Window
) -> tuple[Grey, tuple[slice, slice], str | float]:
    """Return a window's surroundings, features bright, the window in them, and the threshold.

    Features may fill a window that is drawn tightly around them, so that its background is sought
    in the surroundings too.
    """
    u0, v0, u1, v1 = window
    height, width = image.shape
    u_margin, v_margin = (max(side, LEVELS.min_margin) for side in (u1 - u0, v1 - v0))
    left, top = max(u0 - u_margin, 0), max(v0 - v_margin, 0)
    grey = image[top : min(v1 + v_margin, height), left : min(u1 + u_margin, width)]
    inner = np.s_[v0 - top : v1 - top, u0 - left : u1 - left]
    if options.polarity == "bright":
        return grey, inner, options.threshold
    # Inverted within the range of the type, so that unsigned integers do not overflow.
    highest = _highest(grey)
    threshold = options.threshold
    if not isinstance(threshold, str):
        # "Below t" is "above highest - t"; the level itself belongs to neither.
        threshold = highest - threshold
    return grey.dtype.type(highest) - grey, inner, threshold


def _highest(grey: Grey) -> int | float:
    """Return the upper end of an integer type's range, or the highest value of a float image."""
    if grey.dtype == np.float32:
        return float(grey.max())
    return 255 if grey.dtype == np.uint8 else 65535


def _without_background(
    bright: Grey, inner: tuple[slice, slice], noise: float, *, is_local: bool
) -> tuple[Grey, float]:
    """Return the inner part with an even background, and the grey value of that background."""
    if is_local:
        side = _local_box(bright)
        return cv2.subtract(bright, cv2.boxFilter(bright, -1, (side, side)))[inner], 0.0
    tiles = background_tiles(bright)
    ascending = np.sort(tiles, axis=None)
    low, high = float(ascending[0]), float(ascending[-1])
    if high - low <= 2 * noise:
        # The background is even already, as in most dark frames: nothing is subtracted.
        halves = ascending[(tiles.size - 1) // 2], ascending[tiles.size // 2]
        return bright[inner], (float(halves[0]) + float(halves[1])) / 2
    background = interpolated(tiles, bright, inner)
    return cv2.subtract(bright[inner], background, dst=background), 0.0


def _peak(grey: Grey, tops: Grey) -> float:
    """Return the highest grey value that two neighbours reach, as a hot pixel is no peak.

    Only rows whose highest value `tops` exceeds the peak of the brightest rows are searched.
    """
    if grey.shape[1] < 2:
        return float(tops.max())
    count = min(PEAK_ROWS, len(tops))
    peak = _pair_maximum(grey[np.argpartition(tops, -count)[-count:]])
    brighter = np.flatnonzero(tops > peak)
    # In blocks that stay in the cache, as bright frames have many such rows.
    blocks = (brighter[first : first + BLOCK_ROWS] for first in range(0, brighter.size, BLOCK_ROWS))
    return float(max([peak, *(_pair_maximum(grey[block]) for block in blocks)]))


def _pair_maximum(rows: Grey) -> np.number[Any]:
    return cast("np.number[Any]", cv2.min(rows[:, :-1], rows[:, 1:]).max())


def _local_box(bright: Grey) -> int:
    """Return the side in px of the box that a pixel is compared with."""
    shorter = int(min(bright.shape))
    return max(round(shorter * LEVELS.local_box), 3) // 2 * 2 + 1


def _sauvola_above_mean(bright: Grey) -> Grey:
    """Return by how much the level of Sauvola and Pietikäinen is above the local mean, per pixel.

    Their rule is for dark print: ``m (1 + k (s / r - 1))`` with the mean m and the standard
    deviation s of the surroundings and half the range r.  So the image is inverted, and measured
    from its brightest pixel.
    """
    from skimage.filters import threshold_sauvola  # noqa: PLC0415 (0.04 s to import)

    low, high = float(bright.min()), float(bright.max())
    if low == high:
        return np.zeros(bright.shape, np.float32)
    turned = np.float32(high) - bright.astype(np.float32)
    side = _local_box(bright)
    level = threshold_sauvola(turned, side, k=LEVELS.sauvola_k, r=(high - low) / 2)
    return np.asarray(cv2.boxFilter(turned, -1, (side, side)) - level, dtype=np.float32)


def _histogram_level(bright: Grey, rule: str) -> float:
    """Return the level by the rule of Otsu, Li (least cross entropy) or Zack et al. (triangle)."""
    whole, low, step = _whole_numbers(bright)
    if rule == "otsu":
        # The same as `skimage.filters.threshold_otsu`, in a third of its time or less (0.8 to
        # 2.9 ms of 1600 x 1200 bytes).
        return low + step * float(cv2.threshold(whole, 0, 1, cv2.THRESH_OTSU)[0])
    from skimage.filters import threshold_li, threshold_triangle  # noqa: PLC0415 (0.04 s to import)

    choose = threshold_li if rule == "li" else threshold_triangle
    return low + step * float(choose(whole))


def _whole_numbers(bright: Grey) -> tuple[Grey, float, float]:
    """Return grey values as whole numbers, and the grey values of 0 and of a step of 1.

    OpenCV has Otsu's rule for integers only, and Li's is 30 times faster for them (8 to 243 ms
    of 1600 x 1200 px).
    """
    if bright.dtype != np.float32:
        return bright, 0.0, 1.0
    low, high = float(bright.min()), float(bright.max())
    step = (high - low) / STEPS
    # A range too small for steps is one value to a histogram.
    if not np.float32(step) > 0:
        return np.zeros(bright.shape, np.uint16), high, 0.0
    return ((bright - np.float32(low)) / np.float32(step)).astype(np.uint16), low, step
