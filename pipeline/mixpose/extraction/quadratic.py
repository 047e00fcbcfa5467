"""Places to parts of a pixel: stationary points of quadratics through grey values, in a window."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from mixpose.extraction.background import Grey
from mixpose.extraction.sampling import sample
from mixpose.extraction.threshold import Window
from mixpose.records import Floats, Image, PointPattern

# Half the side of the square to which the quadratic is fitted, in steps.
FIT_RADIUS = 2
FIT_STEPS = 3

# Of the coefficients of u², uv and v²: whether they are those of what is looked for.
Wanted = Callable[[Floats, Floats, Floats], NDArray[np.bool_]]


def points_in(image: Image, window: Window, find: Callable[[Image], Floats]) -> PointPattern:
    """What `find` finds in a window (u0, v0, u1, v1), in pixels of the whole image, of weight 1.

    It takes the part of the image in the window, not empty, to places (n, 2) in its pixels.
    """
    u0, v0, u1, v1 = window
    found = find(image[v0:v1, u0:u1])
    return PointPattern(found + np.array([u0, v0]), np.ones(len(found)))


def stationary_points(
    grey: Grey, rough: Floats, wanted: Wanted, step: float = 1.0
) -> tuple[Floats, NDArray[np.bool_]]:
    """Stationary points (m, 2) of quadratics about rough places (n, 2), and which of them have one.

    `wanted` tells by the second derivatives which are looked for; a quadratic goes through 5 x 5
    samples, `step` px apart.  Places (n,) have one where it is wanted and the fit stayed close by.
    """
    side = np.arange(-FIT_RADIUS, FIT_RADIUS + 1.0)
    v, u = (axis.ravel() for axis in np.meshgrid(side, side, indexing="ij"))
    fit = np.linalg.pinv(np.stack([u * u, u * v, v * v, u, v, np.ones_like(u)], axis=-1))
    offsets = step * np.stack([u, v], axis=-1)
    points = rough
    fitted = np.ones(len(rough), dtype=np.bool_)
    for _ in range(FIT_STEPS):
        uu, uv, vv, du, dv, _ = fit @ sample(grey, points[:, None] + offsets).T
        good = wanted(uu, uv, vv)
        determinant = np.where(good, 4 * uu * vv - uv * uv, -1.0)
        shift = np.stack([uv * dv - 2 * vv * du, uv * du - 2 * uu * dv], axis=-1)
        shift = step * np.clip(shift / determinant[:, None], -1, 1)
        points = points + np.where(good[:, None], shift, 0)
        away = np.abs(points - rough).max(axis=-1, initial=0)
        fitted &= good & (away < FIT_RADIUS * step + 1)
    return points[fitted], fitted
