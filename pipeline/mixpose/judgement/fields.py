"""Fields, patterns of error that residuals have in common, and how much of them a pose absorbs.

A sensor has an offset (kind 1), and fields that turn, scale and shear its features (kind 2); for a
marker it is an error of its place, alike in all sensors (kind 3).  With weights W, A = JᵀWJ and
fields P, one of unit size moves the pose by A⁻¹JᵀWP and leaves (1 − J A⁻¹JᵀW) P in its residuals.
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
    """Weighted residuals at a pose, with q fields of sensors and 3 N fields of markers."""

    r: Floats  # (R,)
    J: Floats  # (R, k) along free directions
    of_sensors: Floats  # (R, q)
    of_markers: Floats  # (N, 2 L, 3)
    kinds: Floats  # (q + 3 N, 4) one-hot
    information: Floats  # (k, k)
    inverse: Floats  # (k, k)
    projected: Floats  # (k, q + 3 N) JᵀWP
    shifts: Floats  # (k, q + 3 N) of the pose by a field of unit size
    remaining: Floats  # (R, q) what the pose leaves of the fields of sensors

    def pulls(self, unbiased: Floats, matches: Matches) -> Floats:
        """Return PᵀWr (q + 3 N): of sensors by residuals without biases (R,), of markers by all."""
        by_markers = rows_by_marker(self.r[:, None], matches).swapaxes(1, 2) @ self.of_markers
        return np.concatenate([unbiased @ self.of_sensors, by_markers.ravel()])

    def expected_squares(self, matches: Matches) -> Floats:
        """Return what errors of each kind add to squares of each kind (4, 4), without tr R.

        What a pose leaves of the fields of two markers has the rank of the pose, so that sums over
        pairs of markers become sums over markers.
        """
        q, count, N = self.of_sensors.shape[1], len(self.projected), len(self.of_markers)
        by_marker = rows_by_marker(self.remaining, matches).swapaxes(1, 2) @ self.of_markers
        with_markers = by_marker.swapaxes(0, 1).reshape(q, 3 * N)
        gram = np.concatenate([self.of_sensors.T @ self.remaining, with_markers], axis=1)
        parts = self.projected[:, q:], self.shifts[:, q:]
        U, W = (part.reshape(count, N, 3).transpose(1, 0, 2) for part in parts)
        shared = U.swapaxes(1, 2) @ W
        blocks = self.of_markers.swapaxes(1, 2) @ self.of_markers - shared
        pairs = np.vdot(parts[0] @ parts[0].T, parts[1] @ parts[1].T)
        expected = self.kinds[:q].T @ gram**2 @ self.kinds
        expected[3, 3] = np.vdot(blocks, blocks) + max(float(pairs - np.vdot(shared, shared)), 0.0)
        expected[3, :3] = expected[:3, 3]
        diagonals = gram.diagonal(), blocks.diagonal(axis1=1, axis2=2).ravel()
        expected[0] = expected[:, 0] = np.concatenate(diagonals) @ self.kinds
        return np.asarray(expected)


def fields_at(
    matches: Matches,
    shares: Floats,  # (L, N) weights of features
    roots: Floats,  # (2 L N) of the weights of residuals
    chosen: Indices,  # (k,) directions that are free
    anywhere: Floats,  # (6,) standard deviations of an unknown pose
) -> Fields:
    """Compute the weighted residuals of the features met, and their fields."""
    r, rows = roots * matches.offsets.ravel(), roots[:, None] * matches.J.reshape(-1, 6)
    fields = fields_of_sensors(matches, shares)
    if matches.owners is not None:
        r, rows, fields = (_folded(array, matches) for array in (r, rows, fields))
    J, count = rows[:, chosen], len(chosen)
    markers = _fields_of_markers(matches, rows[:, :3])
    information = J.T @ J
    information.flat[:: count + 1] += anywhere[chosen] ** -2.0
    inverse = inverted(information)
    by_markers = rows_by_marker(J, matches).swapaxes(1, 2) @ markers  # (N, k, 3)
    projected = np.concatenate([J.T @ fields, by_markers.swapaxes(0, 1).reshape(count, -1)], axis=1)
    remaining = fields - J @ (shifts := inverse @ projected)[:, : fields.shape[1]]
    kinds = _kinds_of(*shares.shape)
    return Fields(r, J, fields, markers, kinds, information, inverse, projected, shifts, remaining)


def fields_of_sensors(matches: Matches, shares: Floats) -> Floats:
    """Return the fields of sensors (R, q), weighted by shares (L, N).

    Each coordinate has an offset (kind 1), and two that turn, scale and shear features about their
    middle (kind 2).
    """
    L, N = shares.shape
    total = np.maximum(shares.sum(axis=1), 1e-6)[:, None]
    away = matches.places - ((shares[:, None] @ matches.places)[:, 0] / total)[:, None]
    spread = np.vecdot(shares, np.vecdot(away, away))
    size = np.sqrt(spread / (matches.dimensions * total[:, 0]))
    by_feature, roots = np.empty((L, N, 3)), np.sqrt(shares)
    by_feature[..., 0] = roots
    by_feature[..., 1:] = away * (roots / np.maximum(size, 1e-6)[:, None])[..., None]
    fields = by_feature[:, :, None, None, None] * _row_mask(tuple(matches.dimensions.tolist()))
    return np.asarray(fields.reshape(2 * L * N, -1))


@lru_cache(maxsize=64)
def _row_mask(dimensions: tuple[int, ...]) -> Floats:
    """Return a mask (L, 1, 2, L, 2, 1) of the rows that each column of a sensor has."""
    axes = np.arange(2) < np.array(dimensions)[:, None]
    mask = np.einsum("lk,ij,li->likj", np.eye(len(dimensions)), np.eye(2), axes)
    return np.asarray(mask[:, None, ..., None])


@lru_cache(maxsize=64)
def _kinds_of(sensors: int, markers: int) -> Floats:
    """Return the one-hot kinds (q + 3 N, 4) of all fields: of sensors, then of markers."""
    return np.eye(4)[[1, 2, 2] * (2 * sensors) + [3] * (3 * markers)]


def _fields_of_markers(matches: Matches, by_place: Floats) -> Floats:
    """Return the fields of markers (N, 2 L, 3): errors of their places along the world's axes.

    `by_place` are weighted Jacobians (R, 3); rows of other markers, which are zero, are left out.
    """
    # in units of the root mean square by which features in view move with the body
    in_view, weights = (matches.weights > 0).sum(axis=1), matches.coordinate_weight
    counts = 3 * in_view @ (matches.dimensions * weights)
    moved = math.sqrt(float(np.vdot(by_place, by_place)) / max(float(counts), 1.0))
    return rows_by_marker(by_place, matches) / max(moved, 1e-6)


def rows_by_marker(rows: Floats, matches: Matches) -> Floats:
    """Group rows (R, k) of all sensors by marker (N, 2 L, k)."""
    L, N = matches.shares.shape
    return rows.reshape(L, N, 2, -1).swapaxes(0, 1).reshape(N, 2 * L, -1)


def _folded(rows: Floats, matches: Matches) -> Floats:
    """Return rows (R, ...) with each coordinate of a cloud in one image instead of two.

    The second coordinate of an image is the first of the next, with the same error.
    """
    folded = rows.reshape(*matches.shares.shape, 2, -1).copy()
    for number in np.flatnonzero(matches.images > 1):
        images = np.flatnonzero(matches.owner == number)
        first, second = folded[np.roll(images, -1), :, 0], folded[images, :, 1]
        folded[images, :, 0], folded[images, :, 1] = 0.0, (first + second) / math.sqrt(2)
    return folded.reshape(rows.shape)
