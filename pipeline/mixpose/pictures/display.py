"""Frames made visible: any grey image as an 8-bit picture in which dark frames are legible."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from mixpose.pictures.canvas import Picture

# Grey levels are stretched from this share of the pixels to that: a hot pixel or two do not count,
# a few small spots in a dark frame do.
_DARKEST, _BRIGHTEST = 0.005, 0.99998
_MIDDLE = 0.2  # where the median grey value of a dark frame is brought to
_STRONGEST = 0.45  # exponent, lest noise is all one sees
_SAMPLES = 200_000


def displayable(image: NDArray[Any]) -> Picture:
    """Stretch the contrast of a grey image, and brighten it where most of it is dark.

    Parameters
    ----------
    image : (H, W) array
        Finite grey values of any type.

    Returns
    -------
    (H, W, 3) uint8
        Blue, green and red alike.
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
    low, middle = np.quantile(sample, [_DARKEST, 0.5])
    least = 1.0 if np.issubdtype(image.dtype, np.integer) else 1e-12 * max(abs(low), 1e-300)
    high = max(_bright_end(image), low + least)
    share = float(np.clip((middle - low) / (high - low), 1e-4, 0.999))
    exponent = float(np.clip(np.log(_MIDDLE) / np.log(share), _STRONGEST, 1.0))
    return float(low), float(high), exponent


def _bright_end(image: NDArray[Any]) -> float:
    """The grey value that all but a few pixels stay below."""
    few = max(int((1 - _BRIGHTEST) * image.size), 1)
    flat = image.ravel()
    return float(np.partition(flat, flat.size - 1 - few)[flat.size - 1 - few])
