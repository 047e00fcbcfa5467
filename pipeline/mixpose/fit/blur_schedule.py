"""The blurs through which a fit descends.

The coarsest blur is as wide as the projected features may be off at the start, the finest is the
extraction's own σ_ε.  Observation and prediction are widened alike, so that no level moves the
optimum; coarser levels only reach farther.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mixpose.body import Body
from mixpose.constants import constant
from mixpose.objective import View, project_body
from mixpose.records import Floats


@dataclass(frozen=True)
class ScheduleRules:
    """How blurs follow one another."""

    ratio: float = constant(
        1.8, "blur from level to level: below 2, a peak lies in the basin of the next level's"
    )
    widest: float = constant(
        0.1, "of the observed extent: with wider blurs everything is one blob (design study)"
    )


def blur_schedule(
    views: Sequence[View],
    body: Body,
    T_world_object: Floats,
    uncertainty: Floats,
    rules: ScheduleRules = ScheduleRules(),
) -> list[list[float]]:
    """Blurs per level and view, coarse to fine.

    Parameters
    ----------
    views : sequence of View
    body : Body
    T_world_object : (4, 4) array
        Where the descent starts.
    uncertainty : (6,) array
        Standard deviations of the start, order of `mixpose.rigid`.
    rules : ScheduleRules

    Returns
    -------
    list of list of float
        Standard deviation of a feature, per level and view; the last level is σ_ε.
    """
    at = project_body(tuple(view.sensor for view in views), body).project(T_world_object[None])
    # root mean square by which the features that each sensor sees may be off, per coordinate
    variances = (at.J[:, 0] ** 2 @ uncertainty**2).sum(axis=2)
    dimensions = np.array([view.sensor.dimension for view in views])
    counts = np.maximum(at.seen[:, 0].sum(axis=1), 1)
    spreads = np.sqrt((variances * at.seen[:, 0]).sum(axis=1) / counts / dimensions).tolist()
    finest = [view.observation.sigma for view in views]
    extents = [float(np.subtract(*view.observation.extent[::-1]).max()) for view in views]
    each = zip(spreads, finest, extents, strict=True)
    widest = [min(spread, max(rules.widest * extent, fine)) for spread, fine, extent in each]
    largest = max(wide / fine for wide, fine in zip(widest, finest, strict=True))
    count = max(int(np.ceil(np.log(max(largest, 1.0)) / np.log(rules.ratio))), 0)
    shares = [k / max(count, 1) for k in range(count, -1, -1)]
    return [
        [fine * max(wide / fine, 1.0) ** share for wide, fine in zip(widest, finest)]
        for share in shares
    ]
