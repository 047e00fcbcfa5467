"""Grey values between pixels."""

from __future__ import annotations

import math
from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from mixpose.extraction.background import Grey
from mixpose.records import Floats

# OpenCV takes maps with sides below 32767.
MOST_ROWS = 30000

# Of parts that are stacked: places in single precision are exact to 1e-4 px there.
STACK_ROWS = 2000


def sample(grey: Grey, places: Floats) -> Floats:
    """Bilinear samples (n, k) of an image (H, W) at pixel coordinates u, v (n, k, 2).

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


def sample_each(greys: Sequence[Grey], u: Floats, v: Floats) -> NDArray[np.float32]:
    """As `sample`, at u and v (B, n) of B features, of each near each other, in an image for each.

    Only what is around each feature is turned into single precision, not all between them.
    """
    heights, widths = np.array([grey.shape for grey in greys]).T
    across, left, columns = _part(u, widths)
    down, top, rows = _part(v, heights)
    samples = np.empty(u.shape, np.float32)
    order = np.argsort(np.maximum(rows, columns))
    while order.size:
        # parts as large as the largest of them, in a stack that is not too high
        stacked = np.maximum.accumulate(rows[order]) * np.arange(1, order.size + 1)
        count = max(int(np.searchsorted(stacked, STACK_ROWS, side="right")), 1)
        some, order = order[:count], order[count:]
        height, width = int(rows[some].max()), int(columns[some].max())
        parts = np.zeros((count, height, width), np.float32)
        corners = zip(some.tolist(), left[some].tolist(), top[some].tolist(), strict=True)
        for part, (k, u0, v0) in zip(parts, corners, strict=True):
            patch = greys[k][v0 : v0 + height, u0 : u0 + width]
            part[: patch.shape[0], : patch.shape[1]] = patch
        below = (np.arange(count, dtype=np.float32) * height)[:, None]
        samples[some] = _remap(parts.reshape(-1, width), across[some], down[some] + below)
    return samples


def _part(
    places: Floats, sizes: NDArray[np.intp]
) -> tuple[NDArray[np.float32], NDArray[np.intp], NDArray[np.intp]]:
    """Places (B, n) within parts of one side (B,) of images, where these begin, their lengths."""
    inside = np.minimum(np.maximum(places, 0), sizes[:, None] - 1.0)
    first = inside.min(axis=1).astype(np.intp)
    # the last pixel's neighbour is not looked at, but has to be there
    lengths = (inside.max(axis=1) - first).astype(np.intp) + 2
    return (inside - first[:, None]).astype(np.float32), first, lengths
