"""A closer look where one detection pulls a pose aside.

A false detection within reach of a hidden feature passes for it.  At σ_ε it bends the pose of all
the others; at a narrower blur, which detections that are more exact than σ_ε allow, it is too far
away to pull.  Where two features run into each other, one detection in their middle pulls at
both: the pose is then the one that puts their middle there.  Whether a pose found so is the
better one, its evidence tells.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from mixpose.body import Body
from mixpose.estimation.meeting import Meeting
from mixpose.objective import View
from mixpose.objective.matched import matched_objective
from mixpose.optimise import NewtonOptions, ascend
from mixpose.records import PointPattern
from mixpose.rigid import perturb

Floats: TypeAlias = NDArray[np.float64]

NARROW = 0.5
"""Blur of the closer look in σ_ε: twice what centres of blobs err by."""

_NOTICEABLE = 0.35
"""Squared offset in σ_ε that makes a closer look worth while."""


def bent(meetings: Sequence[Meeting]) -> bool:
    """Whether some feature is met so loosely that it may be another's detection, or two by one."""
    return any(one.pairs or one.squared.max(initial=0.0) > _NOTICEABLE for one in meetings)


def sharpened(
    views: Sequence[View],
    body: Body,
    T_world_object: Floats,
    free: NDArray[np.bool_],
    newton: NewtonOptions,
) -> Floats | None:
    """The pose climbed to at a narrower blur.

    Parameters
    ----------
    views : sequence of View
    body : Body
    T_world_object : (4, 4) array
        Where the features agree without the loosest.
    free : (6,) bool
    newton : NewtonOptions

    Returns
    -------
    (4, 4) array or None
        None where a sensor gives grids, whose features cannot be made narrower.
    """
    if not all(isinstance(view.observation.pattern, PointPattern) for view in views):
        return None
    sigmas = [NARROW * view.observation.sigma for view in views]
    objective = matched_objective(views, body, sigmas, T_world_object, fine=True)
    return ascend(objective.linearise, perturb, T_world_object, free, newton).state


def settling_step(meetings: Sequence[Meeting], free: NDArray[np.bool_]) -> Floats:
    """The least-squares step (6,) to where the features were met, pairs in their middle."""
    rows = [(np.sqrt(m.shares) / m.sigma)[:, None] for m in meetings]
    J = np.concatenate(
        [(r[..., None] * m.J).reshape(-1, 6) for r, m in zip(rows, meetings, strict=True)]
    )
    offsets = np.concatenate([(r * m.offsets).ravel() for r, m in zip(rows, meetings, strict=True)])
    step = np.zeros(len(free))
    step[free] = np.linalg.lstsq(J[:, free], offsets, rcond=None)[0]
    return step


def agreed(meetings: Sequence[Meeting], free: NDArray[np.bool_]) -> Floats:
    """The step (6,) to where the met features agree, leaving out those that agree least.

    One feature after the other is left out, each time the one without which the rest agree best,
    until all are met tightly or too few are left.
    """
    met = [meeting.shares > 0 for meeting in meetings]
    blocks = [m.J[seen] / m.sigma for m, seen in zip(meetings, met, strict=True)]
    offsets = [m.offsets[seen] / m.sigma for m, seen in zip(meetings, met, strict=True)]
    parts = [
        (J[:, free], r)
        for block, rows in zip(blocks, offsets, strict=True)
        for J, r in zip(block, rows, strict=True)
    ]
    step = np.zeros(len(free))
    fewest = -(-(int(free.sum()) + 2) // min(len(r) for _, r in parts))
    while len(parts) >= fewest:
        solved, squared = _solve(parts)
        step[free] = solved
        if squared.max() < _NOTICEABLE or len(parts) == fewest:
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
