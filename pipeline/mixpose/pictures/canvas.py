"""Marks, lines and words on pictures, each with a dark rim: legible on bright and dark frames.

A picture is (H, W, 3) uint8, blue-green-red as OpenCV has it.  Everything here draws in place,
at places (u, v) in pixels of the picture, pixel centres at integers.
"""

from __future__ import annotations

from functools import cache
from typing import TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from mixpose.records import Floats

Picture: TypeAlias = NDArray[np.uint8]
Colour: TypeAlias = tuple[int, int, int]

BLACK: Colour = (0, 0, 0)
WHITE: Colour = (255, 255, 255)
GREY: Colour = (160, 160, 160)

_SHIFT = 4  # binary digits of a pixel's parts in OpenCV's drawing functions
_FAR = 1e5  # px; beyond it those functions overflow
_REFERENCE_SIDE = 600  # px of a picture on which strokes are one pixel wide
_TEXT_PX = 15
_WEIGHT = 600  # of letters; regular is 400


def stroke(picture: Picture) -> float:
    """Width of a thin line in px that is as visible on large pictures as on small ones."""
    return max(float(min(picture.shape[:2])) / _REFERENCE_SIDE, 1.0)


def polyline(
    picture: Picture, places: Floats, colour: Colour, *, width: float = 1.0, closed: bool = False
) -> None:
    """Draw a line through places (n, 2), `width` thin strokes wide."""
    if len(places) < 2 or not np.isfinite(places).all() or np.abs(places).max() > _FAR:
        return
    thin = stroke(picture) * width
    fixed = [np.round(places * 2**_SHIFT).astype(np.int32)]
    for each, pixels in ((BLACK, thin + 2 * stroke(picture)), (colour, thin)):
        cv2.polylines(picture, fixed, closed, each, max(round(pixels), 1), cv2.LINE_AA, _SHIFT)


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
    """Write text from a place on its baseline on, and return where it ends, u in px.

    `size` 1 is for captions.
    """
    pixels = max(round(_TEXT_PX * stroke(picture) * size), 9)
    rim = max(round(pixels / 14), 1)
    u, v = round(place[0]), round(place[1])
    offsets = [(a, b) for a in (-rim, 0, rim) for b in (-rim, 0, rim) if a or b]
    for du, dv in offsets:
        cv2.putText(picture, text, (u + du, v + dv), BLACK, _face(), pixels, _WEIGHT)
    cv2.putText(picture, text, (u, v), colour, _face(), pixels, _WEIGHT)
    size_of_picture = picture.shape[1], picture.shape[0]
    left, _, width, _ = cv2.getTextSize(size_of_picture, text, (u, v), _face(), pixels, _WEIGHT)
    return float(left + width)


def line_height(picture: Picture) -> float:
    """Distance of two lines of captions in px."""
    return 1.5 * _TEXT_PX * stroke(picture)


@cache
def _face() -> cv2.FontFace:
    return cv2.FontFace("sans")
