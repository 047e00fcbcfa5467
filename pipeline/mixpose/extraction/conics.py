"""Ellipses side by side: fitted to points, and distances from them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from mixpose.records import Floats, Mask

FEWEST = 6  # points of an ellipse: five always lie on a conic

_LEAST = 1e-3  # px, of a half-axis: points on a line make none


class Ellipse(NamedTuple):
    """An ellipse in pixel coordinates; `angle` in radians turns the first half-axis from u."""

    centre: tuple[float, float]
    half_axes: tuple[float, float]
    angle: float

    @property
    def area(self) -> float:
        """Enclosed area in px."""
        return math.pi * self.half_axes[0] * self.half_axes[1]

    @property
    def length(self) -> float:
        """By width."""
        return max(self.half_axes) / min(self.half_axes)


@dataclass(frozen=True)
class Ellipses:
    """B ellipses in pixel coordinates."""

    centre: Floats  # (B, 2)
    half_axes: Floats  # (B, 2)
    angle: Floats  # (B,) radians; turns the first half-axis from u
    sound: Mask  # (B,) which of them are ellipses; the others are unit circles

    def select(self, chosen: Mask | NDArray[np.intp]) -> Ellipses:
        """Some of them."""
        parts = (self.centre, self.half_axes, self.angle, self.sound)
        return Ellipses(*(part[chosen] for part in parts))  # type: ignore[arg-type]

    def replaced(self, rows: NDArray[np.intp], others: Ellipses) -> Ellipses:
        """These with others in some rows."""
        parts = [self.centre.copy(), self.half_axes.copy(), self.angle.copy(), self.sound.copy()]
        own = [others.centre, others.half_axes, others.angle, others.sound]
        for part, other in zip(parts, own, strict=True):
            part[rows] = other
        return Ellipses(*parts)  # type: ignore[arg-type]

    def each(self) -> list[Ellipse]:
        """One by one."""
        parts = (self.centre.tolist(), self.half_axes.tolist(), self.angle.tolist())
        return [Ellipse((u, v), (a, b), angle) for (u, v), (a, b), angle in zip(*parts)]


def together(ellipses: Sequence[Ellipse]) -> Ellipses:
    """Single ellipses side by side."""
    return Ellipses(
        np.array([one.centre for one in ellipses]).reshape(-1, 2),
        np.array([one.half_axes for one in ellipses]).reshape(-1, 2),
        np.array([one.angle for one in ellipses]),
        np.ones(len(ellipses), dtype=np.bool_),
    )


def fit_conics(points: Floats, chosen: Mask, oblique: float) -> Ellipses:
    """Ellipses through the chosen (B, n) of points (B, n, 2): conics of least mean square distance.

    That is the sum of squares of the equation over that of its gradient (Taubin, IEEE PAMI 13,
    1991), by `cv2.fitEllipseAMS`; `cv2.fitEllipseDirect` where that conic is no ellipse.  `oblique`
    is the least width by length.
    """
    found = np.ones((len(points), 5))
    counts = chosen.sum(axis=1)
    sound = counts >= FEWEST
    # in single precision, which is exact near the ellipse only
    middle = points[np.arange(len(points)), chosen.argmax(axis=1)]
    near = (points - middle[:, None]).astype(np.float32)[chosen]
    ends = [0, *np.cumsum(counts).tolist()]
    for k in np.flatnonzero(sound).tolist():
        # it moves points by chance where they fix no ellipse, each time otherwise but for this
        cv2.setRNGSeed(0)
        centre, axes, angle = cv2.fitEllipseAMS(near[ends[k] : ends[k + 1]])
        found[k] = *centre, *axes, angle
    sound &= np.isfinite(found).all(axis=1)
    half_axes = found[:, 2:4] / 2
    sound &= half_axes.min(axis=1) >= np.maximum(oblique * half_axes.max(axis=1), _LEAST)
    found = np.where(sound[:, None], found, 0.0)
    half_axes = np.where(sound[:, None], half_axes, 1.0)
    return Ellipses(middle + found[:, :2], half_axes, np.radians(found[:, 4]), sound)


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
