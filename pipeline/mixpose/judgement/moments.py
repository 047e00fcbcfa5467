"""Moments of residuals: what independent errors, fields of a sensor and markers have of them.

The formulae stand in `noise`; here they are worked out for K frames at once.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mixpose.judgement.persistent_bias import PersistentBias
from mixpose.matching import Matches
from mixpose.records import Floats

LEAST = 1e-6  # degrees of freedom: less is as good as none
_MIN_INFORMATION = 1e-18  # per squared length or radian: less is as good as none
_LEAST_EIGENVALUE = 1e-14  # of an information matrix of diagonal 1: float64 tells no less from none


class Moments(NamedTuple):
    """Sums over frames, from which the variances of independent errors and of fields follow."""

    seen: Floats = np.zeros(4)  # rᵀWr and |P_kᵀWr|²
    expected: Floats = np.zeros((4, 4))  # of these, by unit variances of each kind

    def joined(self, other: Moments, memory: float) -> Moments:
        """Add those of another frame."""
        return Moments(memory * self.seen + other.seen, memory * self.expected + other.expected)


class Frame(NamedTuple):
    """What one frame shows."""

    moments: Moments
    parts: Floats  # (4, k, k) covariances that unit variances of each kind make
    bias: PersistentBias  # what it says of fields that last
    by_fields: Floats  # (k, q) how these move the pose
    by_calibration: Floats  # (k, K) how calibrations do, off by a deviation in one thing each
    rest: Floats  # (R, 1 + q) weighted residuals, and what a pose leaves of fields that may last
    fields: Floats  # (R, q) those that change
    kinds: Floats  # (q, 2) which of them are offsets, and which turn, scale and shear: 1 or 0

    def without(self, sizes: Floats) -> Moments:
        """Moments of what is left where fields of sizes (q,) are taken off."""
        left, expected = self.rest[:, 0] - self.rest[:, 1:] @ sizes, self.moments.expected
        by_fields = (left @ self.fields) ** 2 @ self.kinds
        seen = np.array([left @ left, *by_fields, self.moments.seen[3]])
        return Moments(seen * expected.any(), expected)


def frames_of(
    found: Matches, variances: Floats, free: NDArray[np.bool_], outlying: float
) -> list[Frame]:
    """What K frames show, for noise (K, L) in σ_ε².

    Detections are left out that are farther off than `outlying` standard deviations of the noise.
    """
    clear = found.squared <= outlying**2 * variances[..., None]
    shares, most = np.where(clear, found.shares, 0.0), int(found.dimensions.max())
    noise, frames = np.sqrt(variances), len(shares)
    scale = (np.sqrt(shares) / noise[..., None])[..., None]
    rows = scale[..., None] * found.J[..., :most, :]
    r = (scale * found.offsets[..., :most]).reshape(frames, -1, 1)
    J = rows[..., free].reshape(frames, r.shape[1], -1)
    fields, kinds = _fields(found.places[..., :most], shares, found.dimensions)
    inverse = inverses(J.swapaxes(1, 2) @ J)
    drawn = inverse @ (J.swapaxes(1, 2) @ fields)
    left = fields - J @ drawn
    information, vector = left.swapaxes(1, 2) @ left, (left.swapaxes(1, 2) @ r)[..., 0]
    # how features move with the body, by the root mean square of those in view
    counts = 3 * np.count_nonzero(found.weights, axis=2) @ found.dimensions
    moved = np.sqrt((rows[..., :3] ** 2).sum(axis=(1, 2, 3, 4)) / np.maximum(counts, 1))
    shift = rows[..., :3] / np.maximum(moved, LEAST)[:, None, None, None, None]
    pulls = (fields.swapaxes(1, 2) @ r)[..., 0]
    seen, expected, part = _moments(shift, J, r, left, pulls, information, kinds, inverse)
    expected[:, 0, 0] = (shares * found.dimensions[:, None]).sum(axis=(1, 2)) - J.shape[2]
    of_fields = (drawn[:, None] * kinds.T[:, None]) @ drawn.swapaxes(1, 2)[:, None]
    parts = np.concatenate([inverse[:, None], of_fields, part[:, None]], axis=1)
    # the noise of the sensor that each field is of
    sizes = np.repeat(noise, len(kinds) // noise.shape[1], axis=1)[:, None]
    information /= sizes.swapaxes(1, 2) * sizes
    by_calibration = np.zeros((frames, J.shape[2], 0))
    if found.by_calibration is not None:
        pulls = (scale[..., None] * found.by_calibration[..., :most, :]).reshape(*r.shape[:2], -1)
        by_calibration = inverse @ (J.swapaxes(1, 2) @ pulls)
    each = zip(
        [Moments(*one) if one[1][0, 0] > 0 else Moments() for one in zip(seen, expected)],
        parts,
        [PersistentBias(found.names, *one) for one in zip(information, vector / sizes[:, 0])],
        drawn / sizes,
        by_calibration,
        np.concatenate([r, left / sizes], axis=2),
        fields,
        [kinds] * frames,
        strict=True,
    )
    return [Frame(*one) for one in each]


def _fields(places: Floats, shares: Floats, dimensions: NDArray[np.intp]) -> tuple[Floats, Floats]:
    """What all features of a sensor have in common (K, R, q), by the roots of their shares.

    Along each coordinate an offset, and what turns, scales and shears; sensors have columns of
    their own.  The kinds are those of a `Frame`.
    """
    frames, sensors, n, most = places.shape
    total = np.maximum(shares.sum(axis=2), LEAST)[..., None]
    away = places - ((shares[:, :, None] @ places)[:, :, 0] / total)[:, :, None]
    spread = (shares[..., None] * away * away).sum(axis=(2, 3))
    size = np.sqrt(spread / (dimensions * total[..., 0]))
    away /= np.maximum(size, LEAST)[..., None, None]
    by_feature = np.concatenate([np.ones((*away.shape[:3], 1)), away], axis=3)
    by_feature *= np.sqrt(shares)[..., None]
    columns, kinds = _columns(tuple(dimensions.tolist()), most)
    fields = by_feature[:, :, :, None, None, None] * columns[:, None, ..., None]
    return fields.reshape(frames, sensors * n * most, -1), kinds


@lru_cache(maxsize=64)
def _columns(dimensions: tuple[int, ...], most: int) -> tuple[Floats, Floats]:
    """Which rows (L, m) each sensor's columns (L, m) are of, and the kinds of these."""
    sensors = len(dimensions)
    axes = np.arange(most) < np.array(dimensions)[:, None]
    columns = np.einsum("lk,ij,li->likj", np.eye(sensors), np.eye(most), axes)
    kinds = np.tile(np.repeat(np.eye(2), [1, most], axis=0), (sensors * most, 1))
    return columns, kinds


