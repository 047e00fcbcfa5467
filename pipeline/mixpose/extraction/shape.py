"""Estimate whether a spot is seen whole, by its grey values and by other spots.

Let z = u + iv from the centroid.  A disk of radius R that has lost a share s at its rim, at an
angle φ, has its centroid moved by −s R exp(iφ), and ⟨z³⟩ = −s R³ exp(3iφ).  ⟨z³⟩ is 0 for whatever
a half turn does not change, such as disks and ellipses, blurred or not: so |⟨z³⟩| / R², with
R² = 2 ⟨|z|²⟩, estimates the error of the centroid.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from mixpose.extraction.conics import Ellipses, rotations
from mixpose.extraction.sampling import patches_of
from mixpose.extraction.threshold import Foreground
from mixpose.records import Floats, Indices

_TINY = float(np.finfo(np.float32).tiny)

# Shapes of patches for which arrays are kept.
SHAPES = 256

# Boxes whose longer sides differ by less, px, are handled together.
ALIKE = 8


def excess_lengths(shapes: Floats, alike: int) -> Floats:
    """Return by how much spots (M,) are longer than the `alike` most similar; inf if too few.

    `shapes` (M, 3) are areas, lengths by width and directions.  Similarity is by the logarithms of
    the radius and of the length along its direction.
    """
    if len(shapes) <= alike:
        return np.full(len(shapes), np.inf)
    areas, lengths, angles = shapes.T
    stretch, sizes = np.log(np.maximum(lengths, 1.0)), np.log(areas) / 2
    points = np.stack([sizes, stretch * np.cos(2 * angles), stretch * np.sin(2 * angles)], axis=1)
    # the first neighbour is the spot itself
    return np.asarray(np.expm1(cKDTree(points).query(points, k=[alike + 1])[0][:, 0]))


def centroids(weights: NDArray[np.float32] | NDArray[np.uint8]) -> tuple[Floats, Floats]:
    """Return centroids (K, 2) of patches (K, h, w), from their first pixel, and errors (K,), px.

    They are NaN where all weights are zero.
    """
    rows, columns = weights.shape[1:]
    sums = weights.reshape(len(weights), -1) @ _monomials(rows, columns).T
    with np.errstate(invalid="ignore", divide="ignore"):
        u, v, square, *powers = (sums[:, 1:] / sums[:, :1]).T
        centre, z2, z3 = u + 1j * v, powers[0] + 1j * powers[1], powers[2] + 1j * powers[3]
        third = np.abs(z3 - 3 * centre * z2 + 2 * centre**3)
        errors = third / np.maximum(2 * (square - u * u - v * v), 1e-9)
    return np.stack([u, v], axis=1), errors


def areas_at_half_height(signal: NDArray[np.float32], base: Floats, peak: Floats) -> Floats:
    """Return the areas (K,) of spots (K, h, w) at half of their height, px, as rims of disks have.

    Pixels from a quarter to three quarters of the height count in part.
    """
    height = np.maximum(peak - base, _TINY).astype(np.float32)
    share = (signal - base.astype(np.float32)[:, None, None]) * (2 / height)[:, None, None]
    share -= np.float32(0.5)
    np.clip(share, 0, 1, out=share)
    return np.asarray(share.sum(axis=(1, 2)), dtype=np.float64)


@lru_cache(maxsize=SHAPES)
def _monomials(rows: int, columns: int) -> Floats:
    """Return 1, z, |z|², z², z³ of a patch's pixels, (8, rows * columns), complex ones as two."""
    v, u = np.indices((rows, columns), dtype=np.float64).reshape(2, -1)
    z2, z3 = (u + 1j * v) ** 2, (u + 1j * v) ** 3
    return np.array([np.ones(u.size), u, v, u * u + v * v, z2.real, z2.imag, z3.real, z3.imag])


