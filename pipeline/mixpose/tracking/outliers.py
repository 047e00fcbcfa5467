"""Detections that pull a pose aside: least squares over the features met, with and without them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from mixpose.judgement import Association, Judged
from mixpose.tracking.proposal_rules import ProposalRules

Floats: TypeAlias = NDArray[np.float64]


def has_outlier(judged: Judged, rules: ProposalRules) -> bool:
    """Whether some feature is met so loosely that it may be another's, or two share one."""
    return any(
        one.merged or one.squared.max(initial=0.0) > rules.noticeable for one in judged.associations
    )


def least_squares_step(associations: Sequence[Association], free: NDArray[np.bool_]) -> Floats:
    """The step (6,) to where the features were met, merged ones in their middle."""
    J, offsets, shares = _rows(associations, free)
    weights = np.sqrt(shares)[:, None]
    step = np.zeros(len(free))
    rows = (weights[..., None] * J).reshape(-1, J.shape[2])
    step[free] = np.linalg.lstsq(rows, (weights * offsets).ravel(), rcond=None)[0]
    return step


def step_without_loosest(
    associations: Sequence[Association], free: NDArray[np.bool_], rules: ProposalRules
) -> Floats:
    """The step (6,) to where the met features agree, leaving out those that agree least.

    One feature after the other is left out, each time the one without which the rest agree best,
    until all are met tightly or too few are left.  With H_i = J_i A⁻¹ J_iᵀ, leaving feature i out
    lowers the sum of squares by r_iᵀ (I − H_i)⁻¹ r_i (R. D. Cook and S. Weisberg, Residuals and
    Influence in Regression, 1982).
    """
    J, offsets, _ = _rows(associations, free)
    step = np.zeros(len(free))
    coordinates = min(one.J.shape[1] for one in associations if one.met)
    fewest = -(-(int(free.sum()) + 2) // coordinates)
    while len(J) >= fewest:
        A = np.einsum("nmi,nmj->ij", J, J)
        A.flat[:: len(A) + 1] *= 1 + 1e-9
        A.flat[:: len(A) + 1] += 1e-18
        inverse = np.linalg.inv(A)
        step[free] = inverse @ np.einsum("nmi,nm->i", J, offsets)
        left = offsets - J @ step[free]
        if (left**2).sum(axis=1).max() < rules.noticeable or len(J) == fewest:
            break
        remain = np.eye(J.shape[1]) - J @ inverse @ J.swapaxes(1, 2)
        remain += 1e-9 * np.eye(J.shape[1])  # a feature that alone fixes a direction
        gain = (left * np.linalg.solve(remain, left[..., None])[..., 0]).sum(axis=1)
        kept = np.arange(len(J)) != int(np.argmax(gain))
        J, offsets = J[kept], offsets[kept]
    return step


def _rows(
    associations: Sequence[Association], free: NDArray[np.bool_]
) -> tuple[Floats, Floats, Floats]:
    """Jacobians (n, 2, k) and offsets (n, 2) of the met features in σ, and their shares (n,).

    A coordinate that is missing has rows of 0.
    """
    J, offsets, shares = [], [], []
    for one in associations:
        met = one.shares > 0
        missing = 2 - one.J.shape[1]
        J.append(np.pad(one.J[met][..., free], ((0, 0), (0, missing), (0, 0))) / one.sigma)
        offsets.append(np.pad(one.offsets[met], ((0, 0), (0, missing))) / one.sigma)
        shares.append(one.shares[met])
    return np.concatenate(J), np.concatenate(offsets), np.concatenate(shares)
