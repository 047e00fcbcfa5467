"""The background of an image: a coarse map of it, and its noise.

Uneven light is taken out by medians of tiles, bilinear in between, so that one level serves the
whole frame.  A tile is a fifth of the shorter side: light changes over a frame rather than over
so many pixels.  Features up to half the shorter side are taken out by medians over tiles.
"""

from __future__ import annotations

import math
from typing import Any, TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

# (H, W) uint8, uint16 or float32, as OpenCV takes and gives them.
Grey: TypeAlias = NDArray[np.integer[Any] | np.floating[Any]]

TILES_PER_SHORT_SIDE = 5
LEAST_TILE_PX = 16
SAMPLES_PER_TILE_SIDE = 16

# Noise is measured between pixels so far apart: interpolated or compressed pixels are more
# alike than noise would make them.
NOISE_SPACING_PX = 3


def background_tiles(image: Grey) -> Grey:
    """Coarse map of the background.

    Parameters
    ----------
    image : (H, W) uint8, uint16 or float32

    Returns
    -------
    (rows, columns) array of the type of the image
        Medians of the tiles into which the image divides.
    """
    tile = tile_side(image)
    rows, v = _sample_places(image.shape[0], tile)
    columns, u = _sample_places(image.shape[1], tile)
    places = image[np.ix_(v, u)].reshape(rows, v.size // rows, columns, u.size // columns)
    tiles = _median(places.swapaxes(1, 2).reshape(rows, columns, -1))
    # A feature that fills tiles must not become background.  Too low a background only lets
    # more of it be looked at, too high a one hides features.
    return cv2.min(cv2.medianBlur(tiles, 3), cv2.medianBlur(tiles, 5))


def spread_out(tiles: Grey, image: Grey) -> Grey:
    """Background of every pixel of an image (H, W), in its type, from its tiles.

    Bilinear between the middles of tiles, and on in a straight line to the border.
    """
    rows, columns = tiles.shape
    height, width = image.shape
    v_mode, u_mode = ((1, 1) if count > 1 else (0, 0) for count in (rows, columns))
    padded = np.pad(tiles.astype(np.float32), (v_mode, u_mode), "reflect", reflect_type="odd")
    padded = np.pad(padded, [(1 - mode[0],) * 2 for mode in (v_mode, u_mode)], "edge")
    if image.dtype != np.float32:
        padded = np.clip(padded, 0, np.iinfo(np.uint16).max if image.dtype == np.uint16 else 255)
    tile_height, tile_width = height // rows, width // columns
    size = ((columns + 2) * tile_width, (rows + 2) * tile_height)
    spread = cv2.resize(padded.astype(image.dtype), size, interpolation=cv2.INTER_LINEAR)
    return spread[tile_height : tile_height + height, tile_width : tile_width + width]


def noise_of(image: Grey) -> float:
    """Robust standard deviation of a pixel of an image (H, W), shading and features apart."""
    if image.shape[1] <= 2 * NOISE_SPACING_PX:
        return 0.0 if image.dtype == np.float32 else 1.0
    tile = tile_side(image)
    _, v = _sample_places(image.shape[0], tile)
    _, u = _sample_places(image.shape[1] - 2 * NOISE_SPACING_PX, tile)
    rows = image[v].astype(np.float32)
    left, middle, right = (rows[:, u + shift * NOISE_SPACING_PX] for shift in range(3))
    # A straight slope of light has no second difference.
    deviations = np.abs(2 * middle - left - right).ravel() / math.sqrt(6)
    typical = float(_median(deviations))
    if image.dtype != np.float32:
        # Whole grey values hide a noise that is smaller than themselves.
        typical = max(typical, 1.0)
    # The mean is finer than the median where grey values are whole.
    deviations = deviations[deviations <= 4 * typical]
    noise = math.sqrt(math.pi / 2) * float(deviations.mean())
    return noise if image.dtype == np.float32 else max(noise, 1.0)


def tile_side(image: Grey) -> int:
    """About how wide and high a tile is, in px."""
    height, width = image.shape
    return max(int(min(height, width)) // TILES_PER_SHORT_SIDE, LEAST_TILE_PX)


def _sample_places(side: int, about: int) -> tuple[int, NDArray[np.intp]]:
    """Number of tiles along a side, and the pixels of each that are looked at, in a row."""
    tiles = max(round(side / about), 1)
    tile = side // tiles
    step = max(tile // SAMPLES_PER_TILE_SIDE, 1)
    inside = np.arange(step // 2, tile, step)
    return tiles, (np.arange(tiles)[:, None] * tile + inside).ravel()


def _median(values: Grey) -> Grey:
    """Upper median along the last axis: one of the values, hence exact for integers."""
    middle = values.shape[-1] // 2
    return np.asarray(np.partition(values, middle, axis=-1)[..., middle])
