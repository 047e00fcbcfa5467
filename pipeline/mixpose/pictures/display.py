"""Frames made visible: any grey image as an 8-bit picture in which dark frames are legible."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from mixpose.pictures.canvas import Picture

# This share of the pixels may be darker than black or brighter than white: a hot pixel or two do
# not count, a few small spots do.
_BEYOND = 2e-5
_LEAST_SPAN = 16.0  # grey levels of an integer image, lest noise fill the picture
_MIDDLE = 0.2  # where the median grey value of a dark frame is brought to
_STRONGEST = 0.45  # exponent, lest noise is all one sees
_SAMPLES = 200_000


def displayable(image: NDArray[Any]) -> Picture:
    """A grey image (H, W), finite, of any type as a picture, brightened where most of it is dark.

    Its contrast is stretched; blue, green and red are alike.
    """
    low, high, exponent = _stretch(image)

    def curve(values: NDArray[Any]) -> NDArray[np.uint8]:
        share = (values.astype(np.float32) - np.float32(low)) / np.float32(high - low)
        return np.asarray(np.round(255 * np.clip(share, 0, 1) ** exponent), dtype=np.uint8)

    if np.issubdtype(image.dtype, np.unsignedinteger):
        grey = curve(np.arange(np.iinfo(image.dtype).max + 1))[image]  # a look-up is fast
    else:
        grey = curve(image)
    return np.asarray(cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR), dtype=np.uint8)


def _stretch(image: NDArray[Any]) -> tuple[float, float, float]:
    """Grey values that become black and white, and the exponent in between."""
    step = max(int(np.sqrt(image.size / _SAMPLES)), 1)
    sample = np.asarray(image[::step, ::step], dtype=np.float64)
    middle = float(np.median(sample))
    few = int(_BEYOND * image.size)
    low, high = np.partition(image.ravel(), [few, image.size - 1 - few])[[few, -1 - few]]
    low, high = float(low), float(high)
    whole = np.issubdtype(image.dtype, np.integer)
    high = max(high, low + (_LEAST_SPAN if whole else 1e-6 * max(abs(low), 1e-30)))
    share = float(np.clip((middle - low) / (high - low), 1e-4, 0.999))
    exponent = float(np.clip(np.log(_MIDDLE) / np.log(share), _STRONGEST, 1.0))
    return low, high, exponent
