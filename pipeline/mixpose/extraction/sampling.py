"""Grey values between pixels."""

from __future__ import annotations

import math

import cv2
import numpy as np

from mixpose.extraction.background import Grey
from mixpose.records import Floats

# OpenCV takes maps with sides below 32767.
MOST_ROWS = 30000


def sample(grey: Grey, places: Floats) -> Floats:
    """Bilinear samples of an image.

    Parameters
    ----------
    grey : (H, W) uint8, uint16 or float32
    places : (n, k, 2) float64
        Pixel coordinates u, v.

    Returns
    -------
    (n, k) float64
        Outside of the image, the nearest pixel's value.
    """
    if places.size == 0:
        return np.empty(places.shape[:2])
    (left, top), (right, bottom) = places.min(axis=(0, 1)), places.max(axis=(0, 1))
    u0 = min(max(math.floor(left) - 1, 0), grey.shape[1] - 1)
    v0 = min(max(math.floor(top) - 1, 0), grey.shape[0] - 1)
    u1, v1 = max(math.ceil(right) + 2, u0 + 1), max(math.ceil(bottom) + 2, v0 + 1)
    # In single precision, as OpenCV would round samples of integers to integers.
    patch = grey[v0:v1, u0:u1].astype(np.float32, copy=False)
    u, v = (places[..., 0] - u0).astype(np.float32), (places[..., 1] - v0).astype(np.float32)
    rows = range(0, len(u), MOST_ROWS)
    parts = [_remap(patch, u[row : row + MOST_ROWS], v[row : row + MOST_ROWS]) for row in rows]
    return np.asarray(parts[0] if len(parts) == 1 else np.concatenate(parts), dtype=np.float64)


def _remap(patch: Grey, u: Grey, v: Grey) -> Grey:
    return cv2.remap(patch, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
