"""Make frames visible, draw marks, lines and words on them, and arrange pictures in grids.

A picture is (H, W, 3) uint8, blue-green-red as in OpenCV.  Marks, lines and words have a dark rim,
so that they are legible on bright and dark frames; they are drawn in place, at places (u, v) in
pixels of the picture, pixel centres at integers.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import Any, TypeAlias

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from mixpose.records import Floats

Picture: TypeAlias = NDArray[np.uint8]
Size: TypeAlias = tuple[int, int]  # width and height, px
Colour: TypeAlias = tuple[int, int, int]

BLACK: Colour = (0, 0, 0)
WHITE: Colour = (255, 255, 255)
GREY: Colour = (160, 160, 160)

_SHIFT = 4  # fractional bits of coordinates in OpenCV's drawing functions
_FAR = 1e5  # px; larger coordinates overflow in these functions
_REFERENCE_SIDE = 600  # px of a picture on which strokes are one pixel wide
_TEXT_PX = 15
_WEIGHT = 600  # of the font; regular is 400
_GAP_PX = 4
_GAP_GREY = 70
_BEYOND = 2e-5  # share of pixels clipped to black and to white: hot pixels, not small spots
_LEAST_SPAN = 16.0  # grey levels of an integer image, lest noise fill the picture
_MIDDLE = 0.2  # brightness to which the median of a dark frame is raised
_STRONGEST = 0.45  # least exponent, lest noise dominate the picture
_SAMPLES = 200_000


def stroke(picture: Picture) -> float:
    """Return the width in px of a thin line, in proportion to the size of a picture, at least 1."""
    return max(float(min(picture.shape[:2])) / _REFERENCE_SIDE, 1.0)


def polyline(
    picture: Picture, places: ArrayLike, colour: Colour, *, width: float = 1.0, closed: bool = False
) -> None:
    """Draw a line through places (n, 2), `width` thin strokes wide."""
    places = np.asarray(places, dtype=np.float64)
    if len(places) < 2 or not np.isfinite(places).all() or np.abs(places).max() > _FAR:
        return
    thin = stroke(picture) * width
    fixed = [np.round(places * 2**_SHIFT).astype(np.int32)]
    for ink, pixels in ((BLACK, thin + 2 * stroke(picture)), (colour, thin)):
        cv2.polylines(picture, fixed, closed, ink, max(round(pixels), 1), cv2.LINE_AA, _SHIFT)


def ring(picture: Picture, place: Floats, radius: float, colour: Colour) -> None:
    """Draw a circle of a radius in px."""
    turn = np.linspace(0, 2 * np.pi, 33)[:-1]
    circle = place + radius * np.stack([np.cos(turn), np.sin(turn)], axis=-1)
    polyline(picture, circle, colour, closed=True)


def cross(picture: Picture, place: Floats, inner: float, outer: float, colour: Colour) -> None:
    """Draw an upright cross that leaves its middle free, arms from `inner` to `outer` px."""
    for direction in ((1, 0), (-1, 0), (0, 1), (0, -1)):
        arm = np.array([[inner], [outer]]) * np.array(direction)
        polyline(picture, place + arm, colour)


def words(
    picture: Picture, text: str, place: tuple[float, float], colour: Colour, *, size: float = 1.0
) -> float:
    """Write text from a place on its baseline; return the u of its end in px."""
    pixels = _letters(picture, size)
    rim = max(round(pixels / 14), 1)
    u, v = round(place[0]), round(place[1])
    offsets = [(a, b) for a in (-rim, 0, rim) for b in (-rim, 0, rim) if a or b]
    for du, dv in offsets:
        cv2.putText(picture, text, (u + du, v + dv), BLACK, _face(), pixels, _WEIGHT)
    cv2.putText(picture, text, (u, v), colour, _face(), pixels, _WEIGHT)
    return u + width_of(picture, text, size=size)


def width_of(picture: Picture, text: str, *, size: float = 1.0) -> float:
    """Return the width of text on a picture, in px."""
    shape, pixels = (picture.shape[1], picture.shape[0]), _letters(picture, size)
    offset, _, width, _ = cv2.getTextSize(shape, text, (0, 0), _face(), pixels, _WEIGHT)
    return float(offset + width)


def _letters(picture: Picture, size: float) -> int:
    """Return the height of letters in px."""
    return max(round(_TEXT_PX * stroke(picture) * size), 9)


def caption_place(picture: Picture, line: int = 0) -> tuple[float, float]:
    """Return the start of a line of captions in the upper left corner."""
    return 0.5 * line_height(picture), (line + 1.1) * line_height(picture)


def line_height(picture: Picture) -> float:
    """Return the distance of two lines of captions in px."""
    return 1.5 * _TEXT_PX * stroke(picture)


@cache
def _face() -> cv2.FontFace:
    return cv2.FontFace("sans")


def columns_for(count: int) -> int:
    """Return the number of columns for a number of pictures."""
    return count if count <= 3 else int(np.ceil(np.sqrt(count)))


def fit_into(picture: Picture, size: Size) -> Picture:
    """Centre a picture on black of a width and height; shrink it if it is larger."""
    width, height = size
    zoom = min(width / picture.shape[1], height / picture.shape[0], 1.0)
    if zoom < 1.0:
        shrunk = max(int(picture.shape[1] * zoom), 1), max(int(picture.shape[0] * zoom), 1)
        picture = np.asarray(cv2.resize(picture, shrunk, interpolation=cv2.INTER_AREA), np.uint8)
    canvas = np.zeros((height, width, 3), np.uint8)
    v, u = (height - picture.shape[0]) // 2, (width - picture.shape[1]) // 2
    canvas[v : v + picture.shape[0], u : u + picture.shape[1]] = picture
    return canvas


def in_grid(pictures: Sequence[Picture], columns: int, cell: Size | None = None) -> Picture:
    """Arrange pictures in rows with gaps, in cells of (width, height) if given."""
    width = cell[0] if cell else max(picture.shape[1] for picture in pictures)
    rows = []
    for k in range(0, len(pictures), columns):
        row = list(pictures[k : k + columns])
        height = cell[1] if cell else max(picture.shape[0] for picture in row)
        cells = [fit_into(picture, (width, height)) for picture in row]
        cells += [np.zeros((height, width, 3), np.uint8)] * (columns - len(cells))
        rows.append(_joined(cells, axis=1))
    return _joined(rows, axis=0)


def stacked(pictures: Sequence[Picture]) -> Picture:
    """Arrange pictures one below the other; pad narrower ones with black."""
    return in_grid(pictures, 1)


def _joined(pictures: Sequence[Picture], axis: int) -> Picture:
    """Concatenate pictures along an axis, with gaps between them."""
    shape = [*pictures[0].shape]
    shape[axis] = _GAP_PX
    gap = np.full(shape, _GAP_GREY, np.uint8)
    parts = [part for picture in pictures for part in (gap, picture)][1:]
    return np.concatenate(parts, axis=axis)


def displayable(image: NDArray[Any]) -> Picture:
    """Convert a grey image (H, W) of any type: stretch its contrast, and brighten it if dark."""
    # grey values that become black and white, and the exponent in between
    step = max(int(np.sqrt(image.size / _SAMPLES)), 1)
    middle = float(np.median(np.asarray(image[::step, ::step], dtype=np.float64)))
    cut = int(_BEYOND * image.size)
    low, high = np.partition(image.ravel(), [cut, image.size - 1 - cut])[[cut, -1 - cut]].tolist()
    is_integer = np.issubdtype(image.dtype, np.integer)
    high = max(high, low + (_LEAST_SPAN if is_integer else 1e-6 * max(abs(low), 1e-30)))
    share = float(np.clip((middle - low) / (high - low), 1e-4, 0.999))
    exponent = float(np.clip(np.log(_MIDDLE) / np.log(share), _STRONGEST, 1.0))

    def curve(values: NDArray[Any]) -> NDArray[np.uint8]:
        share = (values.astype(np.float32) - np.float32(low)) / np.float32(high - low)
        return np.asarray(np.round(255 * np.clip(share, 0, 1) ** exponent), dtype=np.uint8)

    if np.issubdtype(image.dtype, np.unsignedinteger):
        grey = curve(np.arange(np.iinfo(image.dtype).max + 1))[image]  # a look-up table is fast
    else:
        grey = curve(image)
    return np.asarray(cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR), dtype=np.uint8)
