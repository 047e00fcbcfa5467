"""Ellipses side by side: fitted to points, and distances from them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from mixpose.records import Floats, Mask

FEWEST = 6  # points of an ellipse: five always lie on a conic

MANY = 20  # conics from which on all at once take less than one by one

SQUARED = 4  # times: of two quotients the larger counts as its 16th power; more would underflow

_LEAST = 1e-3  # px, of a half-axis: points on a line make none


class Ellipses(NamedTuple):
    """B ellipses in pixel coordinates."""

    centre: Floats  # (B, 2)
    half_axes: Floats  # (B, 2)
    angle: Floats  # (B,) radians; turns the first half-axis from u
    sound: Mask  # (B,) which of them are ellipses; the others are unit circles

    @property
    def area(self) -> Floats:
        """Enclosed areas (B,) in px."""
        return np.asarray(math.pi * self.half_axes.prod(axis=1))

    @property
    def length(self) -> Floats:
        """By width (B,)."""
        return np.asarray(self.half_axes.max(axis=1) / self.half_axes.min(axis=1))

    def select(self, chosen: Mask | NDArray[np.intp]) -> Ellipses:
        """Some of them."""
        return Ellipses._make(part[chosen] for part in self)

    def replaced(self, rows: NDArray[np.intp], others: Ellipses) -> Ellipses:
        """These with others in some rows."""
        parts = Ellipses._make(part.copy() for part in self)
        for part, other in zip(parts, others, strict=True):
            part[rows] = other
        return parts


def together(rows: Sequence[Sequence[float]]) -> Ellipses:
    """Single ellipses side by side: centre u, v, half-axes, and the angle of the first."""
    table = np.array(rows, dtype=np.float64).reshape(-1, 5)
    return Ellipses(table[:, :2], table[:, 2:4], table[:, 4], np.ones(len(table), dtype=np.bool_))


def none(count: int) -> Ellipses:
    """So many unit circles that stand for no ellipse."""
    zeros = np.zeros((count, 2))
    return Ellipses(zeros, zeros + 1.0, zeros[:, 0], np.zeros(count, dtype=np.bool_))


def joined(parts: Sequence[Ellipses]) -> Ellipses:
    """Ellipses, and others after them."""
    return Ellipses(*map(np.concatenate, zip(*parts)))


def fit_conics(points: Floats, chosen: Mask, oblique: float) -> Ellipses:
    """Ellipses through the chosen (B, n) of points (B, n, 2): conics of least mean square distance.

    That is the sum of squares of the equation over that of its gradient (Taubin, IEEE PAMI 13,
    1991).  Of few, and of those whose conic is no ellipse, `cv2.fitEllipseAMS` takes the same, or
    that of `cv2.fitEllipseDirect`.  `oblique` is the least width by length.
    """
    counts = chosen.sum(axis=1)
    sound = counts >= FEWEST
    # in single precision, which is exact near the ellipse only
    middle = points[np.arange(len(points)), chosen.argmax(axis=1)]
    found = _taubin(points - middle[:, None], chosen) if len(points) >= MANY else None
    found = np.full((len(points), 5), np.nan) if found is None else found
    rest = sound & ~np.isfinite(found).all(axis=1)
    near = (points[rest] - middle[rest, None]).astype(np.float32)[chosen[rest]]
    ends = [0, *np.cumsum(counts[rest]).tolist()]
    for k, row in enumerate(np.flatnonzero(rest).tolist()):
        # it moves points by chance where they fix no ellipse, each time otherwise but for this
        cv2.setRNGSeed(0)
        centre, (width, height), angle = cv2.fitEllipseAMS(near[ends[k] : ends[k + 1]])
        found[row] = *centre, width / 2, height / 2, math.radians(angle)
    sound &= np.isfinite(found).all(axis=1)
    half_axes = found[:, 2:4]
    sound &= half_axes.min(axis=1) >= np.maximum(oblique * half_axes.max(axis=1), _LEAST)
    found = np.where(sound[:, None], found, [0.0, 0.0, 1.0, 1.0, 0.0])
    return Ellipses(middle + found[:, :2], found[:, 2:4], found[:, 4], sound)


def _taubin(points: Floats, chosen: Mask) -> Floats:
    """Centres, half-axes and angles (B, 5) of ellipses, of all at once; NaN where there is none."""
    w = chosen.astype(np.float64)
    count = np.maximum(w.sum(axis=1), 1.0)[:, None]
    u, v = points[..., 0], points[..., 1]
    mean_u, mean_v = np.vecdot(w, u)[:, None] / count, np.vecdot(w, v)[:, None] / count
    u, v = (u - mean_u) * w, (v - mean_v) * w
    size = np.sqrt((np.vecdot(u, u) + np.vecdot(v, v))[:, None] / count) + _LEAST
    u, v = u / size, v / size
    D = np.stack([u * u, u * v, v * v, u, v], axis=1)
    mean = D.sum(axis=2) / count
    # squares of the equation, whose constant is that of least squares, and of its gradient
    M = D @ D.swapaxes(1, 2) / count[..., None] - mean[:, :, None] * mean[:, None]
    M += 1e-14 * np.eye(5)  # exact ellipses leave nothing
    N = np.zeros_like(M)
    uu, uv, vv = mean[:, :3].T
    N[:, 0, 0], N[:, 1, 1], N[:, 2, 2], N[:, 3, 3], N[:, 4, 4] = 4 * uu, uu + vv, 4 * vv, 1.0, 1.0
    N[:, 0, 1] = N[:, 1, 0] = N[:, 1, 2] = N[:, 2, 1] = 2 * uv
    K = np.linalg.solve(M, N)
    for _ in range(SQUARED):  # of all conics the one of the least quotient is left
        K = K / np.abs(K).max(axis=(1, 2), keepdims=True)
        K = K @ K
    a, b, c, d, e = (equation := K[np.arange(len(K)), :, np.abs(K).sum(axis=1).argmax(axis=1)]).T
    with np.errstate(all="ignore"):
        middle = np.array([b * e - 2 * c * d, b * d - 2 * a * e]) / (4 * a * c - b * b)
        level = np.vecdot(equation, mean) - (d * middle[0] + e * middle[1]) / 2
        half, bent = (a + c) / 2, np.hypot((a - c) / 2, b / 2)
        axes = np.sqrt(level / np.array([half + bent, half - bent]))
        centre = middle * size[:, 0] + np.array([mean_u, mean_v])[..., 0]
    return np.stack([*centre, *(axes * size[:, 0]), 0.5 * np.arctan2(b, a - c)], axis=1)


def distances(ellipses: Ellipses, points: Floats) -> Floats:
    """Signed distances (B, n) of points (B, n, 2) or (n, 2) from ellipses, outside positive.

    To first order (Sampson), which is exact enough within a few px of the rim.
    """
    axes = ellipses.half_axes[:, None]
    # On the ellipse |scaled| is 1; its gradient is scaled / axes / |scaled|.
    scaled = (points - ellipses.centre[:, None]) @ (turns(ellipses.angle) / axes)
    square = scaled * scaled
    slope = square / axes**2
    square = square[..., 0] + square[..., 1]
    steepness = np.sqrt(slope[..., 0] + slope[..., 1]) + 1e-12
    return np.asarray((square - np.sqrt(square)) / steepness)


def turns(angle: Floats) -> Floats:
    """Rotations (..., 2, 2) by angles (...)."""
    turned = np.empty((*np.shape(angle), 2, 2))
    turned[..., 0, 0] = turned[..., 1, 1] = np.cos(angle)
    turned[..., 1, 0] = np.sin(angle)
    turned[..., 0, 1] = -turned[..., 1, 0]
    return turned
