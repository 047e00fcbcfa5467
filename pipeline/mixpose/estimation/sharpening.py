"""A closer look where one detection pulls a pose aside.

A false detection within reach of a hidden feature passes for it.  At σ_ε it bends the pose of all
the others; at a narrower blur, which detections that are more exact than σ_ε allow, it is too far
away to pull.  Whether the pose found there is the better one, its evidence tells.
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

_NOTICEABLE = 0.5
"""Squared offset in σ_ε that makes a closer look worth while."""


def bent(meetings: Sequence[Meeting]) -> bool:
    """Whether some feature is met so loosely that it may be another's detection."""
    squared = [(m.offsets**2).sum(axis=1).max(initial=0.0) / m.sigma**2 for m in meetings]
    return max(squared, default=0.0) > _NOTICEABLE


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
        Climbed to at σ_ε.
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
