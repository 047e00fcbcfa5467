"""Lens distortion as OpenCV defines it, with its derivative.

Coefficients (k1, k2, p1, p2[, k3[, k4, k5, k6[, s1, s2, s3, s4[, τx, τy]]]]): rational radial,
tangential, thin prism, tilted sensor.  Acts on normalised coordinates (x/z, y/z).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import ArrayLike

from mixpose.records import Floats

ALLOWED_COUNTS = (0, 4, 5, 8, 12, 14)
_COUNT = 14


@dataclass(frozen=True)
class LensDistortion:
    """OpenCV's distortion of a pinhole camera."""

    coefficients: Floats  # (14,) in OpenCV's order, or (14, L, 1) of L lenses side by side
    # radius up to which the radial polynomial grows: beyond it the fitted model folds back
    radius_limit: float | Floats

    @classmethod
    def from_coefficients(cls, coefficients: ArrayLike) -> LensDistortion | None:
        """Build from 0, 4, 5, 8, 12 or 14 coefficients; return None without distortion."""
        k = np.asarray(coefficients, dtype=np.float64).ravel()
        if k.size not in ALLOWED_COUNTS:
            raise ValueError(f"{k.size} distortion coefficients, allowed are 4, 5, 8, 12 or 14")
        if not k.any():
            return None
        full = np.zeros(_COUNT)
        full[: k.size] = k
        return cls(full, _monotonic_radius(tuple(full.tolist())))

    @cached_property
    def _parts(self) -> tuple[bool, bool, bool]:
        """Whether the model has a denominator, thin prisms and a tilted sensor."""
        k = self.coefficients
        return bool(k[5:8].any()), bool(k[8:12].any()), bool(k[12:].any())

    @cached_property
    def _tangential(self) -> tuple[Floats, Floats]:
        """Matrices of tangential terms (..., 2, 4), by products, and slopes (..., 4, 2), by xy."""
        p1, p2 = self.coefficients[2:4]
        zero = np.zeros_like(p1)
        by_products = [[3 * p2, 2 * p1, zero, p2], [p1, 2 * p2, zero, 3 * p1]]
        by_places = [[6 * p2, 2 * p1], [2 * p1, 2 * p2], [2 * p1, 2 * p2], [2 * p2, 6 * p1]]
        first, second = (
            np.moveaxis(rows[..., 0] if rows.ndim > 2 else rows, [0, 1], [-2, -1])
            for rows in (np.array(by_products), np.array(by_places))
        )
        return first, second

    def apply(self, xy: Floats) -> Floats:
        """Distort normalised coordinates (..., 2, n)."""
        return self.linearise(xy)[0]

    def linearise(self, xy: Floats) -> tuple[Floats, Floats]:
        """Return distorted coordinates as `apply`, and their Jacobian (..., 2, 2, n)."""
        k, (is_rational, has_prisms, is_tilted) = self.coefficients, self._parts
        products = xy[..., :, None, :] * xy[..., None, :, :]
        products = products.reshape(*xy.shape[:-2], 4, -1)  # x², xy, xy and y²
        r2 = products[..., 0, :] + products[..., 3, :]
        radial, slope = _polynomial(r2, k[0], k[1], k[4]), _derivative(r2, k[0], k[1], k[4])
        if is_rational:
            bottom = _polynomial(r2, k[5], k[6], k[7])
            radial = radial / bottom
            slope = (slope - radial * _derivative(r2, k[5], k[6], k[7])) / bottom
        by_products, by_places = self._tangential
        y = radial[..., None, :] * xy + by_products @ products
        # slopes of the radial factor, by r², and of the tangential terms, by x and y
        D = 2 * slope[..., None, :] * products + by_places @ xy
        D[..., ::3, :] += radial[..., None, :]
        D = D.reshape(*xy.shape[:-1], 2, -1)
        if has_prisms:
            prism = np.stack([k[8] + r2 * k[9], k[10] + r2 * k[11]], axis=-2)
            by_r2 = np.stack([k[8] + 2 * r2 * k[9], k[10] + 2 * r2 * k[11]], axis=-2)
            y += r2[..., None, :] * prism
            D += 2 * by_r2[..., None, :] * xy[..., None, :, :]
        return self._tilted(y, D) if is_tilted else (y, D)

    def _tilted(self, y: Floats, D: Floats) -> tuple[Floats, Floats]:
        """Map coordinates (2, n) on a flat sensor, with Jacobian, to those on the tilted one."""
        M = _tilt_matrix(self.coefficients[12], self.coefficients[13])
        h = M[:, :2] @ y + M[:, 2:]
        tilted = h[:2] / h[2]
        by_flat = (M[:2, :2, None] - tilted[:, None] * M[2, :2, None]) / h[2]
        return tilted, (by_flat[:, :, None] * D).sum(axis=1)


def _polynomial(r2: Floats, a: Floats | float, b: Floats | float, c: Floats | float) -> Floats:
    return np.asarray(1 + r2 * (a + r2 * (b + r2 * c)))


def _derivative(r2: Floats, a: Floats, b: Floats, c: Floats) -> Floats:
    return np.asarray(a + r2 * (2 * b + 3 * r2 * c))


def _tilt_matrix(tau_x: float, tau_y: float) -> Floats:
    cx, sx, cy, sy = np.cos(tau_x), np.sin(tau_x), np.cos(tau_y), np.sin(tau_y)
    rotation_x = np.array([[1, 0, 0], [0, cx, sx], [0, -sx, cx]])
    rotation_y = np.array([[cy, 0, -sy], [0, 1, 0], [sy, 0, cy]])
    R = rotation_y @ rotation_x
    back = np.array([[R[2, 2], 0, -R[0, 2]], [0, R[2, 2], -R[1, 2]], [0, 0, 1]])
    return np.asarray(back @ R)


@lru_cache(maxsize=64)
def _monotonic_radius(k: tuple[float, ...]) -> float:
    r = np.linspace(0, 10, 4001)
    r2 = r * r
    bottom = _polynomial(r2, k[5], k[6], k[7])
    distorted = r * _polynomial(r2, k[0], k[1], k[4]) / np.where(bottom > 0, bottom, np.nan)
    bad = ~(np.diff(distorted) > 0)
    return float(r[np.argmax(bad)]) if bad.any() else np.inf
