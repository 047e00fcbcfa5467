"""Moments of residuals: what independent errors, fields of a sensor and markers have of them.

The formulae stand in `noise`; here they are worked out for K frames at once.
"""

from __future__ import annotations

from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from mixpose.judgement.lasting import Lasting
from mixpose.judgement.stacked import Stacked

Floats: TypeAlias = NDArray[np.float64]

LEAST = 1e-6  # degrees of freedom: less is as good as none
_MIN_INFORMATION = 1e-18  # per squared length or radian: less is as good as none
_LEAST_EIGENVALUE = 1e-14  # of an information matrix of diagonal 1: float64 tells no less from none


class Moments(NamedTuple):
    """Sums over frames, from which the variances of independent errors and of fields follow.

    Attributes
    ----------
    seen : (4,) float64
        rᵀWr and |P_kᵀWr|².
    expected : (4, 4) float64
        Of these, by unit variances of each kind.
    """

    seen: Floats = np.zeros(4)
    expected: Floats = np.zeros((4, 4))

    def joined(self, other: Moments, memory: float) -> Moments:
        """Add those of another frame."""
        return Moments(memory * self.seen + other.seen, memory * self.expected + other.expected)


class Frame(NamedTuple):
    """What one frame shows.

    Attributes
    ----------
    moments : Moments
    parts : (4, k, k) float64
        Covariances that unit variances of each kind make.
    lasting : Lasting
        What it says of fields that last.
    by_fields : (k, q) float64
        How these move the pose.
    by_calibration : (k, K) float64
        How calibrations do that are off by a standard deviation in one thing each.
    rest : (R, 1 + q) float64
        Weighted residuals, and what a pose leaves of the fields that may last.
    fields : list of (R, n) float64
        Those that change, of each kind.
    """

    moments: Moments
    parts: Floats
    lasting: Lasting
    by_fields: Floats
    by_calibration: Floats
    rest: Floats
    fields: list[Floats]

    def without(self, sizes: Floats) -> Moments:
        """Moments of what is left where fields of sizes (q,) are taken off."""
        left = self.rest[:, 0] - self.rest[:, 1:] @ sizes
        seen = [float(left @ left), *(float(((P.T @ left) ** 2).sum()) for P in self.fields)]
        expected = self.moments.expected
        return Moments(np.array([*seen, self.moments.seen[3]]) * expected.any(), expected)


def frames_of(
    found: Stacked, variances: Floats, free: NDArray[np.bool_], outlying: float
) -> list[Frame]:
    """What K frames show.

    Parameters
    ----------
    found : Stacked
    variances : (K, L) array
        Of the noise of each sensor, in σ_ε².
    free : (6,) bool
    outlying : float
        Standard deviations of the noise beyond which detections are left out.
    """
    squared = (found.offsets * found.offsets).sum(axis=3)
    clear = squared <= outlying**2 * variances[..., None]
    shares = np.where(clear, found.shares, 0.0)
    roots, axes = np.sqrt(shares), np.arange(found.J.shape[3]) < found.dimensions[:, None]
    scale = (roots / np.sqrt(variances)[..., None])[..., None]
    count, frames = int(free.sum()), len(shares)
    rows = scale[..., None] * found.J
    shift = _in_noise(rows[..., :3], found)
    r = (scale * found.offsets).reshape(frames, -1, 1)
    J = rows[..., free].reshape(frames, -1, count)
    P = _fields(found.places, shares, roots, axes)
    split = P[0].shape[2]
    fields = np.concatenate(P, axis=2)
    inverse = inverses(J.swapaxes(1, 2) @ J)
    drawn = inverse @ (J.swapaxes(1, 2) @ fields)
    left = fields - J @ drawn
    information, vector = left.swapaxes(1, 2) @ left, (left.swapaxes(1, 2) @ r)[..., 0]
    markers = _of_markers(shift, J, r, left, split, inverse)
    kinds = slice(split), slice(split, None)
    degrees = (shares * found.dimensions[:, None]).sum(axis=(1, 2)) - count
    of_errors = (r * r).sum(axis=(1, 2)), degrees
    by_fields = (fields.swapaxes(1, 2) @ r)[..., 0] ** 2
    moments = _moments(of_errors, by_fields, information, kinds, markers)
    of_fields = [drawn[..., kind] @ drawn[..., kind].swapaxes(1, 2) for kind in kinds]
    parts = np.stack([inverse, *of_fields, markers.part], axis=1)
    sizes = _sizes(np.sqrt(variances), axes)
    information /= sizes[:, :, None] * sizes[:, None]
    names = tuple(one.name for one in found.each[0])
    doubts = _doubts(found, scale, J, inverse)
    return [
        Frame(
            moments[k] if degrees[k] > 0 else Moments(),
            parts[k],
            Lasting(names, information[k], vector[k] / sizes[k]),
            drawn[k] / sizes[k],
            doubts[k],
            np.hstack([r[k], left[k] / sizes[k]]),
            [one[k] for one in P],
        )
        for k in range(frames)
    ]


