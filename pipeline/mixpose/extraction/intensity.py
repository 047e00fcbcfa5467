"""The grey values themselves as feature pattern: for features without a point to stand for them."""

from __future__ import annotations

import numpy as np

from mixpose.extraction.options import ExtractOptions
from mixpose.extraction.threshold import Window, feature_values
from mixpose.records import GridPattern, Image, Pattern, PointPattern


def extract_intensity(image: Image, options: ExtractOptions, window: Window) -> Pattern:
    """Grey values above the threshold, without the background, of a window (u0, v0, u1, v1).

    A step of 1 px, zero where no feature is; an empty PointPattern if that is everywhere.  Areas
    do not matter.
    """
    values = feature_values(image, options, window)
    if not values.any():
        return PointPattern(np.empty((0, 2)), np.empty(0))
    return GridPattern(values, np.array(window[:2], dtype=np.float64), 1.0)