def background(patch: NDArray[np.float32]) -> float:
    """Return the median of the outermost pixels."""
    frame = patch.take(_border(*patch.shape))
    frame.partition(frame.size // 2)
    return float(frame[frame.size // 2])


@lru_cache(maxsize=SHAPES)
def _border(rows: int, columns: int) -> NDArray[np.intp]:
    """Return the flat indices of the outermost pixels of a patch, corners twice."""
    places = np.arange(rows * columns).reshape(rows, columns)
    return np.concatenate([places[0], places[-1], places[:, 0], places[:, -1]])


class Patches(NamedTuple):
    """Signals around K features, in patches of one size."""

    signal: NDArray[np.float32]  # (K, h, w); 0 outside of a feature's own smaller patch
    corners: NDArray[np.intp]  # (K, 2) first pixels (u, v)
    base: Floats  # (K,) medians of the outermost pixels, as of `background`
    peak: Floats  # (K,)

    @classmethod
    def around(cls, scene: Foreground, boxes: NDArray[np.intp], margin: int) -> Patches:
        """Cut out the patches of boxes (K, 4), with a margin in px as far as the window goes."""
        window = np.array(scene.grey.shape[::-1])
        first = np.maximum(boxes[:, :2] - margin, 0)
        sides = np.minimum(boxes[:, :2] + boxes[:, 2:] + margin, window) - first
        size = sides.max(axis=0)
        # patches at the end of the window begin before the feature's first pixel
        corners = np.minimum(first, window - size)
        parts = patches_of(scene.grey, (int(size[1]), int(size[0])))[corners[:, 1], corners[:, 0]]
        signal = parts.astype(np.float32) - np.float32(scene.zero)
        shifts = (first - corners)[..., None]
        pixels = [np.arange(n) - shift for n, shift in zip(size.tolist(), shifts.swapaxes(0, 1))]
        across, down = ((px >= 0) & (px < side[:, None]) for px, side in zip(pixels, sides.T))
        signal *= down[:, :, None] & across[:, None, :]
        rows = np.arange(len(boxes))
        (left, top), (right, bottom) = shifts[..., 0].T, (shifts[..., 0] + sides - 1).T
        ends = [signal[rows, k] for k in (top, bottom)], [signal[rows, :, k] for k in (left, right)]
        frame = np.concatenate([*ends[0], *ends[1]], axis=1)
        frame[~np.concatenate([across, across, down, down], axis=1)] = np.inf  # sorted last
        frame.sort(axis=1)
        base = frame[rows, sides.sum(axis=1)].astype(np.float64)
        return cls(signal, corners, base, signal.max(axis=(1, 2)).astype(np.float64))


def centre_errors(
    scenes: Sequence[Foreground],
    which: Indices,
    rims: Ellipses,
    margin: int,
    min_share: float,
    reach: float,
) -> Floats:
    """Estimate the errors (K,) of ellipses' centres, px: distance from the centroid, and its error.

    `which` (K,) is the scene of each.

    The centroid is of pixels up to `reach` px outside of the ellipse that are above a share
    `min_share` of the peak; the background is `margin` px around.  Without such pixels it is 0.
    """
    errors, boxes = np.zeros(len(which)), _boxes(rims)
    kinds = len(scenes) * (boxes[:, 2:].max(axis=1, initial=0) // ALIKE) + which
    for kind in np.unique(kinds).tolist():
        rows = np.flatnonzero(kinds == kind)
        patches = Patches.around(scenes[kind % len(scenes)], boxes[rows], margin)
        errors[rows] = _errors_of(patches, rims.select(rows), min_share, reach)
    return errors


def _errors_of(patches: Patches, rims: Ellipses, min_share: float, reach: float) -> Floats:
    """Return `centre_errors` of ellipses (K,) with a patch for each."""
    signal, corners, base, peak = patches
    rows, columns = signal.shape[1:]
    weights = signal - (base + min_share * (peak - base)).astype(np.float32)[:, None, None]
    centres = rims.centre - corners
    axes = rotations(rims.angle) / (rims.half_axes + reach)[:, None]
    # squared distances from centres, 1 on the rims, as sums of `_monomials`
    form = axes @ axes.swapaxes(1, 2)
    pull = (form @ centres[..., None])[..., 0]
    (a, b), c = form.diagonal(axis1=1, axis2=2).T, form[:, 0, 1]
    terms = np.vecdot(pull, centres), *(-2 * pull.T), (a + b) / 2, (a - b) / 2, c
    squares = np.stack(terms, axis=1) @ _monomials(rows, columns)[:6]
    weights[(squares > 1).reshape(weights.shape) | (weights < 0)] = 0
    centroid, errors = centroids(weights)
    return np.asarray(np.nan_to_num(np.hypot(errors, np.linalg.norm(centroid - centres, axis=1))))


def _boxes(rims: Ellipses) -> NDArray[np.intp]:
    """Return the boxes (K, 4) of the pixels in ellipses: first column and row, width, height."""
    half = np.linalg.norm(rotations(rims.angle) * rims.half_axes[:, None], axis=2)
    first = np.floor(rims.centre - half).astype(np.intp)
    return np.concatenate([first, np.ceil(rims.centre + half).astype(np.intp) - first + 1], axis=1)
