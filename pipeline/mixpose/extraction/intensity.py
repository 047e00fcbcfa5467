"""Grey values as the feature pattern: for features that no point stands for."""

from __future__ import annotations

import numpy as np

from mixpose.extraction.options import ExtractOptions
from mixpose.extraction.threshold import Window, feature_values
from mixpose.records import GridPattern, Image, Pattern, PointPattern


def extract_intensity(image: Image, options: ExtractOptions, window: Window) -> Pattern:
    """Return the grey values above the threshold in a window (u0, v0, u1, v1), less the background.

    The step is 1 px; values are zero where no feature is, and an empty PointPattern stands for
    zero everywhere.  Areas are not used.
    """
    values = feature_values(image, options, window)
    if not values.any():
        return PointPattern(np.empty((0, 2)), np.empty(0))
    return GridPattern(values, np.array(window[:2], dtype=np.float64), 1.0)
