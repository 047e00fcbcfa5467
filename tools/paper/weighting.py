"""The paper's weighting w(s): the density of the difference averaged around zero.

∫ w(s) f(s) ds instead of f(0) is, for one sensor, the same objective on the density g averaged with
w; for several sensors and a w that is a product over sensors, each g_l is averaged with its own.  A
Gaussian w is one more blur.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from mixpose.density import Density


def weighted(density: Density, w: NDArray[np.float32]) -> Density:
    """Average a density with a weighting function.

    Parameters
    ----------
    density : Density
    w : (a, b) float32
        Non-negative weights on the steps of the density, s = 0 in the middle; a and b are odd,
        a is 1 for ranges.  They are scaled to sum to 1.

    Returns
    -------
    Density
        (g ⋆ w)(y) = Σ_s w(s) g(y + s), with its gradient where the density has one; zero is
        assumed beyond the window.

    Raises
    ------
    ValueError
        If the weights are negative, all zero, or even in number along an axis.
    """
    if w.min() < 0 or not w.any() or any(side % 2 == 0 for side in w.shape):
        raise ValueError("weights: non-negative, not all zero, and odd in number along each axis")
    kernel = (w / w.sum(dtype=np.float64)).astype(np.float32)
    values = cv2.filter2D(density.values, cv2.CV_32F, kernel, borderType=cv2.BORDER_CONSTANT)
    averaged = np.asarray(values, dtype=np.float32).reshape(density.values.shape)
    return replace(density, values=averaged)