def _moments(
    shift: Floats,
    J: Floats,
    r: Floats,
    left: Floats,
    pulls: Floats,
    information: Floats,
    kinds: Floats,
    inverse: Floats,
) -> tuple[Floats, Floats, Floats]:
    """Moments seen (K, 4) and expected (K, 4, 4), but for tr R, and the markers' part (K, k, k).

    Of what markers are off by, P_3 has three columns each: one by one.
    """
    frames, sensors, n, most, _ = shift.shape
    count, by_marker = J.shape[2], (frames, n, sensors * most, -1)
    columns = np.concatenate([J, r, shift.reshape(frames, -1, 3), left], axis=2)
    columns = columns.reshape(frames, sensors, n, most, -1).swapaxes(1, 2).reshape(by_marker)
    own = shift.swapaxes(1, 2).reshape(by_marker).swapaxes(2, 3) @ columns
    by_pose, by_rest, by_shift, by_fields = np.split(own, [count, count + 1, count + 4], axis=3)
    taken, flat = by_pose @ inverse[:, None], by_pose.reshape(frames, -1, count)
    drawn = inverse @ flat.swapaxes(1, 2)
    spread, within = drawn @ flat, by_shift - 2 * taken @ by_pose.swapaxes(2, 3)
    K = (within * by_shift).sum(axis=(1, 2, 3)) + (spread * spread.swapaxes(1, 2)).sum(axis=(1, 2))
    once = by_shift.sum(axis=1).trace(axis1=1, axis2=2) - (taken * by_pose).sum(axis=(1, 2, 3))
    seen, expected = np.zeros((frames, 4)), np.zeros((frames, 4, 4))
    seen[:, 0], seen[:, 3] = (r * r).sum(axis=(1, 2)), (by_rest**2).sum(axis=(1, 2, 3))
    seen[:, 1:3] = pulls**2 @ kinds
    of_fields = information.diagonal(axis1=1, axis2=2) @ kinds
    expected[:, 0, 1:] = expected[:, 1:, 0] = np.column_stack([of_fields, once])
    expected[:, 1:3, 1:3] = kinds.T @ information**2 @ kinds
    both = np.column_stack([(by_fields**2).sum(axis=(1, 2)) @ kinds, K])
    expected[:, 3, 1:] = expected[:, 1:, 3] = both
    # the part is not less than nothing where a direction is hardly determined
    return seen, expected, drawn @ drawn.swapaxes(1, 2)


def inverses(information: Floats) -> Floats:
    """Inverses of information matrices (K, k, k).

    Directions that the data leave open get the variance that their information says: large, and
    at most what float64 can invert.
    """
    diagonal = information.diagonal(axis1=1, axis2=2)
    scale = 1.0 / np.sqrt(np.maximum(diagonal, _MIN_INFORMATION))
    both = scale[:, :, None] * scale[:, None]
    values, vectors = np.linalg.eigh(information * both)
    vectors_by_value = vectors / np.maximum(values, _LEAST_EIGENVALUE)[:, None]
    inverse = vectors_by_value @ vectors.swapaxes(1, 2) * both
    return np.asarray((inverse + inverse.swapaxes(1, 2)) / 2)
