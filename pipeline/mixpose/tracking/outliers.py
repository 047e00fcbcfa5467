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
    rows = [(np.sqrt(one.shares) / one.sigma)[:, None] for one in associations]
    J = np.concatenate(
        [(r[..., None] * m.J).reshape(-1, 6) for r, m in zip(rows, associations, strict=True)]
    )
    offsets = [(r * one.offsets).ravel() for r, one in zip(rows, associations, strict=True)]
    step = np.zeros(len(free))
    step[free] = np.linalg.lstsq(J[:, free], np.concatenate(offsets), rcond=None)[0]
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
    J, offsets = _rows(associations, free)
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


def _rows(associations: Sequence[Association], free: NDArray[np.bool_]) -> tuple[Floats, Floats]:
    """Jacobians (n, 2, k) and offsets (n, 2) of the met features in σ, missing coordinates 0."""
    met = [one.shares > 0 for one in associations]
    count = sum(int(np.count_nonzero(seen)) for seen in met)
    J, offsets = np.zeros((count, 2, int(free.sum()))), np.zeros((count, 2))
    begin = 0
    for one, seen in zip(associations, met, strict=True):
        m, end = one.J.shape[1], begin + int(np.count_nonzero(seen))
        J[begin:end, :m] = one.J[seen][..., free] / one.sigma
        offsets[begin:end, :m] = one.offsets[seen] / one.sigma
        begin = end
    return J, offsets