def _moments(
    of_errors: tuple[Floats, Floats],
    by_fields: Floats,
    information: Floats,
    kinds: tuple[slice, slice],
    markers: _OfMarkers,
) -> list[Moments]:
    """Moments of K frames, of errors (K,), of fields of two kinds (K, q), and of markers."""
    frames = len(information)
    seen, expected = np.zeros((frames, 4)), np.zeros((frames, 4, 4))
    seen[:, 0], expected[:, 0, 0] = of_errors
    seen[:, 3] = markers.squares
    expected[:, 0, 3] = expected[:, 3, 0] = markers.once
    expected[:, 3, 1:] = expected[:, 1:, 3] = markers.K
    for i, a in enumerate(kinds):
        seen[:, 1 + i] = by_fields[:, a].sum(axis=1)
        own = information[:, a, a].trace(axis1=1, axis2=2)
        expected[:, 0, 1 + i] = expected[:, 1 + i, 0] = own
        for j, b in enumerate(kinds):
            expected[:, 1 + i, 1 + j] = (information[:, a, b] ** 2).sum(axis=(1, 2))
    return [Moments(*pair) for pair in zip(seen, expected)]


def _in_noise(shift: Floats, found: Stacked) -> Floats:
    """How features move with the body (K, L, N, M, 3), by the root mean square in view."""
    counts = np.array([[len(one.features) for one in each] for each in found.each])
    sizes = 3 * counts @ found.dimensions
    roots = np.sqrt((shift * shift).sum(axis=(1, 2, 3, 4)) / np.maximum(sizes, 1))
    return np.asarray(shift / np.maximum(roots, LEAST)[:, None, None, None, None])


def _sizes(roots: Floats, axes: NDArray[np.bool_]) -> Floats:
    """The noise (K, L) of the sensor that each field is of (K, q)."""
    most = axes.shape[1]
    return np.concatenate([np.repeat(roots, most, axis=1), np.repeat(roots, most**2, axis=1)], 1)


def _fields(
    places: Floats, shares: Floats, roots: Floats, axes: NDArray[np.bool_]
) -> tuple[Floats, Floats]:
    """What all features of a sensor have in common, with the roots of their shares.

    Offsets, and what turns, scales and shears; sensors have columns of their own.
    """
    frames, sensors, n, most = places.shape
    total = np.maximum(shares.sum(axis=2), LEAST)[..., None]
    away = places - ((shares[:, :, None] @ places)[:, :, 0] / total)[:, :, None]
    spread = (shares[..., None] * away * away).sum(axis=(2, 3))
    size = np.sqrt(spread / (axes.sum(axis=1) * total[..., 0]))
    away *= (roots / np.maximum(size, LEAST)[..., None])[..., None]
    own = np.arange(sensors)
    shifts = np.zeros((frames, sensors, n, most, sensors, most))
    slants = np.zeros((frames, sensors, n, most, sensors, most, most))
    for i in np.flatnonzero(axes.any(axis=0)).tolist():
        there = own[axes[:, i]]
        shifts[:, there, :, i, there, i] = roots[:, there].swapaxes(0, 1)
        slants[:, there, :, i, there, :, i] = away[:, there].swapaxes(0, 1)
    rows = frames, sensors * n * most, -1
    return shifts.reshape(rows), slants.reshape(rows)


class _OfMarkers(NamedTuple):
    """K_3k (K, 3), tr K_33, |P_3ᵀWr|², and the covariance that a unit variance makes."""

    K: Floats
    once: Floats
    squares: Floats
    part: Floats


def _of_markers(
    shift: Floats, J: Floats, r: Floats, left: Floats, split: int, inverse: Floats
) -> _OfMarkers:
    """Moments of what markers are off by, of which P_3 has three columns each: one by one.

    `shift` is how features move with the body, in units in which their images move by the noise;
    the first columns of `left` are fields of the first kind.
    """
    frames, sensors, n, most, _ = shift.shape
    columns = np.concatenate([J, r, shift.reshape(frames, -1, 3), left], axis=2)
    columns = columns.reshape(frames, sensors, n, most, -1)
    by_marker = (frames, n, sensors * most, -1)
    columns = columns.transpose(0, 2, 1, 3, 4).reshape(by_marker)
    own = shift.transpose(0, 2, 1, 3, 4).reshape(by_marker).swapaxes(2, 3) @ columns
    count = J.shape[2]
    widths = np.cumsum([count, 1, 3, split])
    by_pose, by_rest, by_shift, *by_fields = np.split(own, widths, axis=3)
    taken, flat = by_pose @ inverse[:, None], by_pose.reshape(frames, -1, count)
    drawn = inverse @ flat.swapaxes(1, 2)
    spread = drawn @ flat
    within = by_shift - 2 * taken @ by_pose.swapaxes(2, 3)
    K = (within * by_shift).sum(axis=(1, 2, 3)) + (spread * spread.swapaxes(1, 2)).sum(axis=(1, 2))
    return _OfMarkers(
        np.stack([*((one * one).sum(axis=(1, 2, 3)) for one in by_fields), K], axis=1),
        by_shift.sum(axis=1).trace(axis1=1, axis2=2) - (taken * by_pose).sum(axis=(1, 2, 3)),
        (by_rest * by_rest).sum(axis=(1, 2, 3)),
        drawn
        @ drawn.swapaxes(1, 2),  # not less than nothing where a direction is hardly determined
    )


def _doubts(found: Stacked, scale: Floats, J: Floats, inverse: Floats) -> list[Floats]:
    """How calibrations that are off move each pose (k, K)."""
    moved = []
    rows = J.reshape(*found.J.shape[:4], -1)
    for k, each in enumerate(found.each):
        doubts = [np.zeros((J.shape[2], 0))]
        for i, one in enumerate(each):
            if one.by_calibration is None:
                continue
            m = found.dimensions[i]
            own = (scale[k, i, one.features, :, None] / one.sigma) * one.by_calibration
            doubts.append(np.einsum("nmc,nmq->cq", rows[k, i, one.features, :m], own))
        moved.append(inverse[k] @ np.hstack(doubts))
    return moved


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
