"""How far a pose may be off because one of its detections is cut, or belongs to something else.

Without feature i, of Jacobian J_i, a pose of covariance C moves by −C J_iᵀ e.  Here e = M r is the
residual that the other features leave, M = (1 − J_i C J_iᵀ)⁻¹, all in units of the noise.  If i has
a variance of v of these, e has the covariance P = M + v − 1, and the pose has

    Σ = C + (v − 1) C J_iᵀ M P⁻¹ J_i C,    moved by μ = −(v − 1) C J_iᵀ P⁻¹ e.

The covariance of the pose is that of the mixture of all cases by their probabilities, plus δδᵀ if
the pose is off the least squares of these residuals by δ = C Jᵀ r.  It is enlarged until all but a
few truths are inside its ellipsoid.  In one case the squared distance, by an inverse covariance B,
has the mean tr BΣ + μᵀBμ and the variance 2 tr (BΣ)² + 4 μᵀBΣBμ; its distribution is taken for the
multiple of χ² with the same two.
"""

from __future__ import annotations

import math
from bisect import bisect_left

import numpy as np
from scipy.special import chdtri, fdtrc, fdtri

from mixpose.judgement.information import inverted
from mixpose.matching import ErrorRules, Matches
from mixpose.records import Floats

LARGER: list[float] = np.geomspace(1.0, 40.0, 42).tolist()  # a step is 9 % of a variance


def with_cut_spots(
    matches: Matches,
    J: Floats,  # (R, k) of the residuals; both are in units of the errors of detections
    r: Floats,  # (R,)
    information: Floats,  # (k, k) of the pose by these residuals
    known: Floats,  # (k,) standard deviations of the pose before the frame
    variances: Floats,  # (L, N) of detections, σ_ε²
    errors: ErrorRules,
    outside: float,  # share of truths that may be outside the ellipsoid
    degrees: float,  # of freedom of the noise
) -> tuple[Floats, float]:
    """Return what to add to a covariance (k, k) for cut detections, and a factor for the sum."""
    # points in space are no spots, and those of other things seldom agree in three coordinates
    in_image = (matches.dimensions == 2) & (matches.coordinate_weight == 1)
    is_spot = (matches.detections >= 0) & in_image[:, None]
    met, k = (is_spot & (matches.shares > 0)).nonzero(), len(known)
    if not (len(met[0]) and k and any(errors.chances)):
        return np.zeros(information.shape), _larger_by_noise(k, degrees, outside)
    J, r = J.reshape(*matches.shares.shape, 2, k)[met], r.reshape(*matches.shares.shape, 2)[met]
    C = inverted(information + np.diag(1 / known**2))
    G = (J.reshape(-1, k) @ C).reshape(J.shape)
    # residuals of the least squares: a pose off these would seem to be pulled
    r = r - J @ (shift := r.ravel() @ G.reshape(-1, k))
    values, axes = _axes(G @ J.swapaxes(1, 2))
    M = 1 / np.maximum(1 - values, 1e-9)
    G, r = axes @ G, np.vecdot(axes, r[:, None])
    s2 = variances[met]
    # cut a little or much, or as the size of the spot says; of something else, it may be anywhere
    cut = matches.cut[met]
    is_sized = np.isfinite(cut[:, 0])
    # variances and priors by spots (n,) and cases (V,)
    v, prior = np.full((2, len(cut), len(errors.cuts) + 1), 1e9)
    v[:, :-1] = np.where(is_sized[:, None], cut[:, 1:], np.square(errors.cuts))
    v = np.maximum(v / s2[:, None], 1.0)
    # spots with a known size have one case of a cut
    prior[:, :-1] = np.where(is_sized[:, None], 0.0, errors.chances)
    prior[is_sized, 0] = cut[is_sized, 0]
    prior[v <= 1] = 0.0
    prior[:, -1] = matches.crowd[met[0]] * (2 * math.pi * s2 * v[:, -1])
    more, M = (v - 1)[..., None], M[:, None]
    P = M + more
    shares, ratios = more / P, M / P
    logs = np.log(np.maximum(prior, 1e-300)) + 0.5 * np.vecdot(M * r[:, None] ** 2, shares)
    logs += 0.5 * np.log(ratios[..., 0] * ratios[..., 1])
    top = max(float(logs.max()), 0.0)
    chances = np.exp(logs - top)
    chances /= math.exp(-top) + chances.sum()
    wider = M * shares  # Σ − C by rows of G; the next are μ
    along = -wider * r[:, None]
    rows, weights = G.reshape(-1, k), chances[:, None] @ wider
    spread = rows.T @ (weights.reshape(-1, 1) * rows)
    by_case = (along @ G).reshape(-1, k)
    spread += by_case.T @ (chances.reshape(-1, 1) * by_case)
    spread += shift[:, None] * shift
    return spread, _larger(C, spread, G, along, wider, chances, outside, degrees)


