"""Locate points to parts of a pixel, by stationary points of quadratics through grey values."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from mixpose.extraction.background import Grey
from mixpose.extraction.sampling import sample
from mixpose.extraction.threshold import Window
from mixpose.records import Floats, Image, PointPattern

# Half the side of the square to which a quadratic is fitted, in steps.
FIT_RADIUS = 2
FIT_STEPS = 3

# Test by the coefficients of u², uv and v² whether a stationary point is of the kind wanted.
IsWanted = Callable[[Floats, Floats, Floats], NDArray[np.bool_]]


def points_in(
    image: Image, window: Window, margin: int, find: Callable[[Image], Floats]
) -> PointPattern:
    """Return the points of `find` in a window (u0, v0, u1, v1), in pixels of the whole image.

    `find` maps the image in the window to points (n, 2) in its pixels; there are none where the
    window is no larger than a margin in px on each side.  Weights are 1.
    """
    u0, v0, u1, v1 = window
    part = image[v0:v1, u0:u1]
    points = np.empty((0, 2)) if min(part.shape) <= 2 * margin else find(part)
    return PointPattern(points + np.array([u0, v0]), np.ones(len(points)))


def stationary_points(
    grey: Grey, starts: Floats, is_wanted: IsWanted, step: float = 1.0
) -> tuple[Floats, NDArray[np.bool_]]:
    """Return stationary points (m, 2) of quadratics near starts (n, 2), and which starts have one.

    A quadratic is fitted to 5 x 5 samples, `step` px apart.  A start has a stationary point if
    `is_wanted` is true of its second derivatives and it is close by.
    """
    side = np.arange(-FIT_RADIUS, FIT_RADIUS + 1.0)
    v, u = (axis.ravel() for axis in np.meshgrid(side, side, indexing="ij"))
    fit = np.linalg.pinv(np.stack([u * u, u * v, v * v, u, v, np.ones_like(u)], axis=-1))
    offsets = step * np.stack([u, v], axis=-1)
    points = starts
    is_fitted = np.ones(len(starts), dtype=np.bool_)
    for _ in range(FIT_STEPS):
        uu, uv, vv, du, dv, _ = fit @ sample(grey, points[:, None] + offsets).T
        is_good = is_wanted(uu, uv, vv)
        determinant = np.where(is_good, 4 * uu * vv - uv * uv, -1.0)
        shift = np.stack([uv * dv - 2 * vv * du, uv * du - 2 * uu * dv], axis=-1)
        shift = step * np.clip(shift / determinant[:, None], -1, 1)
        points = points + np.where(is_good[:, None], shift, 0)
        distances = np.abs(points - starts).max(axis=-1, initial=0)
        is_fitted &= is_good & (distances < FIT_RADIUS * step + 1)
    return points[is_fitted], is_fitted
