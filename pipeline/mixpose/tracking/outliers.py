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


def least_squares_step(
    associations: Sequence[Association], free: NDArray[np.bool_]
) -> Floats:
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
    until all are met tightly or too few are left.
    """
    parts = [
        (J[:, free] / one.sigma, offset / one.sigma)
        for one in associations
        for J, offset, share in zip(one.J, one.offsets, one.shares, strict=True)
        if share > 0
    ]
    step = np.zeros(len(free))
    fewest = -(-(int(free.sum()) + 2) // min(len(r) for _, r in parts))
    while len(parts) >= fewest:
        solved, squared = _solve(parts)
        step[free] = solved
        if squared.max() < rules.noticeable or len(parts) == fewest:
            break
        remaining = [_solve(parts[:k] + parts[k + 1 :])[1].sum() for k in range(len(parts))]
        del parts[int(np.argmin(remaining))]
    return step


def _solve(parts: Sequence[tuple[Floats, Floats]]) -> tuple[Floats, Floats]:
    """Least-squares step, and what is left of each feature's squared offset."""
    J, r = np.concatenate([part[0] for part in parts]), np.concatenate([part[1] for part in parts])
    A = J.T @ J
    A.flat[:: len(A) + 1] *= 1 + 1e-9
    A.flat[:: len(A) + 1] += 1e-18
    step = np.linalg.solve(A, J.T @ r)
    left = (r - J @ step) ** 2
    return step, np.add.reduceat(left, np.cumsum([0] + [len(part[1]) for part in parts[:-1]]))
