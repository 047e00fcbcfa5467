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

    # (14,) or (14, ...) in OpenCV's order; further axes broadcast as points do
    coefficients: Floats
    # Normalised radius up to which the radial polynomial grows. Beyond it a model fitted to the
    # image folds back and would show points that no lens images.
    radius_limit: float | Floats

    @classmethod
    def from_coefficients(cls, coefficients: ArrayLike) -> LensDistortion | None:
        """Build from 4, 5, 8, 12 or 14 coefficients; None when nothing is distorted."""
        given = np.asarray(coefficients, dtype=np.float64).ravel()
        if given.size not in ALLOWED_COUNTS:
            raise ValueError(f"{given.size} distortion coefficients, allowed are 4, 5, 8, 12 or 14")
        if not given.any():
            return None
        full = np.zeros(_COUNT)
        full[: given.size] = given
        return cls(full, _monotonic_radius(tuple(full.tolist())))

    @cached_property
    def _parts(self) -> tuple[bool, bool, bool]:
        """Whether a denominator, thin prisms and a tilted sensor are there."""
        k = self.coefficients
        return bool(k[5:8].any()), bool(k[8:12].any()), bool(k[12:].any())

    def apply(self, xy: Floats) -> Floats:
        """Distort normalised coordinates (..., 2)."""
        k, products = self.coefficients, _products(xy)
        r2 = products[-1]
        radial = _polynomial(r2, k[0], k[1], k[4])
        if self._parts[0]:
            radial = radial / _polynomial(r2, k[5], k[6], k[7])
        flat = self._on_flat(xy, radial, *products)
        return self._tilted(flat)[0] if self._parts[2] else flat

    def linearise(self, xy: Floats) -> tuple[Floats, Floats]:
        """As `apply`, with its Jacobian (..., 2, 2)."""
        k, (is_rational, has_prisms, is_tilted) = self.coefficients, self._parts
        x, y = xy[..., 0], xy[..., 1]
        xx, yy, xy2, r2 = products = _products(xy)
        radial, slope = _polynomial(r2, k[0], k[1], k[4]), _derivative(r2, k[0], k[1], k[4])
        if is_rational:
            bottom = _polynomial(r2, k[5], k[6], k[7])
            radial = radial / bottom
            slope = (slope - radial * _derivative(r2, k[5], k[6], k[7])) / bottom
        slope2 = 2 * slope  # of the radial factor, by r²
        D = np.empty((*xy.shape, 2))
        D[..., 0, 0] = radial + slope2 * xx + 2 * k[2] * y + 6 * k[3] * x
        D[..., 0, 1] = D[..., 1, 0] = slope * xy2 + 2 * k[2] * x + 2 * k[3] * y
        D[..., 1, 1] = radial + slope2 * yy + 6 * k[2] * y + 2 * k[3] * x
        if has_prisms:
            by_r2 = np.stack([k[8] + 2 * r2 * k[9], k[10] + 2 * r2 * k[11]], axis=-1)
            D += by_r2[..., :, None] * (2 * xy[..., None, :])
        flat = self._on_flat(xy, radial, *products)
        if not is_tilted:
            return flat, D
        tilted, by_flat = self._tilted(flat)
        return tilted, by_flat @ D

    def _on_flat(
        self, xy: Floats, radial: Floats, xx: Floats, yy: Floats, xy2: Floats, r2: Floats
    ) -> Floats:
        """Coordinates (..., 2) on a sensor that is not tilted."""
        k, flat = self.coefficients, np.empty_like(xy)
        flat[..., 0] = xy[..., 0] * radial + k[2] * xy2 + k[3] * (r2 + 2 * xx)
        flat[..., 1] = xy[..., 1] * radial + k[2] * (r2 + 2 * yy) + k[3] * xy2
        if self._parts[1]:
            flat[..., 0] += r2 * (k[8] + r2 * k[9])
            flat[..., 1] += r2 * (k[10] + r2 * k[11])
        return flat

    def _tilted(self, flat: Floats) -> tuple[Floats, Floats]:
        """Coordinates (..., 2) on a tilted sensor, and their Jacobian by those on a flat one."""
        M = _tilt_matrix(self.coefficients[12], self.coefficients[13])
        h = flat @ M[:, :2].T + M[:, 2]
        tilted = h[..., :2] / h[..., 2:]
        inner = M[:2, :2] - tilted[..., :, None] * M[2, :2]
        return tilted, np.asarray(inner / h[..., 2, None, None])


def _products(xy: Floats) -> tuple[Floats, Floats, Floats, Floats]:
    """x², y², 2 x y and r² of coordinates (..., 2)."""
    x, y = xy[..., 0], xy[..., 1]
    xx, yy = x * x, y * y
    return xx, yy, 2 * x * y, xx + yy


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
