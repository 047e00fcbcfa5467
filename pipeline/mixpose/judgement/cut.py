"""What a pose may be off by where one of the detections that it meets is cut, or somebody else's.

Without feature i, of Jacobian J_i, a pose of covariance C moves by −C J_iᵀ e, with the residual e =
M r that the others leave, M = (1 − J_i C J_iᵀ)⁻¹, all in units of the noise.  If i is as wide as v
of these, the others expect e with the covariance P = M + v − 1, and the pose has then

    C + (v − 1) C J_iᵀ M P⁻¹ J_i C,    moved by −(v − 1) C J_iᵀ P⁻¹ e.

The covariance of all cases together, as probable as each is, is that of the pose; and it is larger
by as much as it takes to have all but few truths inside its ellipsoid.
"""

from __future__ import annotations

import math

import numpy as np
from scipy.special import chdtrc, chdtri

from mixpose.matching import ErrorRules, Matches
from mixpose.records import Floats


def with_cut_spots(
    found: Matches,
    J: Floats,  # (R, k) of the residuals, both in units of what detections err by
    r: Floats,  # (R,)
    C: Floats,  # (k, k) of the pose as these tell it
    known: Floats,  # (k,) deviations of it before
    variances: Floats,  # (L, N) of detections, σ_ε²
    errors: ErrorRules,
    outside: float,  # share of truths outside the ellipsoid of that share
) -> tuple[Floats, float]:
    """What a covariance (k, k) is larger by as one detection may be cut, and a factor for both."""
    is_spot = (found.detections >= 0) & (found.dimensions == 2)[:, None]
    met, chance = (is_spot & (found.shares > 0)).nonzero(), errors.cut
    J, r = J.reshape(*found.shares.shape, 2, len(C))[met], r.reshape(*found.shares.shape, 2)[met]
    # a cut that moves the pose out of its ellipsoid shows in what others tell as well
    shares = np.linalg.eigvalsh(J @ C @ J.swapaxes(1, 2))
    leverage, limit = max(float(shares.max(initial=0.0)), 1e-9), float(chdtri(len(C), outside))
    if chance * math.exp(-0.5 * limit * max(1 / leverage - 1, 0.0)) < outside:
        return np.zeros(C.shape), 1.0
    C = np.linalg.pinv(np.linalg.pinv(C, hermitian=True) + np.diag(1 / known**2), hermitian=True)
    G = J @ C
    values, axes = np.linalg.eigh(G @ J.swapaxes(1, 2))
    M, axes = 1 / np.maximum(1 - values, 1e-9), axes.swapaxes(1, 2)
    G, r = axes @ G, (axes @ r[..., None])[..., 0]
    m, s2 = found.dimensions[met[0]], variances[met]
    v = np.maximum(np.array([errors.typical**2, 1.0, 1e9])[:, None] / s2, 1.0)
    # a little or much; what is somebody else's may be anywhere
    prior = np.where(v > 1, chance / 2 / (1 - chance), 0.0)
    prior[-1] = found.crowd[met[0]] * (2 * math.pi * s2 * v[-1]) ** (m / 2)
    P = M + (v - 1)[..., None]
    shares = (v - 1)[..., None] / P
    logs = np.log(np.maximum(prior, 1e-300)) + 0.5 * (M * r**2 * shares).sum(axis=2)
    logs += 0.5 * np.log(M / P).sum(axis=2) + (1 - m / 2) * np.log(v)
    top = max(float(logs.max()), 0.0)
    chances = np.exp(logs - top)
    chances /= math.exp(-top) + chances.sum()
    moves, wider = -((M * r * shares)[..., None] * G).sum(axis=2), M * shares
    rows, weights = G.reshape(-1, len(C)), np.vecdot(chances.T[:, None], wider.transpose(1, 2, 0))
    by_case = moves.reshape(-1, len(C))
    spread = rows.T @ (weights.reshape(-1, 1) * rows)
    spread += by_case.T @ (chances.reshape(-1, 1) * by_case)
    inverse = np.linalg.pinv(C + spread, hermitian=True)
    mean = np.vdot(C, inverse) + np.vecdot(moves @ inverse, moves)
    mean += (wider * np.vecdot(G @ inverse, G)).sum(axis=2)
    # of squares of two normal directions, in which a detection moves it, with such a mean
    larger = np.geomspace(1.0, 30.0, 12)
    limits = 2 * limit * larger / np.maximum(mean, 1e-9)[..., None]
    beyond = np.tensordot(chances, chdtrc(2, limits))
    return spread, float(larger[int((beyond > outside)[:-1].sum())])
