"""Features that are points of one weight, found in a window of an image."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from mixpose.extraction.threshold import Window
from mixpose.records import Floats, Image, PointPattern


def points_in(image: Image, window: Window, find: Callable[[Image], Floats]) -> PointPattern:
    """What `find` finds in a window (u0, v0, u1, v1), in pixels of the whole image, of weight 1.

    It takes the part of the image in the window, not empty, to places (n, 2) in its pixels.
    """
    u0, v0, u1, v1 = window
    found = find(image[v0:v1, u0:u1])
    return PointPattern(found + np.array([u0, v0]), np.ones(len(found)))
