"""Grey values between pixels."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

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
    """As `sample`, at u and v (B, n, k) of B features, along lines, in an image (H, W) for each.

    Only what is around each feature is turned into single precision, not all between them.
    """
    heights, widths = np.array([grey.shape for grey in greys]).T
    across, left, columns = _part(u, widths)
    down, top, rows = _part(v, heights)
    samples = np.empty(across.shape, np.float32)
    for some in _lots(rows, columns):
        of_each = zip(np.arange(len(u))[some].tolist(), left[some].tolist(), top[some].tolist())
        height, width = int(rows[some].max()), int(columns[some].max())
        parts = np.zeros((len(rows[some]), height, width), np.float32)
        for part, (k, u0, v0) in zip(parts, of_each, strict=True):
            patch = greys[k][v0 : v0 + height, u0 : u0 + width]
            part[: patch.shape[0], : patch.shape[1]] = patch
        below = (np.arange(len(parts), dtype=np.float32) * height)[:, None]
        samples[some] = _remap(parts.reshape(-1, width), across[some], down[some] + below)
    return samples.reshape(u.shape)


def _lots(rows: NDArray[np.intp], columns: NDArray[np.intp]) -> Iterator[slice | NDArray[np.intp]]:
    """Which parts, of rows and columns (B,), are stacked, each as high as the highest of them."""
    if len(rows) * rows.max() <= STACK_ROWS:
        yield np.s_[:]
        return
    order = np.argsort(np.maximum(rows, columns))
    while order.size:
        stacked = np.maximum.accumulate(rows[order]) * np.arange(1, order.size + 1)
        count = max(int(np.searchsorted(stacked, STACK_ROWS, side="right")), 1)
        yield order[:count]
        order = order[count:]


def _part(
    places: Floats, sizes: NDArray[np.intp]
) -> tuple[NDArray[np.float32], NDArray[np.intp], NDArray[np.intp]]:
    """Places (B, n * k) within parts of one side (B,) of images, their first pixels and lengths."""
    # what is farthest is at the ends of lines
    ends = places[..., [0, -1]].reshape(len(places), -1)
    low, high = ends.min(axis=1), ends.max(axis=1)
    if low.min() < 0 or (high > sizes - 1).any():
        places = np.minimum(np.maximum(places, 0), sizes[:, None, None] - 1.0)
        low, high = (np.minimum(np.maximum(end, 0), sizes - 1) for end in (low, high))
    first = low.astype(np.intp)
    inside = (places - first[:, None, None]).astype(np.float32).reshape(len(places), -1)
    # the last pixel's neighbour is not looked at, but has to be there
    return inside, first, (high - first).astype(np.intp) + 2