def _larger(
    C: Floats,
    spread: Floats,
    G: Floats,  # (n, 2, k)
    along: Floats,  # (n, V, 2)
    wider: Floats,  # (n, V, 2)
    chances: Floats,  # (n, V) of cases; the remainder to 1 is that nothing is cut
    outside: float,
    noise_degrees: float,
) -> float:
    """Return the factor that brings all but the share `outside` of truths into the ellipsoid."""
    B = inverted(C + spread)
    BC, GB = B @ C, G.reshape(-1, len(C)) @ B
    by_B, by_both = GB.reshape(G.shape), (GB @ C).reshape(G.shape)
    H, K = by_B @ G.swapaxes(1, 2), by_both @ by_B.swapaxes(1, 2)
    diagonal_H, diagonal_K = (A.diagonal(axis1=1, axis2=2)[:, None] for A in (H, K))
    pulled, mean, variance = along @ H, BC.trace(), np.vdot(BC, BC.T)
    more = np.vecdot(wider, diagonal_H) + np.vecdot(pulled, along)
    varied = 2 * np.vecdot(wider, diagonal_K) + np.vecdot(wider @ H**2, wider)
    varied += 2 * np.vecdot(along @ K, along) + 2 * np.vecdot(pulled**2, wider)
    # `halves` are half the variances: multiples of χ² with mean² / half degrees of freedom
    means = mean + np.concatenate([more.ravel(), [0.0]])
    halves = variance + np.concatenate([varied.ravel(), [0.0]])
    degrees, limits = means**2 / halves, float(chdtri(len(C), outside)) * means / halves
    shares = np.concatenate([chances.ravel(), [1 - float(chances.sum())]])
    is_likely = shares > 1e-12  # most of many cases are next to impossible
    degrees, limits, shares = degrees[is_likely], limits[is_likely], shares[is_likely]

    def is_enough(number: int) -> bool:
        factors = LARGER[number] * limits / degrees
        return bool(fdtrc(degrees, noise_degrees, factors) @ shares <= outside)

    # as a rule it is the factor for noise alone
    last, alone = len(LARGER) - 1, _larger_by_noise(len(C), noise_degrees, outside)
    number = min(bisect_left(LARGER, alone), last)
    while number > 0 and is_enough(number - 1):
        number -= 1
    while number < last and not is_enough(number):
        number += 1
    return LARGER[number]


def _larger_by_noise(count: int, degrees: float, outside: float) -> float:
    """Return this factor for noise alone, of so many degrees of freedom."""
    return float(fdtri(count, degrees, 1 - outside) * count / chdtri(count, outside))


def _axes(S: Floats) -> tuple[Floats, Floats]:
    """Return eigenvalues (n, 2) of symmetric matrices (n, 2, 2), and axes as rows (n, 2, 2)."""
    a, b, c = S[:, 0, 0], S[:, 0, 1], S[:, 1, 1]
    angle, half = 0.5 * np.arctan2(2 * b, a - c), 0.5 * np.hypot(a - c, 2 * b)
    x, y, mean = np.cos(angle), np.sin(angle), 0.5 * (a + c)
    axes = np.array([x, y, -y, x]).T.reshape(-1, 2, 2)
    return np.array([mean + half, mean - half]).T, axes
