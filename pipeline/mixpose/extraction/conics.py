"""Arrays of ellipses: fits to points, and distances of points from them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from mixpose.records import Floats, Mask

FEWEST = 6  # points of an ellipse: five always lie on a conic

MANY = 20  # conics from which fitting all at once takes less time than one by one

SQUARED = 4  # times that a matrix is squared: ratios are raised to 16; more would underflow

_LEAST = 1e-3  # px, half-axis: points on a line fix no ellipse


class Ellipses(NamedTuple):
    """B ellipses in pixel coordinates."""

    centre: Floats  # (B, 2)
    half_axes: Floats  # (B, 2)
    angle: Floats  # (B,) radians; turns the first half-axis from u
    is_ellipse: Mask  # (B,) False where there is none: the row is a unit circle

    @property
    def area(self) -> Floats:
        """Enclosed areas (B,) in px."""
        return np.asarray(math.pi * self.half_axes.prod(axis=1))

    @property
    def length(self) -> Floats:
        """Length by width (B,)."""
        return np.asarray(self.half_axes.max(axis=1) / self.half_axes.min(axis=1))

    def select(self, chosen: Mask | NDArray[np.intp]) -> Ellipses:
        """Return the chosen rows."""
        return Ellipses._make(array[chosen] for array in self)

    def replaced(self, rows: NDArray[np.intp], others: Ellipses) -> Ellipses:
        """Return a copy with others in the given rows."""
        parts = Ellipses._make(array.copy() for array in self)
        for array, other in zip(parts, others, strict=True):
            array[rows] = other
        return parts


def ellipses_of(rows: Sequence[Sequence[float]]) -> Ellipses:
    """Make ellipses of rows: centre u, v, half-axes, and the angle of the first half-axis."""
    table = np.array(rows, dtype=np.float64).reshape(-1, 5)
    return Ellipses(table[:, :2], table[:, 2:4], table[:, 4], np.ones(len(table), dtype=np.bool_))


def no_ellipses(count: int) -> Ellipses:
    """Return `count` rows without an ellipse."""
    zeros = np.zeros((count, 2))
    return Ellipses(zeros, zeros + 1.0, zeros[:, 0], np.zeros(count, dtype=np.bool_))


def concatenated(parts: Sequence[Ellipses]) -> Ellipses:
    """Concatenate several `Ellipses`."""
    return Ellipses(*map(np.concatenate, zip(*parts)))


def fit_conics(points: Floats, chosen: Mask, oblique: float) -> Ellipses:
    """Fit ellipses to the chosen (B, n) of points (B, n, 2): conics of least mean square distance.

    This is the sum of squares of the equation over that of its gradient (Taubin, IEEE PAMI 13,
    1991).  For few conics, and those that are no ellipse, `cv2.fitEllipseAMS` does the same, or
    falls back to `cv2.fitEllipseDirect`.  `oblique` is the least width by length.
    """
    counts = chosen.sum(axis=1)
    is_ellipse = counts >= FEWEST
    # in single precision, which is exact near the ellipse only
    middle = points[np.arange(len(points)), chosen.argmax(axis=1)]
    fitted = _taubin(points - middle[:, None], chosen) if len(points) >= MANY else None
    fitted = np.full((len(points), 5), np.nan) if fitted is None else fitted
    unfitted = is_ellipse & ~np.isfinite(fitted).all(axis=1)
    offsets = (points[unfitted] - middle[unfitted, None]).astype(np.float32)[chosen[unfitted]]
    ends = [0, *np.cumsum(counts[unfitted]).tolist()]
    for k, row in enumerate(np.flatnonzero(unfitted).tolist()):
        # it moves points at random where they fix no ellipse: with this seed, always alike
        cv2.setRNGSeed(0)
        centre, (width, height), angle = cv2.fitEllipseAMS(offsets[ends[k] : ends[k + 1]])
        fitted[row] = *centre, width / 2, height / 2, math.radians(angle)
    is_ellipse &= np.isfinite(fitted).all(axis=1)
    half_axes = fitted[:, 2:4]
    is_ellipse &= half_axes.min(axis=1) >= np.maximum(oblique * half_axes.max(axis=1), _LEAST)
    fitted = np.where(is_ellipse[:, None], fitted, [0.0, 0.0, 1.0, 1.0, 0.0])
    return Ellipses(middle + fitted[:, :2], fitted[:, 2:4], fitted[:, 4], is_ellipse)


def _taubin(points: Floats, chosen: Mask) -> Floats:
    """Fit all ellipses at once: centres, half-axes, angles (B, 5); NaN where there is none."""
    w = chosen.astype(np.float64)
    count = np.maximum(w.sum(axis=1), 1.0)[:, None]
    u, v = points[..., 0], points[..., 1]
    mean_u, mean_v = np.vecdot(w, u)[:, None] / count, np.vecdot(w, v)[:, None] / count
    u, v = (u - mean_u) * w, (v - mean_v) * w
    size = np.sqrt((np.vecdot(u, u) + np.vecdot(v, v))[:, None] / count) + _LEAST
    u, v = u / size, v / size
    D = np.stack([u * u, u * v, v * v, u, v], axis=1)
    mean = D.sum(axis=2) / count
    # mean squares of the equation, with its best constant, and of its gradient
    M = D @ D.swapaxes(1, 2) / count[..., None] - mean[:, :, None] * mean[:, None]
    M += 1e-14 * np.eye(5)  # regular for points exactly on an ellipse
    N = np.zeros_like(M)
    uu, uv, vv = mean[:, :3].T
    N[:, 0, 0], N[:, 1, 1], N[:, 2, 2], N[:, 3, 3], N[:, 4, 4] = 4 * uu, uu + vv, 4 * vv, 1.0, 1.0
    N[:, 0, 1] = N[:, 1, 0] = N[:, 1, 2] = N[:, 2, 1] = 2 * uv
    K = np.linalg.solve(M, N)
    for _ in range(SQUARED):  # power iteration for the conic of the least quotient
        K = K / np.abs(K).max(axis=(1, 2), keepdims=True)
        K = K @ K
    a, b, c, d, e = (equation := K[np.arange(len(K)), :, np.abs(K).sum(axis=1).argmax(axis=1)]).T
    with np.errstate(all="ignore"):
        middle = np.array([b * e - 2 * c * d, b * d - 2 * a * e]) / (4 * a * c - b * b)
        level = np.vecdot(equation, mean) - (d * middle[0] + e * middle[1]) / 2
        half_trace, radius = (a + c) / 2, np.hypot((a - c) / 2, b / 2)
        axes = np.sqrt(level / np.array([half_trace + radius, half_trace - radius]))
        centre = middle * size[:, 0] + np.array([mean_u, mean_v])[..., 0]
    return np.stack([*centre, *(axes * size[:, 0]), 0.5 * np.arctan2(b, a - c)], axis=1)


def distances(ellipses: Ellipses, points: Floats) -> Floats:
    """Return distances (B, n) of points (B, n, 2) or (n, 2) from ellipses, positive outside.

    They are right to first order (Sampson), exact enough within a few px of the rim.
    """
    axes = ellipses.half_axes[:, None]
    # On the ellipse |scaled| is 1; its gradient is scaled / axes / |scaled|.
    scaled = (points - ellipses.centre[:, None]) @ (rotations(ellipses.angle) / axes)
    square = scaled * scaled
    slope = square / axes**2
    square = square[..., 0] + square[..., 1]
    steepness = np.sqrt(slope[..., 0] + slope[..., 1]) + 1e-12
    return np.asarray((square - np.sqrt(square)) / steepness)


def rotations(angle: Floats) -> Floats:
    """Return rotation matrices (..., 2, 2) by angles (...)."""
    matrices = np.empty((*np.shape(angle), 2, 2))
    matrices[..., 0, 0] = matrices[..., 1, 1] = np.cos(angle)
    matrices[..., 1, 0] = np.sin(angle)
    matrices[..., 0, 1] = -matrices[..., 1, 0]
    return matrices
