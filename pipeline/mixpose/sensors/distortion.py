"""Lens distortion as OpenCV defines it, with its derivative.

Coefficients (k1, k2, p1, p2[, k3[, k4, k5, k6[, s1, s2, s3, s4[, τx, τy]]]]): rational radial,
tangential, thin prism, tilted sensor.  Acts on normalised coordinates (x/z, y/z).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike

from mixpose.records import Floats

ALLOWED_COUNTS = (0, 4, 5, 8, 12, 14)
_COUNT = 14


@dataclass(frozen=True)
class LensDistortion:
    """OpenCV's distortion of a pinhole camera.

    Attributes
    ----------
    coefficients : (14,) or (14, ...) float64
        OpenCV's order, missing ones zero; further axes broadcast against those of the points.
    radius_limit : float or (...) float64
        Normalised radius up to which the radial polynomial grows.  Beyond it a model fitted to
        the image folds back and would show points that no lens images.
    """

    coefficients: Floats
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

    def apply(self, xy: Floats) -> Floats:
        """Distort normalised coordinates (..., 2)."""
        k = self.coefficients
        x, y = xy[..., 0], xy[..., 1]
        r2 = x * x + y * y
        radial = _polynomial(r2, k[0], k[1], k[4]) / _polynomial(r2, k[5], k[6], k[7])
        prism_x = r2 * (k[8] + r2 * k[9])
        prism_y = r2 * (k[10] + r2 * k[11])
        out = np.empty_like(xy)
        out[..., 0] = x * radial + 2 * k[2] * x * y + k[3] * (r2 + 2 * x * x) + prism_x
        out[..., 1] = y * radial + k[2] * (r2 + 2 * y * y) + 2 * k[3] * x * y + prism_y
        if np.any(k[12:]):
            M = _tilt_matrix(k[12], k[13])
            h = out @ M[:, :2].T + M[:, 2]
            out = h[..., :2] / h[..., 2:]
        return out

    def derivative(self, xy: Floats) -> Floats:
        """Jacobian (..., 2, 2) of `apply`."""
        k = self.coefficients
        x, y = xy[..., 0], xy[..., 1]
        r2 = x * x + y * y
        top, bottom = _polynomial(r2, k[0], k[1], k[4]), _polynomial(r2, k[5], k[6], k[7])
        radial = top / bottom
        d_top, d_bottom = _derivative(r2, k[0], k[1], k[4]), _derivative(r2, k[5], k[6], k[7])
        d_radial = (d_top - radial * d_bottom) / bottom  # by r²
        d_prism_x = k[8] + 2 * r2 * k[9]
        d_prism_y = k[10] + 2 * r2 * k[11]
        D = np.empty((*xy.shape, 2))
        D[..., 0, 0] = radial + 2 * x * (x * d_radial + d_prism_x) + 2 * k[2] * y + 6 * k[3] * x
        D[..., 0, 1] = 2 * y * (x * d_radial + d_prism_x) + 2 * k[2] * x + 2 * k[3] * y
        D[..., 1, 0] = 2 * x * (y * d_radial + d_prism_y) + 2 * k[2] * x + 2 * k[3] * y
        D[..., 1, 1] = radial + 2 * y * (y * d_radial + d_prism_y) + 6 * k[2] * y + 2 * k[3] * x
        if np.any(k[12:]):
            D = self._tilt_derivative(xy) @ D
        return D

    def _tilt_derivative(self, xy: Floats) -> Floats:
        M = _tilt_matrix(self.coefficients[12], self.coefficients[13])
        flat = LensDistortion(np.append(self.coefficients[:12], [0.0, 0.0]), self.radius_limit)
        h = flat.apply(xy) @ M[:, :2].T + M[:, 2]
        scaled = h[..., :2] / h[..., 2:]
        inner = M[:2, :2] - scaled[..., :, None] * M[2, :2]
        return np.asarray(inner / h[..., 2, None, None])


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
