"""The matched kernel: ⟨g, h⟩² / ⟨h, h⟩ of L sensors at H poses, with its derivatives.

With c = ⟨g, h⟩ = Σ_i w_i C(p_i), n = ⟨h, h⟩ = Σ_ij w_i w_j N(p_i − p_j; 0, v), v = 2σ², and the
amplitude a = c / n that fits h to g best,

    S = c a,     ∇S = 2 a (∇c − a ∇n / 2).

Steps are taken by curvatures that are never negative.  Where predicted features lie apart it is
that of mean-shift, 2 a Σ_i w_i C_i J_iᵀ J_i / v.  A Gaussian around a detection at y_i has
∇C = C (y_i − p_i) / v, so that the step is that of least squares to the detections around the
features, with weights C_i: it gets there at once from any distance, and a feature that meets none
does not hold the others back.  (Newton's step, with C I / v − ∇C ∇Cᵀ / C in place of C I / v,
shrinks with the distance.)  Where features overlap their pulls are not their own, and the curvature
is Gauss-Newton's of the residual g − a h, 2 a² (⟨∂h, ∂hᵀ⟩ − ⟨h, ∂h⟩⟨h, ∂hᵀ⟩ / n).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mixpose.density import DRAWING, close_pairs
from mixpose.objective.projection import Projected
from mixpose.optimise import Quadratic
from mixpose.records import Floats

_NONE = np.finfo(np.float64).tiny  # ⟨h, h⟩ of a sensor that sees no feature


class Overlaps(NamedTuple):
    """⟨h, h⟩, and what its derivatives are made of: close pairs of predicted features."""

    norm: Floats  # (L, H)
    pairs: NDArray[np.intp]  # (P, 2), i < j
    bells: Floats  # (L, H, P) w_i w_j N(p_i − p_j; 0, v); 0 where the two do not overlap
    away: Floats  # (L, H, P, 2) p_i − p_j


class Match(NamedTuple):
    """Features that are predicted at H poses, C and its gradient there (L, H, n, 3), and ⟨h, h⟩."""

    at: Projected
    sampled: Floats
    over: Overlaps

    def of(self, poses: slice | NDArray[np.intp], n: int | None = None) -> Match:
        """The same at some of the poses, of the first n features; the others have no weight."""
        norm, pairs, bells, away = self.over
        bells = bells[:, poses]
        near = bells.any(axis=(0, 1))
        over = Overlaps(norm[:, poses], pairs[near], bells[..., near], away[:, poses][:, :, near])
        at = Projected._make(one[:, poses, :n] for one in self.at)
        return Match(at, self.sampled[:, poses, :n], over)


def overlaps(y: Floats, weights: Floats, variances: Floats, tops: Floats) -> Overlaps:
    """How far predicted features y (L, H, n, 2) of weights (L, H, n) overlap.

    `variances` and `tops` (L, 1) are v, and the peak of a Gaussian of that variance.
    """
    norm = tops * np.einsum("lhn,lhn->lh", weights, weights)
    pairs = close_pairs(y[0, 0, :0], 1.0) if _are_apart(y, variances) else _pairs(y, variances)
    if not len(pairs):
        away = np.empty((*norm.shape, 0, 2))
        return Overlaps(np.maximum(norm, _NONE), pairs, away[..., 0], away)
    i, j = pairs[:, 0], pairs[:, 1]
    away = y[:, :, i] - y[:, :, j]
    exponents = np.einsum("lhpm,lhpm->lhp", away, away) * (-0.5 / variances)[..., None]
    products = weights[:, :, i] * weights[:, :, j]
    overlap = (exponents > -DRAWING.negligible) & (products > 0)
    near = overlap.any(axis=(0, 1))
    if not near.all():
        pairs, away, overlap = pairs[near], away[:, :, near], overlap[..., near]
        exponents, products = exponents[..., near], products[..., near]
    bells = np.where(overlap, products * np.exp(exponents) * tops[..., None], 0.0)
    norm += 2 * bells.sum(axis=2)
    return Overlaps(np.maximum(norm, _NONE), pairs, bells, away)


def _are_apart(y: Floats, variances: Floats) -> bool:
    """Whether no two of few features are near enough to overlap."""
    L, H, n, _ = y.shape
    if n > DRAWING.few:
        return False
    away = y[:, :, :, None] - y[:, :, None]
    away *= away
    close = away[..., 0] + away[..., 1] < (2 * DRAWING.negligible) * variances[..., None, None]
    return bool(np.count_nonzero(close) <= L * H * n)  # each is close to itself


def _pairs(y: Floats, variances: Floats) -> NDArray[np.intp]:
    """Pairs of features that may overlap at any of the poses; all of few."""
    n = y.shape[2]
    if n <= DRAWING.few:
        return close_pairs(y[0, 0], 1.0)
    each = [
        close_pairs(y[k, h], float(v)) @ [n, 1]
        for k, v in enumerate(variances[:, 0])
        for h in range(y.shape[1])
    ]
    return np.stack(np.divmod(np.unique(np.concatenate(each)), n), axis=1)


def slopes(match: Match, variances: Floats, tops: Floats, scales: Floats) -> Quadratic:
    """Second-order models of Σ_l s_l c_l² / n_l at H poses, and the `Match` they come from.

    `variances`, `tops` and `scales` (L, 1) are v, N(0; 0, v), and the factor s of each sensor.
    """
    at, sampled, over = match
    L, H, n = at.weights.shape
    J = at.J.reshape(L, H, 2 * n, 6)
    C = sampled[..., 0] * at.weights
    pull = (sampled[..., 1:] * at.weights[..., None]).reshape(L, H, 1, 2 * n)
    rest = (pull @ J)[:, :, 0]
    product = C.sum(axis=2)
    amplitude = product / over.norm
    strength = 2 * scales * amplitude
    value = (scales * product * amplitude).sum(axis=0)
    gradient = (strength[..., None] * rest).sum(axis=0)
    drawn = (strength / variances)[..., None] * C
    curvature = J.swapaxes(2, 3) @ (drawn[..., None, None] * at.J).reshape(L, H, 2 * n, 6)
    curvature = curvature.sum(axis=0)
    if len(over.pairs):
        near = np.flatnonzero(over.bells.any(axis=(0, 2)))
        some, _, own = match.of(near)
        half, gram = _pair_terms(some, own, variances, tops)
        level = (strength * amplitude)[:, near, None]
        gradient[near] -= (level * half).sum(axis=0)
        outer = half[..., :, None] * half[..., None, :] / own.norm[..., None, None]
        curvature[near] = (level[..., None] * (gram - outer)).sum(axis=0)
    return Quadratic(value, gradient, curvature, source=match)


def _pair_terms(
    at: Projected, over: Overlaps, variances: Floats, tops: Floats
) -> tuple[Floats, Floats]:
    """⟨h, ∂h⟩ (L, H, 6) and ⟨∂h, ∂hᵀ⟩ (L, H, 6, 6)."""
    v = variances[..., None]
    own = at.J * at.weights[..., None, None]
    gram = _gram(own, own) * (tops / variances)[..., None, None]
    J_i, J_j = at.J[:, :, over.pairs[:, 0]], at.J[:, :, over.pairs[:, 1]]
    along_i, along_j = (np.einsum("lhpm,lhpmk->lhpk", over.away, each) for each in (J_i, J_j))
    scaled = over.bells / v
    half = -(scaled[:, :, None] @ (along_i - along_j))[:, :, 0]
    cross = _gram(scaled[..., None, None] * J_i, J_j)
    cross -= ((scaled / v)[..., None] * along_i).swapaxes(2, 3) @ along_j
    return half, gram + cross + cross.swapaxes(2, 3)


def _gram(A: Floats, B: Floats) -> Floats:
    """Σ_p A_pᵀ B_p (L, H, 6, 6) of A and B (L, H, P, 2, 6)."""
    L, H, P = A.shape[:3]
    return A.reshape(L, H, 2 * P, 6).swapaxes(2, 3) @ B.reshape(L, H, 2 * P, 6)
