"""How much the features of a predicted mixture overlap, with derivatives by the pose."""

from __future__ import annotations

from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from mixpose.density import close_pairs, peak

Floats: TypeAlias = NDArray[np.float64]

_NEGLIGIBLE = -28.0  # exponent below which two features do not overlap: 1e-12


class Overlap(NamedTuple):
    """Inner products of a predicted mixture h with itself and its derivatives by the pose.

    Attributes
    ----------
    norm : float, or (L,) array
        ⟨h, h⟩.
    half_gradient : (..., 6) array
        ⟨h, ∂h⟩, half the gradient of the norm.
    gram : (..., 6, 6) array
        ⟨∂h, ∂h⟩.
    second : (..., 6, 6) array
        Second derivative of the norm, without those of the projection.
    apart : bool
        Whether no features overlap, so that derivatives of the norm are zero.
    """

    norm: Any
    half_gradient: Floats
    gram: Floats
    second: Floats
    apart: bool = False


def overlap_terms(y: Floats, J: Floats, weights: Floats, variance: float) -> Overlap:
    """Overlap of the features of a predicted mixture.

    Parameters
    ----------
    y : (n, m) array
        Projected features.
    J : (n, m, 6) array
        Their Jacobians by the pose.
    weights : (n,) array
    variance : float
        2σ².
    """
    top = peak(variance, y.shape[1])
    size = J.shape[-1]
    flat = (J * weights[:, None, None]).reshape(-1, size)
    gram = flat.T @ flat * (top / variance)
    own = float(weights @ weights)
    pairs = close_pairs(y, variance)
    away = y[pairs[:, 0]] - y[pairs[:, 1]]
    exponent = (away * away).sum(axis=1) * (-0.5 / variance)
    near = exponent > _NEGLIGIBLE
    if not near.any():
        return Overlap(top * own, np.zeros(size), gram, np.zeros((size, size)))
    i, j = pairs[near, 0], pairs[near, 1]
    away, bells = away[near], weights[i] * weights[j] * np.exp(exponent[near]) * top
    J_i, J_j = J[i], J[j]
    along_i = np.einsum("pm,pmk->pk", away, J_i)
    along_j = np.einsum("pm,pmk->pk", away, J_j)
    along = along_i - along_j
    half_gradient = -(bells @ along) / variance
    cross = _weighted(bells, J_i, J_j) / variance - (along_i.T * bells) @ along_j / variance**2
    J_apart = J_i - J_j
    second = (along.T * bells) @ along / variance**2 - _weighted(bells, J_apart, J_apart) / variance
    norm = top * own + 2 * float(bells.sum())
    return Overlap(norm, half_gradient, gram + cross + cross.T, 2 * second)


def _weighted(weights: Floats, A: Floats, B: Floats) -> Floats:
    """Σ_p w_p A_pᵀ B_p for A and B of shape (p, m, k)."""
    size = A.shape[-1]
    return np.asarray((A * weights[:, None, None]).reshape(-1, size).T @ B.reshape(-1, size))


def overlaps_of_few(y: Floats, J: Floats, weights: Floats, variances: Floats) -> Overlap:
    """As `overlap_terms`, for L sensors at once and by all pairs.

    Parameters
    ----------
    y : (L, n, m) array
    J : (L, n, m, 6) array
    weights : (L, n) array
        Zero for features that are not seen.
    variances : (L,) array
    """
    L, n, m = y.shape
    tops = (2 * np.pi * variances) ** (-m / 2)
    scale = 1 / variances
    weighted = J * weights[..., None, None]
    flat = weighted.reshape(L, n * m, 6)
    away = y[:, :, None] - y[:, None]
    exponents = (away * away).sum(axis=3) * (-0.5 * scale)[:, None, None]
    together = exponents > _NEGLIGIBLE
    if np.count_nonzero(together) > L * n:
        # those that are not seen sit together far outside
        together &= (weights[:, :, None] * weights[:, None]) > 0
    if np.count_nonzero(together) <= L * n:
        gram = flat.swapaxes(1, 2) @ flat * (tops * scale)[:, None, None]
        norm = tops * (weights * weights).sum(axis=1)
        return Overlap(norm, np.zeros((L, 6)), gram, np.zeros((L, 6, 6)), apart=True)
    bells = np.exp(exponents) * tops[:, None, None]
    pull = (bells[..., None] * away * weights[:, None, :, None]).sum(axis=2) * -scale[:, None, None]
    half_gradient = (pull.reshape(L, 1, n * m) @ flat)[:, 0]
    norm = ((weights[:, None] @ bells)[:, 0] * weights).sum(axis=1)
    # bend_ij = b_ij (d dᵀ/v² − I/v), the second derivative of a pair's bell by its distance
    v = scale[:, None, None, None, None]
    bend = away[..., :, None] * away[..., None, :] * v**2 - v * np.eye(m)
    bend *= bells[..., None, None]
    between = bend.swapaxes(2, 3).reshape(L, n * m, n * m)
    gram = -(flat.swapaxes(1, 2) @ (between @ flat))
    around = (bend * weights[:, None, :, None, None]).sum(axis=2)
    own = flat.swapaxes(1, 2) @ (around @ J).reshape(L, n * m, 6)
    return Overlap(norm, half_gradient, gram, 2 * (own + gram))
