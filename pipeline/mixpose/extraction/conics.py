"""Ellipses by their equation: many fitted at once, and distances from them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from mixpose.records import Floats

Mask: TypeAlias = NDArray[np.bool_]

FEWEST = 6  # points of an ellipse: five always lie on a conic

_ROUNDING = 1e-12  # of the matrix of slopes, which points on a line leave singular


@dataclass(frozen=True)
class Ellipse:
    """An ellipse in pixel coordinates; `angle` in radians turns the first half-axis from u."""

    centre: tuple[float, float]
    half_axes: tuple[float, float]
    angle: float

    @property
    def area(self) -> float:
        """Enclosed area in px."""
        return math.pi * self.half_axes[0] * self.half_axes[1]


@dataclass(frozen=True)
class Ellipses:
    """B ellipses in pixel coordinates.

    Attributes
    ----------
    centre : (B, 2) float64
    half_axes : (B, 2) float64
    angle : (B,) float64
        Radians; turns the first half-axis from u.
    sound : (B,) bool
        Which of them are ellipses; the others are unit circles.
    """

    centre: Floats
    half_axes: Floats
    angle: Floats
    sound: Mask

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

    def one(self, k: int) -> Ellipse:
        """One of them."""
        (u, v), (a, b) = self.centre[k].tolist(), self.half_axes[k].tolist()
        return Ellipse((u, v), (a, b), float(self.angle[k]))


def together(ellipses: list[Ellipse]) -> Ellipses:
    """Single ellipses side by side."""
    return Ellipses(
        np.array([one.centre for one in ellipses]),
        np.array([one.half_axes for one in ellipses]),
        np.array([one.angle for one in ellipses]),
        np.ones(len(ellipses), dtype=np.bool_),
    )


@dataclass(frozen=True)
class Monomials:
    """Products of coordinates, of which sums make up every fit to some of the points.

    Attributes
    ----------
    values : (B, n, 6) float64
        u², uv, v², u, v, 1 about the middle, as shares of the size.
    middle : (B, 2) float64
    size : (B,) float64
    """

    values: Floats
    middle: Floats
    size: Floats

    def select(self, chosen: NDArray[np.intp]) -> Monomials:
        """Those of some rows."""
        return Monomials(self.values[chosen], self.middle[chosen], self.size[chosen])


def monomials(points: Floats, there: Mask) -> Monomials:
    """Prepare points (B, n, 2), of which (B, n) are there."""
    x = np.where(there[..., None], points, 0.0)
    count = np.maximum(there.sum(axis=1), 1)
    middle = np.ones(x.shape[1]) @ x / count[:, None]
    x = (x - middle[:, None]) * there[..., None]
    size = np.sqrt(np.einsum("bni,bni->b", x, x) / count)
    size[size == 0] = 1.0
    u, v = np.moveaxis(x / size[:, None, None], 2, 0)
    values = np.ones((*u.shape, 6))
    for k, term in enumerate((u * u, u * v, v * v, u, v)):
        values[..., k] = term
    return Monomials(values, middle, size)


def fit_conics(terms: Monomials, chosen: Mask, oblique: float) -> Ellipses:
    """Ellipses through points: of all conics those of least mean square distance (Taubin).

    Taubin, IEEE PAMI 13 (1991): the sum of squares of the equation, over that of its gradient.

    Parameters
    ----------
    terms : Monomials
    chosen : (B, n) bool
        Which points count.
    oblique : float
        Least width by length.
    """
    count = chosen.sum(axis=1)
    weights = chosen / np.maximum(count, 1)[:, None]
    moments = (terms.values * weights[..., None]).swapaxes(1, 2) @ terms.values
    mean = moments[:, :5, 5]
    square = moments[:, :5, :5] - mean[:, :, None] * mean[:, None]
    slope = (moments[:, 5] @ _SLOPES).reshape(-1, 5, 5) + _ROUNDING * np.eye(5)
    whitening = np.linalg.inv(np.linalg.cholesky(slope))
    across = whitening.swapaxes(1, 2)
    least = np.linalg.eigh(whitening @ square @ across)[1][:, :, :1]
    equation = (across @ least)[..., 0]
    constant = -(equation * mean).sum(axis=1)
    centre, half_axes, angle, sound = _shape(equation, constant)
    sound &= (count >= FEWEST) & (half_axes[:, 0] >= oblique * half_axes[:, 1])
    half_axes = np.where(sound[:, None], half_axes * terms.size[:, None], 1.0)
    return Ellipses(terms.middle + centre * terms.size[:, None], half_axes, angle, sound)


def _slopes() -> Floats:
    """What makes the mean product (25) of the gradients of five monomials of means (6)."""
    by_u, by_v = np.zeros((2, 5, 6))
    by_u[0, 3], by_u[1, 4], by_u[3, 5] = 2, 1, 1
    by_v[1, 3], by_v[2, 4], by_v[4, 5] = 1, 2, 1
    # the product of two of u, v and 1, as one of the six
    product = np.zeros((6, 6, 6))
    for (i, j), k in zip([(3, 3), (3, 4), (4, 4), (3, 5), (4, 5), (5, 5)], range(6), strict=True):
        product[i, j, k] = product[j, i, k] = 1
    terms = [np.einsum("ai,bj,ijk->kab", by, by, product) for by in (by_u, by_v)]
    return np.asarray(sum(terms)).reshape(6, 25)


_SLOPES = _slopes()


def _shape(equation: Floats, constant: Floats) -> tuple[Floats, Floats, Floats, Mask]:
    """Centre, half-axes, angle of a u² + b uv + c v² + d u + e v + f = 0, and if it is one.

    The first half-axis is the shorter one.
    """
    sign = np.where(equation[:, 0] + equation[:, 2] < 0, -1.0, 1.0)
    a, b, c, d, e = (equation * sign[:, None]).T
    determinant = 4 * a * c - b * b
    sound = determinant > 0
    divisor = np.where(sound, determinant, 1.0)
    centre = np.stack([b * e - 2 * c * d, b * d - 2 * a * e], axis=1) / divisor[:, None]
    depth = -(constant * sign + (d * centre[:, 0] + e * centre[:, 1]) / 2)
    root = np.sqrt((a - c) ** 2 + b * b)
    steep, flat = (a + c + root) / 2, (a + c - root) / 2
    sound &= (depth > 0) & (flat > 0)
    depth, steep, flat = (np.where(sound, x, 1.0) for x in (depth, steep, flat))
    half_axes = np.sqrt(np.stack([depth / steep, depth / flat], axis=1))
    return centre, half_axes, np.arctan2(b, a - c) / 2, sound


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
