"""What a pose may be off by where one of the detections that it meets is cut, or somebody else's.

Without feature i, of Jacobian J_i, a pose of covariance C moves by −C J_iᵀ e, with the residual e =
M r that the others leave, M = (1 − J_i C J_iᵀ)⁻¹, all in units of the noise.  If i is as wide as v
of these, the others expect e with the covariance P = M + v − 1, and the pose has then

    Σ = C + (v − 1) C J_iᵀ M P⁻¹ J_i C,    moved by μ = −(v − 1) C J_iᵀ P⁻¹ e.

The covariance of all cases together, as probable as each is, is that of the pose; and it is larger
by as much as it takes to have all but few truths inside its ellipsoid.  By an inverse covariance B
squared distances of one case have the mean tr BΣ + μᵀBμ and the variance 2 tr (BΣ)² + 4 μᵀBΣBμ,
and are taken for a multiple of χ² with as much.
"""

from __future__ import annotations

import math
from bisect import bisect_left

import numpy as np
from scipy.special import chdtrc, chdtri

from mixpose.judgement.information import inverted
from mixpose.matching import ErrorRules, Matches
from mixpose.records import Floats

LARGER: list[float] = np.geomspace(1.0, 30.0, 40).tolist()  # a step is 9 % of a variance


def with_cut_spots(
    found: Matches,
    J: Floats,  # (R, k) of the residuals, both in units of what detections err by
    r: Floats,  # (R,)
    information: Floats,  # (k, k) of the pose as these tell it
    known: Floats,  # (k,) deviations of it before
    variances: Floats,  # (L, N) of detections, σ_ε²
    errors: ErrorRules,
    outside: float,  # share of truths outside the ellipsoid of that share
) -> tuple[Floats, float]:
    """What a covariance (k, k) is larger by as one detection may be cut, and a factor for both."""
    is_spot = (found.detections >= 0) & (found.dimensions == 2)[:, None]
    met, k = (is_spot & (found.shares > 0)).nonzero(), len(known)
    if not (len(met[0]) and k and any(errors.chances)):
        return np.zeros(information.shape), 1.0
    J, r = J.reshape(*found.shares.shape, 2, k)[met], r.reshape(*found.shares.shape, 2)[met]
    C = inverted(information + np.diag(1 / known**2))
    G = J @ C
    values, axes = _axes(G @ J.swapaxes(1, 2))
    M = 1 / np.maximum(1 - values, 1e-9)
    G, r = axes @ G, (axes @ r[..., None])[..., 0]
    m, s2 = found.dimensions[met[0]], variances[met]
    # a little or much, or as its size tells; what is somebody else's may be anywhere
    own = found.cut[met]
    is_sized = np.isfinite(own[:, 0])
    wide = np.where(is_sized, own[:, 1], np.square(errors.cuts)[:, None])
    v = np.maximum(np.vstack([wide, np.full(len(own), 1e9)]) / s2, 1.0)
    # of those whose sizes tell it is one case
    one = np.eye(len(errors.cuts))[:, :1] * own[:, 0]
    given = np.where(is_sized, one, np.array(errors.chances)[:, None])
    prior = np.where(v > 1, np.vstack([given, np.zeros(len(own))]), 0.0)
    prior[-1] = found.crowd[met[0]] * (2 * math.pi * s2 * v[-1]) ** (m / 2)
    P = M + (v - 1)[..., None]
    shares = (v - 1)[..., None] / P
    logs = np.log(np.maximum(prior, 1e-300)) + 0.5 * (M * r**2 * shares).sum(axis=2)
    logs += 0.5 * np.log(M / P).sum(axis=2) + (1 - m / 2) * np.log(v)
    top = max(float(logs.max()), 0.0)
    chances = np.exp(logs - top)
    chances /= math.exp(-top) + chances.sum()
    along, wider = -(M * r * shares), M * shares  # μ and Σ − C by rows of G
    by_case = (along[..., None] * G).sum(axis=2).reshape(-1, k)
    rows, weights = G.reshape(-1, k), np.vecdot(chances.T[:, None], wider.transpose(1, 2, 0))
    spread = rows.T @ (weights.reshape(-1, 1) * rows)
    spread += by_case.T @ (chances.reshape(-1, 1) * by_case)
    whole = 1 - float(chances.sum())
    return spread, _larger(C, spread, G, along, wider, chances, whole, outside)


def _larger(
    C: Floats,
    spread: Floats,
    G: Floats,  # (n, 2, k)
    along: Floats,  # (V, n, 2)
    wider: Floats,  # (V, n, 2)
    chances: Floats,  # (V, n)
    whole: float,  # chance that nothing is cut
    outside: float,
) -> float:
    """The factor by which an ellipsoid (k, k) has all but some truths inside."""
    B = inverted(C + spread)
    BC = B @ C
    H, K = G @ B @ G.swapaxes(1, 2), G @ BC @ B @ G.swapaxes(1, 2)
    own, beside = (one.diagonal(axis1=1, axis2=2) for one in (H, K))
    pulled = (along[..., None, :] @ H)[..., 0, :]
    mean = np.trace(BC) + np.vecdot(wider, own) + np.vecdot(pulled, along)
    variance = np.vdot(BC, BC.T) + 2 * np.vecdot(wider, beside)
    variance += np.vecdot((wider[..., None, :] @ H**2)[..., 0, :], wider)
    variance += 2 * np.vecdot((along[..., None, :] @ K)[..., 0, :], along)
    variance += 2 * np.vecdot(pulled**2, wider)
    # of half the variances: a multiple of χ² with as many degrees of freedom
    means, halves = np.append(mean, np.trace(BC)), np.append(variance, np.vdot(BC, BC.T))
    degrees, limits = means**2 / halves, float(chdtri(len(C), outside)) * means / halves
    shares = np.append(chances, whole)
    some = shares > 1e-12  # of many cases most are next to impossible
    degrees, limits, shares = degrees[some], limits[some], shares[some]
    enough = bisect_left(
        LARGER[:-1], True, key=lambda factor: chdtrc(degrees, factor * limits) @ shares <= outside
    )
    return LARGER[enough]


def _axes(S: Floats) -> tuple[Floats, Floats]:
    """Variances (n, 2) of symmetric matrices (n, 2, 2) along their axes, the rows (n, 2, 2)."""
    a, b, c = S[:, 0, 0], S[:, 0, 1], S[:, 1, 1]
    angle, half = 0.5 * np.arctan2(2 * b, a - c), 0.5 * np.hypot(a - c, 2 * b)
    x, y, mean = np.cos(angle), np.sin(angle), 0.5 * (a + c)
    axes = np.stack([x, y, -y, x], axis=1).reshape(-1, 2, 2)
    return np.stack([mean + half, mean - half], axis=1), axes
