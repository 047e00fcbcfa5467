"""The ladder of blurs that an estimate descends.

The coarsest blur is as wide as the projected features may be off at the start, the finest is the
extraction's own σ_ε.  Observation and prediction are widened alike, so that no level moves the
optimum; coarser levels only reach farther.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from mixpose.body import Body
from mixpose.objective import View, pose_jacobian
from mixpose.rigid import transform

Floats: TypeAlias = NDArray[np.float64]

RATIO = 1.8
"""Blur from level to level: below 2 the peak found at one level lies in the basin of the next."""

_WIDEST_SHARE = 0.1  # of the observed extent: wider than that everything is one blob


def ladder(
    views: Sequence[View], body: Body, T_world_object: Floats, uncertainty: Floats
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

    Returns
    -------
    list of list of float
        Standard deviation of a feature, per level and view; the last level is σ_ε.
    """
    widest = [_projected_spread(view, body, T_world_object, uncertainty) for view in views]
    finest = [view.observation.sigma for view in views]
    largest = max(wide / fine for wide, fine in zip(widest, finest, strict=True))
    count = max(int(np.ceil(np.log(max(largest, 1.0)) / np.log(RATIO))), 0)
    levels = []
    for k in range(count, -1, -1):
        share = k / max(count, 1)
        levels.append([f * max(w / f, 1.0) ** share for w, f in zip(widest, finest, strict=True)])
    return levels


def _projected_spread(view: View, body: Body, T_world_object: Floats, uncertainty: Floats) -> float:
    """Root mean square by which the projected features may be off, in sensor units."""
    points = body.nodes.points
    _, by_world, seen = view.sensor.linearise(transform(T_world_object, points))
    if not seen.any():
        return view.observation.sigma
    J = pose_jacobian(by_world, T_world_object, points)[seen]
    variance = float(np.einsum("nmk,k->nm", J**2, uncertainty**2).mean())
    lower, upper = view.observation.extent()
    widest = max(_WIDEST_SHARE * float((upper - lower).max()), view.observation.sigma)
    return min(float(np.sqrt(variance)), widest)
