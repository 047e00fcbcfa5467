"""Whether what is seen is all of a spot, by its grey values.

With z = u + iv from the centroid, what a disk of radius R has lost at its rim, a share s of it at
an angle φ, moved the centroid by −s R exp(iφ) and makes ⟨z³⟩ = −s R³ exp(3iφ).  This is 0 for what
is like itself turned by half a turn, as disks, ellipses, and both blurred: so |⟨z³⟩| / R², with
R² = 2 ⟨|z|²⟩, is how far the centroid may be off.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from mixpose.extraction.conics import Ellipse, together, turns
from mixpose.extraction.contours import Box, signal_about
from mixpose.extraction.threshold import Foreground
from mixpose.records import Floats

# Patches of so many shapes are prepared for.
SHAPES = 256


def centroids(weights: NDArray[np.float32] | NDArray[np.uint8]) -> tuple[Floats, Floats]:
    """Centroids (K, 2) of patches (K, h, w), from their first pixel, and how far they may be off.

    NaN where nothing has a weight.
    """
    rows, columns = weights.shape[1:]
    sums = weights.reshape(len(weights), -1) @ _monomials(rows, columns).T
    with np.errstate(invalid="ignore", divide="ignore"):
        u, v, square, *others = (sums[:, 1:] / sums[:, :1]).T
        centre, z2, z3 = u + 1j * v, others[0] + 1j * others[1], others[2] + 1j * others[3]
        third = np.abs(z3 - 3 * centre * z2 + 2 * centre**3)
        off = third / np.maximum(2 * (square - u * u - v * v), 1e-9)
    return np.stack([u, v], axis=1), off


@lru_cache(maxsize=SHAPES)
def _monomials(rows: int, columns: int) -> Floats:
    """1, z, |z|², z² and z³ of the pixels of a patch (8, rows * columns), complex ones as two."""
    v, u = np.indices((rows, columns), dtype=np.float64).reshape(2, -1)
    z2, z3 = (u + 1j * v) ** 2, (u + 1j * v) ** 3
    return np.array([np.ones(u.size), u, v, u * u + v * v, z2.real, z2.imag, z3.real, z3.imag])


def background(patch: NDArray[np.float32]) -> float:
    """Median of the outermost pixels."""
    frame = patch.take(_border(*patch.shape))
    frame.partition(frame.size // 2)
    return float(frame[frame.size // 2])


@lru_cache(maxsize=SHAPES)
def _border(rows: int, columns: int) -> NDArray[np.intp]:
    """Places of the outermost pixels of a patch, corners twice."""
    places = np.arange(rows * columns).reshape(rows, columns)
    return np.concatenate([places[0], places[-1], places[:, 0], places[:, -1]])


def off_centre(
    disks: Sequence[tuple[Foreground, Ellipse]], margin: int, least: float, beside: float
) -> Floats:
    """How far the centres of ellipses (K,) may be off, px: from their grey values and of these.

    Up to `beside` px outside of an ellipse, what is brighter than a share of the peak counts, above
    the background `margin` px around it.  0 where nothing is, so that nothing is told.
    """
    if not disks:
        return np.zeros(0)
    patches, corners = [], []
    for scene, ellipse in disks:
        patch, corner = signal_about(scene, _box(ellipse), margin)
        base, peak = background(patch), cv2.minMaxLoc(patch)[1]
        patches.append(np.maximum(patch - np.float32(base + least * (peak - base)), 0))
        corners.append(corner)
    side = max(max(patch.shape) for patch in patches)
    weights = np.zeros((len(patches), side, side), np.float32)
    for own, patch in zip(weights, patches, strict=True):
        own[: patch.shape[0], : patch.shape[1]] = patch
    rims = together([ellipse for _, ellipse in disks])
    axes = turns(rims.angle) / (rims.half_axes + beside)[:, None]
    centres = rims.centre - corners
    places = np.indices((side, side), dtype=np.float64)[::-1].reshape(2, -1).T
    scaled = (places - centres[:, None]) @ axes
    weights[(np.vecdot(scaled, scaled) > 1).reshape(weights.shape)] = 0
    found, off = centroids(weights)
    return np.asarray(np.nan_to_num(np.hypot(off, np.linalg.norm(found - centres, axis=1))))


def _box(ellipse: Ellipse) -> Box:
    """Of the pixels in an ellipse."""
    (u, v), (a, b) = ellipse.centre, ellipse.half_axes
    c, s = np.cos(ellipse.angle), np.sin(ellipse.angle)
    half_u, half_v = float(np.hypot(a * c, b * s)), float(np.hypot(a * s, b * c))
    u0, v0 = int(np.floor(u - half_u)), int(np.floor(v - half_v))
    return u0, v0, int(np.ceil(u + half_u)) - u0 + 1, int(np.ceil(v + half_v)) - v0 + 1
