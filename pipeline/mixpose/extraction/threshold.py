"""What is foreground: the image without its background, and the level above which it counts.

Everything here looks for bright features; dark ones are bright in the turned-over image.
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
from mixpose.extraction.background import (
    Grey,
    background_tiles,
    noise_of,
    spread_out,
)
from mixpose.extraction.options import ExtractOptions
from mixpose.records import Image

Window: TypeAlias = tuple[int, int, int, int]

RULES = ("auto", "otsu", "local", "li", "triangle", "sauvola")

# Rows that are searched for the peak first: it is in one of the brightest, as a rule.
PEAK_ROWS = 4
BLOCK_ROWS = 64

# Floats are sorted into so many steps for the rules that look at a histogram.
STEPS = 65535


@dataclass(frozen=True)
class ThresholdRules:
    """The level above which something counts."""

    min_margin: int = constant(
        64, "px around a window that are looked at at least, to know its background: four tiles"
    )
    tail: float = constant(
        2.0, "widths of a spot beside the level that grey values are kept: 4 from its centre"
    )
    noise_factor: float = constant(
        5.0, "of the noise, the level at least: three pixels in ten million are above by chance"
    )
    faint: float = constant(
        0.08,
        "of the brightest feature, the level at least: reflections, lens flare and dimly lit "
        "surroundings are fainter",
    )
    peak_noise_factor: float = constant(
        8.0, "of the noise, for the peak of a small blob, of which nothing else is known"
    )
    peak: float = constant(0.2, "of the brightest feature, likewise")
    local_box: float = constant(
        1 / 8, "of the shorter side of a window: the box that `local` and `sauvola` compare with"
    )
    sauvola_k: float = constant(
        0.2,
        "how far Sauvola's level is from an even mean, of what is left up to the brightest pixel: "
        "0.2 to 0.5 are in use (Sauvola and Pietikäinen 2000); the lower finds more of what is dim",
    )


LEVELS = ThresholdRules()


@dataclass(frozen=True)
class Foreground:
    """A window of an image, made ready to look for bright features.

    The signal is what is brighter than the background: ``grey - zero``.
    """

    grey: Grey  # (H, W) features bright
    zero: float  # grey value of the background; 0 where it is out of `grey`, or the level given
    level: float  # a pixel whose signal is above this level belongs to a feature
    noise: float  # standard deviation of a background pixel
    least_peak: float  # signal that a small feature must reach to count
    # Whether features must stand out to count. False where the level is the user's, or Otsu's: then
    # all that is above it counts.
    judged: bool
    tops: Grey  # (H,) highest grey values of rows: most have nothing to look for

    @cached_property
    def highest(self) -> float:
        """The highest grey value."""
        return float(self.tops.max())


def above(signal: Grey, level: float) -> NDArray[np.uint8]:
    """Pixels of a signal that are above a level: (H, W) uint8 of zeros and ones."""
    if signal.dtype == np.float32:
        return np.asarray(signal > np.float32(level)).view(np.uint8)
    # An integer is above a level when it is above the whole number below that level; NumPy
    # does not compare unsigned integers with numbers out of their range.
    whole = math.floor(level)
    if whole < 0:
        return np.ones(signal.shape, np.uint8)
    return np.asarray(signal > min(whole, _highest(signal))).view(np.uint8)


def foreground(image: Image, options: ExtractOptions, window: Window) -> Foreground:
    """Take the background out of a window and choose the level for its features.

    The window is within the image, and not empty.
    """
    bright, inner, threshold = _bright(image, options, window)
    noise = noise_of(bright)
    if threshold == "otsu" or not isinstance(threshold, str):
        grey = bright[inner]
        level = _otsu(grey) if isinstance(threshold, str) else threshold
        return Foreground(grey, 0.0, level, noise, 0.0, judged=False, tops=grey.max(axis=1))
    local = threshold in ("local", "sauvola")
    grey, zero = _without_background(bright, inner, noise, local=local)
    tops = grey.max(axis=1)
    if threshold in ("li", "triangle"):
        level = max(LEVELS.noise_factor * noise, _histogram_level(grey, threshold) - zero)
        least_peak = max(LEVELS.peak_noise_factor * noise, level)
        return Foreground(grey, zero, level, noise, least_peak, judged=True, tops=tops)
    peak = _peak(grey, tops) - zero
    level = max(LEVELS.noise_factor * noise, LEVELS.faint * peak)
    least_peak = max(LEVELS.peak_noise_factor * noise, LEVELS.peak * peak)
    if threshold == "sauvola":
        # What Sauvola's level takes off beyond the detection level.
        beyond = np.maximum(_sauvola_above_mean(bright)[inner] - np.float32(level), 0)
        grey = grey.astype(np.float32) - beyond
        tops = grey.max(axis=1)
    return Foreground(grey, zero, level, noise, least_peak, judged=True, tops=tops)


def feature_values(image: Image, options: ExtractOptions, window: Window) -> NDArray[np.float32]:
    """Grey values (v1 - v0, u1 - u0) of the features in a window without the background, else 0.

    Down to zero as far beside the level as spots of `spot_sigma` reach: without its tails a pair
    that overlaps looks closer together than it is.
    """
    found = foreground(image, options, window)
    grey, zero = found.grey, found.zero
    if not found.judged:
        bright, inner, _ = _bright(image, options, window)
        grey, zero = _without_background(bright, inner, found.noise, local=False)
    values = np.zeros(grey.shape, np.float32)
    # Rows without features are left alone: most of a frame has none.
    rows = np.flatnonzero(above(found.tops, found.zero + found.level))
    signal = grey[rows].astype(np.float32) - np.float32(zero)
    values[rows] = np.maximum(signal, 0) * above(found.grey[rows], found.zero + found.level)
    reach = math.ceil(LEVELS.tail * options.spot_sigma)
    if reach and len(rows):
        near = cv2.dilate((values > 0).astype(np.uint8), np.ones((2 * reach + 1,) * 2, np.uint8))
        values = np.maximum(grey.astype(np.float32) - np.float32(zero), 0) * near
    return values


def _bright(
    image: Image, options: ExtractOptions, window: Window
) -> tuple[Grey, tuple[slice, slice], str | float]:
    """Surroundings of a window with features bright, the window in them, and the threshold.

    Features may fill a window that is drawn tightly about them, so the background is looked
    for in its surroundings too.
    """
    u0, v0, u1, v1 = window
    height, width = image.shape
    u_margin, v_margin = (max(side, LEVELS.min_margin) for side in (u1 - u0, v1 - v0))
    left, top = max(u0 - u_margin, 0), max(v0 - v_margin, 0)
    near = image[top : min(v1 + v_margin, height), left : min(u1 + u_margin, width)]
    inner = np.s_[v0 - top : v1 - top, u0 - left : u1 - left]
    if options.polarity == "bright":
        return near, inner, options.threshold
    # Turned over within the range of the type, so that unsigned integers stay what they are.
    highest = _highest(near)
    threshold = options.threshold
    if not isinstance(threshold, str):
        # "Below t" is "above highest - t"; a whole level itself belongs to neither.
        threshold = highest - threshold
    return near.dtype.type(highest) - near, inner, threshold


def _highest(grey: Grey) -> int | float:
    """Upper end of the range of an integer type; the highest value of a float image."""
    if grey.dtype == np.float32:
        return float(grey.max())
    return 255 if grey.dtype == np.uint8 else 65535


def _without_background(
    bright: Grey, inner: tuple[slice, slice], noise: float, *, local: bool
) -> tuple[Grey, float]:
    """Grey values of the inner part with an even background, and the grey value of that."""
    if local:
        side = _local_box(bright)
        return cv2.subtract(bright, cv2.boxFilter(bright, -1, (side, side)))[inner], 0.0
    tiles = background_tiles(bright)
    ascending = np.sort(tiles, axis=None)
    low, high = float(ascending[0]), float(ascending[-1])
    if high - low <= 2 * noise:
        # Even already, the common case of dark frames: work on the whole frame is spared.
        halves = ascending[(tiles.size - 1) // 2], ascending[tiles.size // 2]
        return bright[inner], (float(halves[0]) + float(halves[1])) / 2
    background = spread_out(tiles, bright, inner)
    return cv2.subtract(bright[inner], background, dst=background), 0.0


def _peak(grey: Grey, tops: Grey) -> float:
    """Highest grey value that a pixel shares with its neighbour: a hot pixel is no peak.

    Only rows are looked at whose highest value `tops` is above what the brightest have.
    """
    if grey.shape[1] < 2:
        return float(tops.max())
    few = min(PEAK_ROWS, len(tops))
    peak = _shared(grey[np.argpartition(tops, -few)[-few:]])
    rest = np.flatnonzero(tops > peak)
    # In blocks that stay in the cache: of a bright frame it is most rows.
    blocks = (rest[first : first + BLOCK_ROWS] for first in range(0, rest.size, BLOCK_ROWS))
    return float(max([peak, *(_shared(grey[block]) for block in blocks)]))


def _shared(rows: Grey) -> np.number[Any]:
    return cast("np.number[Any]", cv2.min(rows[:, :-1], rows[:, 1:]).max())


def _local_box(bright: Grey) -> int:
    """Side in px of the box that a pixel is compared with."""
    shorter = int(min(bright.shape))
    return max(round(shorter * LEVELS.local_box), 3) // 2 * 2 + 1


def _sauvola_above_mean(bright: Grey) -> Grey:
    """By how much the level of Sauvola and Pietikäinen is above the local mean, per pixel.

    Their rule is for dark print: ``m (1 + k (s / r - 1))`` with the mean m and the standard
    deviation s of the surroundings and half the range r.  So the image is turned over, and
    counted from its brightest pixel.
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
    """Level by the rule of Li (least cross entropy) or the triangle of Zack et al."""
    from skimage.filters import threshold_li, threshold_triangle  # noqa: PLC0415 (0.04 s to import)

    whole, low, step = _whole_numbers(bright)
    choose = threshold_li if rule == "li" else threshold_triangle
    return low + step * float(choose(whole))


def _otsu(bright: Grey) -> float:
    # The level of `skimage.filters.threshold_otsu`, in a third of its time or less (0.8 to
    # 2.9 ms of 1600 x 1200 bytes).
    whole, low, step = _whole_numbers(bright)
    return low + step * float(cv2.threshold(whole, 0, 1, cv2.THRESH_OTSU)[0])


def _whole_numbers(bright: Grey) -> tuple[Grey, float, float]:
    """Grey values for a histogram: whole numbers, and what 0 and a step of 1 stand for.

    OpenCV has Otsu's rule for integers only, and Li's is 30 times faster for them (8 to 243 ms
    of 1600 x 1200 px).
    """
    if bright.dtype != np.float32:
        return bright, 0.0, 1.0
    low, high = float(bright.min()), float(bright.max())
    step = (high - low) / STEPS
    # A range too small for steps has one value, as far as a histogram tells.
    if not np.float32(step) > 0:
        return np.zeros(bright.shape, np.uint16), high, 0.0
    return ((bright - np.float32(low)) / np.float32(step)).astype(np.uint16), low, step
