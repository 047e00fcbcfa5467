"""Grey values between pixels."""

from __future__ import annotations

import math
from collections.abc import Sequence

import cv2
import numpy as np
from numpy.lib.stride_tricks import as_strided

from mixpose.extraction.background import Grey
from mixpose.records import Floats, Indices, Singles

# OpenCV takes maps with sides below 32767.
MOST_ROWS = 30000

# Height of a stack of parts: coordinates in single precision are exact to 1e-4 px there.
STACK_ROWS = 2000


def sample(grey: Grey, places: Floats) -> Floats:
    """Return bilinear samples (n, k) of an image (H, W) at pixel coordinates u, v (n, k, 2).

    Outside of the image they have the value of the nearest pixel.
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


def patches_of(grey: Grey, shape: tuple[int, int]) -> Grey:
    """Return a read-only view of all patches of a shape of an image, indexed by the first pixel.

    `np.lib.stride_tricks.sliding_window_view` does the same, but takes longer than copying a few.
    """
    rows, columns = (whole - side + 1 for whole, side in zip(grey.shape, shape, strict=True))
    return as_strided(grey, (rows, columns, *shape), grey.strides * 2, writeable=False)


def sample_lines(
    greys: Sequence[Grey], which: Indices, places: Floats, steps: Floats, offsets: Floats
) -> Singles:
    """Sample lines in images `which` (B,), at `offsets` (k,) times `steps` from places.

    Places and steps are (2, B, n), u and v; samples are (k, B, n), as those of `sample`.  Only the
    part around each feature is converted to single precision, not the image between them.
    """
    samples = np.empty((len(offsets), *places.shape[1:]), np.float32)
    ends = places + steps * offsets.min(), places + steps * offsets.max()
    lower, upper = np.minimum(*ends).min(axis=2).T, np.maximum(*ends).max(axis=2).T
    distances = offsets.astype(np.float32)[:, None, None]
    for number in sorted(set(which.tolist())):
        rows, grey = (which == number).nonzero()[0], greys[number]
        last = np.array(grey.shape[::-1]) - 1
        inside = np.minimum(np.maximum([lower[rows], upper[rows]], 0.0), last)
        first, end = inside.astype(np.intp)
        # the last pixel's neighbour has no weight, but must exist
        sides = np.minimum(end - first + 2, last + 1)
        order = np.argsort(sides.max(axis=1))
        while order.size:
            # parts are as large as the largest of them, in a stack of limited height
            stacked = np.maximum.accumulate(sides[order, 1]) * np.arange(1, order.size + 1)
            count = max(int(np.searchsorted(stacked, STACK_ROWS, side="right")), 1)
            chosen, order = order[:count], order[count:]
            selected, (width, height) = rows[chosen], sides[chosen].max(axis=0).tolist()
            corners = np.minimum(first[chosen], last + 1 - (width, height))
            parts = patches_of(grey, (height, width))[corners[:, 1], corners[:, 0]]
            parts = parts.astype(np.float32)
            maps = []
            for axis in (0, 1):
                on_part = (places[axis, selected] - corners[:, axis, None]).astype(np.float32)
                maps.append(on_part + steps[axis, selected].astype(np.float32) * distances)
                if lower[selected, axis].min() < 0 or upper[selected, axis].max() > last[axis]:
                    ends = -corners[:, axis], last[axis] - corners[:, axis]
                    np.clip(maps[-1], *(end[:, None] for end in ends), out=maps[-1])
            maps[1] += (np.arange(count, dtype=np.float32) * height)[:, None]
            u, v = (sampled.reshape(-1, count * places.shape[2]) for sampled in maps)
            stack = parts.reshape(-1, width)
            samples[:, selected] = _remap(stack, u, v).reshape(-1, count, places.shape[2])
    return samples
