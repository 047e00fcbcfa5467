"""What a pose may be off by where one of the detections that it meets is cut, or somebody else's.

Without feature i, of Jacobian J_i, a pose of covariance C moves by −C J_iᵀ e, with the residual e =
M r that the others leave, M = (1 − J_i C J_iᵀ)⁻¹, all in units of the noise.  If i is as wide as v
of these, the others expect e with the covariance P = M + v − 1, and the pose has then

    Σ = C + (v − 1) C J_iᵀ M P⁻¹ J_i C,    moved by μ = −(v − 1) C J_iᵀ P⁻¹ e.

The covariance of all cases together, as probable as each is, is that of the pose, with δδᵀ where it
is δ = C Jᵀ r beside the least squares, whose residuals these are; and it is larger by as much as it
takes to have all but few truths inside its ellipsoid.  By an inverse covariance B squared distances
of one case have the mean tr BΣ + μᵀBμ and the variance 2 tr (BΣ)² + 4 μᵀBΣBμ, and are taken for a
multiple of χ² with as much.
"""

from __future__ import annotations

import math

import numpy as np
from scipy.special import chdtri, fdtrc, fdtri

from mixpose.judgement.information import inverted
from mixpose.matching import ErrorRules, Matches
from mixpose.records import Floats

LARGER: list[float] = np.geomspace(1.0, 40.0, 42).tolist()  # a step is 9 % of a variance


def with_cut_spots(
    found: Matches,
    J: Floats,  # (R, k) of the residuals, both in units of what detections err by
    r: Floats,  # (R,)
    information: Floats,  # (k, k) of the pose as these tell it
    known: Floats,  # (k,) deviations of it before
    variances: Floats,  # (L, N) of detections, σ_ε²
    errors: ErrorRules,
    outside: float,  # share of truths outside the ellipsoid of that share
    degrees: float,  # of freedom that the noise is known to
) -> tuple[Floats, float]:
    """What a covariance (k, k) is larger by as one detection may be cut, and a factor for both."""
    # points in space are no spots, and three coordinates seldom agree with somebody else's
    in_image = (found.dimensions == 2) & (found.images[found.owner] == 1)
    is_spot = (found.detections >= 0) & in_image[:, None]
    met, k = (is_spot & (found.shares > 0)).nonzero(), len(known)
    if not (len(met[0]) and k and any(errors.chances)):
        return np.zeros(information.shape), _larger_by_noise(k, degrees, outside)
    J, r = J.reshape(*found.shares.shape, 2, k)[met], r.reshape(*found.shares.shape, 2)[met]
    C = inverted(information + np.diag(1 / known**2))
    G = (J.reshape(-1, k) @ C).reshape(J.shape)
    # what a pose is beside the least squares, it would seem to be pulled by
    r = r - J @ (beside := r.ravel() @ G.reshape(-1, k))
    values, axes = _axes(G @ J.swapaxes(1, 2))
    M = 1 / np.maximum(1 - values, 1e-9)
    G, r = axes @ G, np.vecdot(axes, r[:, None])
    s2 = variances[met]
    # a little or much, or as its size tells; what is somebody else's may be anywhere
    own = found.cut[met]
    is_sized = np.isfinite(own[:, 0])
    # by spots (n,) and cases (V,)
    v, prior = np.full((2, len(own), len(errors.cuts) + 1), 1e9)
    v[:, :-1] = np.where(is_sized[:, None], own[:, 1:], np.square(errors.cuts))
    v = np.maximum(v / s2[:, None], 1.0)
    # of those whose sizes tell it is one case
    prior[:, :-1] = np.where(is_sized[:, None], 0.0, errors.chances)
    prior[is_sized, 0] = own[is_sized, 0]
    prior[v <= 1] = 0.0
    prior[:, -1] = found.crowd[met[0]] * (2 * math.pi * s2 * v[:, -1])
    more, M = (v - 1)[..., None], M[:, None]
    P = M + more
    shares, ratios = more / P, M / P
    logs = np.log(np.maximum(prior, 1e-300)) + 0.5 * np.vecdot(M * r[:, None] ** 2, shares)
    logs += 0.5 * np.log(ratios[..., 0] * ratios[..., 1])
    top = max(float(logs.max()), 0.0)
    chances = np.exp(logs - top)
    chances /= math.exp(-top) + chances.sum()
    wider = M * shares  # Σ − C by rows of G, and μ
    along = -wider * r[:, None]
    rows, weights = G.reshape(-1, k), chances[:, None] @ wider
    spread = rows.T @ (weights.reshape(-1, 1) * rows)
    by_case = (along @ G).reshape(-1, k)
    spread += by_case.T @ (chances.reshape(-1, 1) * by_case)
    spread += np.outer(beside, beside)
    return spread, _larger(C, spread, G, along, wider, chances, outside, degrees)


def _larger(
    C: Floats,
    spread: Floats,
    G: Floats,  # (n, 2, k)
    along: Floats,  # (n, V, 2)
    wider: Floats,  # (n, V, 2)
    chances: Floats,  # (n, V); what is left of one is the chance that nothing is cut
    outside: float,
    noise_degrees: float,
) -> float:
    """The factor by which an ellipsoid (k, k) has all but some truths inside."""
    B = inverted(C + spread)
    BC, GB = B @ C, G.reshape(-1, len(C)) @ B
    by_B, by_both = GB.reshape(G.shape), (GB @ C).reshape(G.shape)
    H, K = by_B @ G.swapaxes(1, 2), by_both @ by_B.swapaxes(1, 2)
    own, beside = (one.diagonal(axis1=1, axis2=2)[:, None] for one in (H, K))
    pulled, mean, variance = along @ H, np.trace(BC), np.vdot(BC, BC.T)
    more = np.vecdot(wider, own) + np.vecdot(pulled, along)
    varied = 2 * np.vecdot(wider, beside) + np.vecdot(wider @ H**2, wider)
    varied += 2 * np.vecdot(along @ K, along) + 2 * np.vecdot(pulled**2, wider)
    # of half the variances: a multiple of χ² with as many degrees of freedom
    means = mean + np.concatenate([more.ravel(), [0.0]])
    halves = variance + np.concatenate([varied.ravel(), [0.0]])
    degrees, limits = means**2 / halves, float(chdtri(len(C), outside)) * means / halves
    shares = np.concatenate([chances.ravel(), [1 - float(chances.sum())]])
    some = shares > 1e-12  # of many cases most are next to impossible
    degrees, limits, shares = degrees[some], limits[some], shares[some]
    # the first or the second of most poses
    enough = (
        one
        for one in LARGER[:-1]
        if fdtrc(degrees, noise_degrees, one * limits / degrees) @ shares <= outside
    )
    return next(enough, LARGER[-1])


def _larger_by_noise(count: int, degrees: float, outside: float) -> float:
    """The same of noise alone, known to so many degrees of freedom."""
    return float(fdtri(count, degrees, 1 - outside) * count / chdtri(count, outside))


def _axes(S: Floats) -> tuple[Floats, Floats]:
    """Variances (n, 2) of symmetric matrices (n, 2, 2) along their axes, the rows (n, 2, 2)."""
    a, b, c = S[:, 0, 0], S[:, 0, 1], S[:, 1, 1]
    angle, half = 0.5 * np.arctan2(2 * b, a - c), 0.5 * np.hypot(a - c, 2 * b)
    x, y, mean = np.cos(angle), np.sin(angle), 0.5 * (a + c)
    axes = np.array([x, y, -y, x]).T.reshape(-1, 2, 2)
    return np.array([mean + half, mean - half]).T, axes
