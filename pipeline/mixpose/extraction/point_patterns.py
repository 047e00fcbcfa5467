"""Features that are points of one weight, found in a window of an image."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from mixpose.extraction.threshold import Window
from mixpose.records import Floats, Image, PointPattern


def points_in(image: Image, window: Window, find: Callable[[Image], Floats]) -> PointPattern:
    """What is found in a window of an image.

    Parameters
    ----------
    image : (H, W) uint8, uint16 or float32
    window : (u0, v0, u1, v1)
        Non-empty box inside the image, u1 and v1 exclusive.
    find : callable
        Takes the part of the image in the window to places (n, 2) in its pixels.

    Returns
    -------
    PointPattern
        Points in pixels of the whole image, each of weight 1; none where nothing is found.
    """
    u0, v0, u1, v1 = window
    found = find(image[v0:v1, u0:u1])
    return PointPattern(found + np.array([u0, v0]), np.ones(len(found)))
