"""The matched kernel: ⟨g, h⟩² / ⟨h, h⟩ of L sensors at H poses, with its derivatives.

With c = ⟨g, h⟩ = Σ_i w_i C(p_i), n = ⟨h, h⟩ = Σ_ij w_i w_j N(p_i − p_j; 0, v), v = 2σ², and the
amplitude a = c / n that fits h to g best,

    S = c a,     ∇S = 2 a (∇c − a ∇n / 2).

Steps are taken by curvatures that are never negative.  Where predicted features lie apart it is
that of mean-shift, 2 a Σ_i w_i C_i J_iᵀ J_i / v.  A Gaussian around a detection at y_i has
∇C = C (y_i − p_i) / v, so that the step is that of least squares to the detections around the
features, with weights C_i: it gets there at once from any distance, and a feature that meets none
does not hold the others back.  Where features overlap their pulls are not their own, and the
curvature is Gauss-Newton's of the residual g − a h, 2 a² (⟨∂h, ∂hᵀ⟩ − ⟨h, ∂h⟩⟨h, ∂hᵀ⟩ / n).
"""

from __future__ import annotations

import numpy as np

from mixpose.density import DRAWING, all_pairs, close_pairs
from mixpose.objective.projection import Match
from mixpose.optimise import Quadratic
from mixpose.records import Floats, Indices

_NONE = np.finfo(np.float64).tiny  # ⟨h, h⟩ of a sensor that sees no feature


def overlaps(
    y: Floats, weights: Floats, variances: Floats, tops: Floats
) -> tuple[Floats, Indices, Floats, Floats]:
    """⟨h, h⟩ of features y (L, H, n, 2) of weights (L, H, n), and their overlaps, as `Match` has.

    `variances` and `tops` (L, 1) are v, and the peak of a Gaussian of that variance.
    """
    norm, n = tops * (weights * weights).sum(axis=2), y.shape[2]
    pairs = all_pairs(n) if n * n <= DRAWING.few_pairs else _close_pairs(y, variances)
    i, j = pairs.T
    away = y[:, :, i] - y[:, :, j]
    squared = away * away
    exponents = (squared[..., 0] + squared[..., 1]) * (-0.5 / variances)[..., None]
    overlap = exponents > -DRAWING.negligible
    if not overlap.any():
        return np.maximum(norm, _NONE), pairs[:0], exponents[..., :0], away[:, :, :0]
    near = np.flatnonzero(overlap.any(axis=(0, 1)))
    products = (weights[:, :, i] * weights[:, :, j])[..., near]
    bells = overlap[..., near] * products * np.exp(exponents[..., near]) * tops[..., None]
    norm = np.maximum(norm + 2 * bells.sum(axis=2), _NONE)
    return norm, pairs[near], bells, away[:, :, near]


def _close_pairs(y: Floats, variances: Floats) -> Indices:
    """Pairs of features that may overlap at any of the poses."""
    L, H, n, _ = y.shape
    each = [close_pairs(y[k, h], float(variances[k, 0])) for k in range(L) for h in range(H)]
    return np.unique(np.concatenate(each), axis=0)


def slopes(match: Match, variances: Floats, tops: Floats, scales: Floats) -> Quadratic:
    """Second-order models of Σ_l s_l c_l² / n_l at H poses.

    `variances`, `tops` and `scales` (L, 1) are v, N(0; 0, v), and the factor s of each sensor.
    """
    L, H, n = match.weights.shape
    C = match.sampled[..., 0] * match.weights
    pull = (match.sampled[..., 1:] * match.weights[..., None]).reshape(L, H, 1, 2 * n)
    rest = (pull @ match.J.reshape(L, H, 2 * n, 6))[:, :, 0]
    product = C.sum(axis=2)
    amplitude = product / match.norm
    strength = 2 * scales * amplitude
    value = (scales * product * amplitude).sum(axis=0)
    gradient = (strength[..., None] * rest).sum(axis=0)
    drawn = (strength / variances)[..., None] * C
    curvature = _gram(match.J, drawn[..., None, None] * match.J).sum(axis=0)
    if len(match.pairs):
        near = np.flatnonzero(match.bells.any(axis=(0, 2)))
        some = match.of(near)
        half, gram = _pair_terms(some, variances, tops)
        level = (strength * amplitude)[:, near, None]
        gradient[near] -= (level * half).sum(axis=0)
        outer = half[..., :, None] * half[..., None, :] / some.norm[..., None, None]
        curvature[near] = (level[..., None] * (gram - outer)).sum(axis=0)
    return Quadratic(value, gradient, curvature)


def _pair_terms(match: Match, variances: Floats, tops: Floats) -> tuple[Floats, Floats]:
    """⟨h, ∂h⟩ (L, H, 6) and ⟨∂h, ∂hᵀ⟩ (L, H, 6, 6)."""
    v, (i, j) = variances[..., None], match.pairs.T
    own = match.J * match.weights[..., None, None]
    gram = _gram(own, own) * (tops / variances)[..., None, None]
    J_i, J_j = match.J[:, :, i], match.J[:, :, j]
    along_i, along_j = (np.einsum("lhpm,lhpmk->lhpk", match.away, each) for each in (J_i, J_j))
    scaled = match.bells / v
    half = -(scaled[:, :, None] @ (along_i - along_j))[:, :, 0]
    cross = _gram(scaled[..., None, None] * J_i, J_j)
    cross -= ((scaled / v)[..., None] * along_i).swapaxes(2, 3) @ along_j
    return half, gram + cross + cross.swapaxes(2, 3)


def _gram(A: Floats, B: Floats) -> Floats:
    """Σ_p A_pᵀ B_p (L, H, 6, 6) of A and B (L, H, P, 2, 6)."""
    L, H, P = A.shape[:3]
    return A.reshape(L, H, 2 * P, 6).swapaxes(2, 3) @ B.reshape(L, H, 2 * P, 6)
