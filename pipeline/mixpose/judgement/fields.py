"""Fields that errors have in common, at one pose: how much of them it takes for its own.

Of a sensor an offset (kind 1), and what turns, scales and shears its features (kind 2); of a marker
what it is off by, alike in all sensors (kind 3).  With weights W, A = JᵀWJ and fields P, a field of
unit size moves the pose by A⁻¹JᵀWP and leaves (1 − J A⁻¹JᵀW) P in its residuals.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from mixpose.judgement.information import inverted
from mixpose.matching import Matches
from mixpose.records import Floats, Indices


class Fields(NamedTuple):
    """Residuals at a pose, weighted, and fields of sensors (q) and of N markers in them."""

    r: Floats  # (R,)
    J: Floats  # (R, k) along directions that are free
    of_sensors: Floats  # (R, q)
    of_markers: Floats  # (N, 2 L, 3)
    kinds: Floats  # (q + 3 N, 4), as ones
    information: Floats  # (k, k)
    inverse: Floats  # (k, k)
    taken: Floats  # (k, q + 3 N) JᵀWP
    drawn: Floats  # (k, q + 3 N) what a field of unit size moves the pose by
    left: Floats  # (R, q) what the pose leaves of those of sensors

    def pulls(self, rest: Floats, found: Matches) -> Floats:
        """PᵀWr (q + 3 N): of sensors by what their lasting fields leave (R,), of markers by all."""
        by_markers = of_each(self.r[:, None], found).swapaxes(1, 2) @ self.of_markers
        return np.concatenate([rest @ self.of_sensors, by_markers.ravel()])

    def expected_squares(self, found: Matches) -> Floats:
        """What independent errors and fields of each kind add to squares, (4, 4), but for tr R.

        What a pose leaves of two markers' fields is of the rank of the pose: sums over pairs of
        markers are sums over markers.
        """
        q, count, N = self.of_sensors.shape[1], len(self.taken), len(self.of_markers)
        by_marker = of_each(self.left, found).swapaxes(1, 2) @ self.of_markers
        beside = by_marker.swapaxes(0, 1).reshape(q, 3 * N)
        gram = np.concatenate([self.of_sensors.T @ self.left, beside], axis=1)
        parts = self.taken[:, q:], self.drawn[:, q:]
        U, W = (one.reshape(count, N, 3).transpose(1, 0, 2) for one in parts)
        both = U.swapaxes(1, 2) @ W
        own = self.of_markers.swapaxes(1, 2) @ self.of_markers - both
        pairs = np.vdot(parts[0] @ parts[0].T, parts[1] @ parts[1].T)
        expected = self.kinds[:q].T @ gram**2 @ self.kinds
        expected[3, 3] = np.vdot(own, own) + max(float(pairs - np.vdot(both, both)), 0.0)
        expected[3, :3] = expected[:3, 3]
        diagonals = gram.diagonal(), own.diagonal(axis1=1, axis2=2).ravel()
        expected[0] = expected[:, 0] = np.concatenate(diagonals) @ self.kinds
        return np.asarray(expected)


def fields_at(
    found: Matches,
    shares: Floats,  # (L, N) how much each feature counts
    roots: Floats,  # (2 L N) of the weights of residuals
    chosen: Indices,  # (k,) directions that are free
    anywhere: Floats,  # (6,) how uncertain the pose is where nothing is known
) -> Fields:
    """The residuals of what is met, and their fields."""
    r, rows = roots * found.offsets.ravel(), roots[:, None] * found.J.reshape(-1, 6)
    fields = fields_of_sensors(found, shares, shares.sum(axis=1))
    if found.owners is not None:
        r, rows, fields = (_folded(one, found) for one in (r, rows, fields))
    J, count = rows[:, chosen], len(chosen)
    markers = _by_marker(found, rows[:, :3])
    information = J.T @ J
    information.flat[:: count + 1] += anywhere[chosen] ** -2.0
    inverse = inverted(information)
    by_markers = of_each(J, found).swapaxes(1, 2) @ markers  # (N, k, 3)
    taken = np.concatenate([J.T @ fields, by_markers.swapaxes(0, 1).reshape(count, -1)], axis=1)
    left = fields - J @ (drawn := inverse @ taken)[:, : fields.shape[1]]
    kinds = _kinds_of(*shares.shape)
    return Fields(r, J, fields, markers, kinds, information, inverse, taken, drawn, left)


def fields_of_sensors(found: Matches, shares: Floats, met: Floats) -> Floats:
    """Fields (R, q) of sensors, weighted by shares (L, N), of which they met (L,).

    Along each coordinate of a sensor an offset (kind 1), and what turns, scales and shears features
    about their middle (kind 2).
    """
    L, N = shares.shape
    total = np.maximum(met, 1e-6)[:, None]
    away = found.places - ((shares[:, None] @ found.places)[:, 0] / total)[:, None]
    spread = np.vecdot(shares, np.vecdot(away, away))
    size = np.sqrt(spread / (found.dimensions * total[:, 0]))
    by_feature, roots = np.empty((L, N, 3)), np.sqrt(shares)
    by_feature[..., 0] = roots
    by_feature[..., 1:] = away * (roots / np.maximum(size, 1e-6)[:, None])[..., None]
    of_sensors = by_feature[:, :, None, None, None] * _of_sensors(tuple(found.dimensions.tolist()))
    return np.asarray(of_sensors.reshape(2 * L * N, -1))


@lru_cache(maxsize=64)
def _of_sensors(dimensions: tuple[int, ...]) -> Floats:
    """Which rows (L, 1, 2, L, 2, 1) the columns of sensors are of."""
    axes = np.arange(2) < np.array(dimensions)[:, None]
    own = np.einsum("lk,ij,li->likj", np.eye(len(dimensions)), np.eye(2), axes)
    return np.asarray(own[:, None, ..., None])


@lru_cache(maxsize=64)
def _kinds_of(sensors: int, markers: int) -> Floats:
    """The kinds (q + 3 N, 4) of all fields, as ones: those of sensors, then those of markers."""
    return np.eye(4)[[1, 2, 2] * (2 * sensors) + [3] * (3 * markers)]


def _by_marker(found: Matches, by_place: Floats) -> Floats:
    """Fields (N, 2 L, 3) of each marker: what it is off by along the axes of the world.

    Of weighted Jacobians (R, 3) by its place; a field is nothing in the rows of other markers.
    """
    # in units of how features move with the body, the root mean square of those in view
    counts = 3 * (found.weights > 0).sum(axis=1) @ (found.dimensions * found.each_part)
    moved = math.sqrt(float(np.vdot(by_place, by_place)) / max(float(counts), 1.0))
    return of_each(by_place, found) / max(moved, 1e-6)


def of_each(rows: Floats, found: Matches) -> Floats:
    """Rows (R, k) of all sensors by marker (N, 2 L, k)."""
    L, N = found.shares.shape
    return rows.reshape(L, N, 2, -1).swapaxes(0, 1).reshape(N, 2 * L, -1)


def _folded(rows: Floats, found: Matches) -> Floats:
    """Rows (R, ...) of all sensors, with each coordinate of a cloud in one image instead of two.

    The second coordinate of an image is the first of the next: they err alike, as one.
    """
    folded = rows.reshape(*found.shares.shape, 2, -1).copy()
    for number in np.flatnonzero(found.images > 1):
        own = np.flatnonzero(found.owner == number)
        first, second = folded[np.roll(own, -1), :, 0], folded[own, :, 1]
        folded[own, :, 0], folded[own, :, 1] = 0.0, (first + second) / math.sqrt(2)
    return folded.reshape(rows.shape)
