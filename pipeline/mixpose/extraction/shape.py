"""Whether what is seen is all of a spot, by its grey values, and by other spots.

With z = u + iv from the centroid, what a disk of radius R has lost at its rim, a share s of it at
an angle φ, moved the centroid by −s R exp(iφ) and makes ⟨z³⟩ = −s R³ exp(3iφ).  This is 0 for what
is like itself turned by half a turn, as disks, ellipses, and both blurred: so |⟨z³⟩| / R², with
R² = 2 ⟨|z|²⟩, is how far the centroid may be off.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from mixpose.extraction.conics import Ellipses, turns
from mixpose.extraction.sampling import parts_of
from mixpose.extraction.threshold import Foreground
from mixpose.records import Floats, Indices

_TINY = float(np.finfo(np.float32).tiny)

# Patches of so many shapes are prepared for.
SHAPES = 256

# Boxes whose longer sides differ by less, px, are looked at together.
ALIKE = 8


def longer_than_alike(shapes: Floats, alike: int) -> Floats:
    """By how much spots (M,) are longer by width than those alike; inf where there are too few.

    Of areas, lengths by width and directions (M, 3).  Alike are so many others, by logarithms of
    their radius and of their length along its direction.
    """
    if len(shapes) <= alike:
        return np.full(len(shapes), np.inf)
    areas, lengths, angles = shapes.T
    long, sizes = np.log(np.maximum(lengths, 1.0)), np.log(areas) / 2
    points = np.stack([sizes, long * np.cos(2 * angles), long * np.sin(2 * angles)], axis=1)
    # the nearest is the spot itself
    return np.asarray(np.expm1(cKDTree(points).query(points, k=[alike + 1])[0][:, 0]))


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


def areas_at_half(signal: NDArray[np.float32], base: Floats, peak: Floats) -> Floats:
    """How large spots (K, h, w) are at half of their height, px (K,), as rims of disks are.

    Pixels from a quarter to three quarters of it count in part.
    """
    height = np.maximum(peak - base, _TINY).astype(np.float32)
    share = (signal - base.astype(np.float32)[:, None, None]) * (2 / height)[:, None, None]
    share -= np.float32(0.5)
    np.clip(share, 0, 1, out=share)
    return np.asarray(share.sum(axis=(1, 2)), dtype=np.float64)


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


class Patches(NamedTuple):
    """Signals about K features, in parts of one size."""

    signal: NDArray[np.float32]  # (K, h, w); 0 where a feature has a smaller part
    corners: NDArray[np.intp]  # (K, 2) of the first pixel, (u, v)
    base: Floats  # (K,) medians of the outermost pixels, as `background` has them
    peak: Floats  # (K,)

    @classmethod
    def about(cls, scene: Foreground, boxes: NDArray[np.intp], margin: int) -> Patches:
        """Of boxes (K, 4), with a margin in px as far as the window goes."""
        size = np.array(scene.grey.shape[::-1])
        first = np.maximum(boxes[:, :2] - margin, 0)
        sides = np.minimum(boxes[:, :2] + boxes[:, 2:] + margin, size) - first
        most = sides.max(axis=0)
        # those at the end of the window begin before their first pixel
        corners = np.minimum(first, size - most)
        parts = parts_of(scene.grey, (int(most[1]), int(most[0])))[corners[:, 1], corners[:, 0]]
        signal = parts.astype(np.float32) - np.float32(scene.zero)
        skipped = (first - corners)[..., None]
        place = [np.arange(one) - left for one, left in zip(most.tolist(), skipped.swapaxes(0, 1))]
        across, down = ((at >= 0) & (at < own[:, None]) for at, own in zip(place, sides.T))
        signal *= down[:, :, None] & across[:, None, :]
        each = np.arange(len(boxes))
        (left, top), (right, bottom) = skipped[..., 0].T, (skipped[..., 0] + sides - 1).T
        ends = [signal[each, k] for k in (top, bottom)], [signal[each, :, k] for k in (left, right)]
        frame = np.concatenate([*ends[0], *ends[1]], axis=1)
        frame[~np.concatenate([across, across, down, down], axis=1)] = np.inf  # put last
        frame.sort(axis=1)
        base = frame[each, sides.sum(axis=1)].astype(np.float64)
        return cls(signal, corners, base, signal.max(axis=(1, 2)).astype(np.float64))


def off_centre(
    scenes: Sequence[Foreground],
    which: Indices,
    rims: Ellipses,
    margin: int,
    least: float,
    beside: float,
) -> Floats:
    """How far the centres of ellipses (K,) may be off, px: from their grey values and of these.

    `which` (K,) is the scene of each.

    Up to `beside` px outside of an ellipse, what is brighter than a share of the peak counts, above
    the background `margin` px around it.  0 where nothing is, so that nothing is told.
    """
    off, boxes = np.zeros(len(which)), _boxes(rims)
    kinds = len(scenes) * (boxes[:, 2:].max(axis=1, initial=0) // ALIKE) + which
    for kind in np.unique(kinds).tolist():
        own = np.flatnonzero(kinds == kind)
        patches = Patches.about(scenes[kind % len(scenes)], boxes[own], margin)
        off[own] = _off(patches, rims.select(own), least, beside)
    return off


def _off(patches: Patches, rims: Ellipses, least: float, beside: float) -> Floats:
    """The same of ellipses (K,) with a patch for each."""
    signal, corners, base, peak = patches
    rows, columns = signal.shape[1:]
    weights = signal - (base + least * (peak - base)).astype(np.float32)[:, None, None]
    centres = rims.centre - corners
    axes = turns(rims.angle) / (rims.half_axes + beside)[:, None]
    # squared distances from centres, 1 on the rims, as sums of what `_monomials` has
    form = axes @ axes.swapaxes(1, 2)
    pull = (form @ centres[..., None])[..., 0]
    (a, b), c = form.diagonal(axis1=1, axis2=2).T, form[:, 0, 1]
    terms = np.vecdot(pull, centres), *(-2 * pull.T), (a + b) / 2, (a - b) / 2, c
    squares = np.stack(terms, axis=1) @ _monomials(rows, columns)[:6]
    weights[(squares > 1).reshape(weights.shape) | (weights < 0)] = 0
    found, apart = centroids(weights)
    return np.asarray(np.nan_to_num(np.hypot(apart, np.linalg.norm(found - centres, axis=1))))


def _boxes(rims: Ellipses) -> NDArray[np.intp]:
    """Of the pixels in ellipses: first column and row, width and height (K, 4)."""
    half = np.linalg.norm(turns(rims.angle) * rims.half_axes[:, None], axis=2)
    first = np.floor(rims.centre - half).astype(np.intp)
    return np.concatenate([first, np.ceil(rims.centre + half).astype(np.intp) - first + 1], axis=1)
