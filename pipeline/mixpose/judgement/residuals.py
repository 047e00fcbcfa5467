"""Residuals by the roots of their weights, the fields they may have in common, and moments."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from mixpose.matching import Matches
from mixpose.records import Floats


def weighted(found: Matches, shares: Floats, noise: Floats) -> tuple[Floats, Floats, Floats]:
    """Residuals r (R,), Jacobian (R, 6), and offsets (R, Q) by calibrations, at one pose.

    Of features met by shares (L, N), R = 2 L N, in standard deviations of the noise (L,).
    """
    roots = (np.sqrt(shares) / noise[:, None])[..., None]
    r = (roots * found.offsets).ravel()
    J = (roots[..., None] * found.J).reshape(len(r), 6)
    if found.by_calibration is None:
        return r, J, np.zeros((len(r), 0))
    return r, J, (roots[..., None] * found.by_calibration).reshape(len(r), -1)


def fields_of(found: Matches, shares: Floats, J: Floats) -> tuple[Floats, Floats]:
    """Fields (R, q + 3 N) of sensors and markers; their kinds (q + 3 N, 4), 1 where it is of one.

    All features of a sensor have in common, along each coordinate, an offset (kind 1) and what
    turns, scales and shears them about their middle (kind 2); of a marker (kind 3) all sensors
    have in common what it is off by along the axes of the world.
    """
    L, N = shares.shape
    total = np.maximum(shares.sum(axis=1), 1e-6)[:, None]
    away = found.places - ((shares[:, None] @ found.places)[:, 0] / total)[:, None]
    spread = (shares[..., None] * away * away).sum(axis=(1, 2))
    size = np.sqrt(spread / (found.dimensions * total[:, 0]))
    away /= np.maximum(size, 1e-6)[:, None, None]
    by_feature = np.concatenate([np.ones((L, N, 1)), away], axis=2) * np.sqrt(shares)[..., None]
    columns, kinds = _columns(tuple(found.dimensions.tolist()), N)
    of_sensors = by_feature[:, :, None, None, None] * columns[:, None, ..., None]
    # in units of how features move with the body, the root mean square of those in view
    counts = 3 * np.count_nonzero(found.weights, axis=1) @ found.dimensions
    moved = np.sqrt((J[:, :3] ** 2).sum() / max(counts, 1))
    by_place = J[:, :3].reshape(L, N, 2, 1, 3) / max(moved, 1e-6)
    of_markers = by_place * np.eye(N)[:, None, :, None]
    return np.hstack([of_sensors.reshape(len(J), -1), of_markers.reshape(len(J), -1)]), kinds


@lru_cache(maxsize=64)
def _columns(dimensions: tuple[int, ...], markers: int) -> tuple[Floats, Floats]:
    """Which rows (L, 2) the columns (L, 2) of each sensor are of, and the kinds of all fields."""
    L = len(dimensions)
    axes = np.arange(2) < np.array(dimensions)[:, None]
    columns = np.einsum("lk,ij,li->likj", np.eye(L), np.eye(2), axes)
    return columns, np.eye(4)[[1, 2, 2] * (2 * L) + [3] * (3 * markers)]


def normal_equations(
    r: Floats, redundancy: float, fields: Floats, left: Floats, pulls: Floats, kinds: Floats
) -> Floats:
    """Moments (4, 5), [expected | seen], of independent errors and fields of each kind.

    `left` is what a pose leaves of fields, `pulls` how these pull at residuals, `redundancy` tr R.
    """
    moments = np.zeros((4, 5))
    if redundancy > 0:
        gram = fields.T @ left
        moments[:, :4] = kinds.T @ gram**2 @ kinds
        moments[0, :4] = moments[:, 0] = gram.diagonal() @ kinds
        moments[0, 0], moments[0, 4] = redundancy, r @ r
        moments[1:, 4] = pulls**2 @ kinds[:, 1:]
    return moments
