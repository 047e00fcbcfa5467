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
from mixpose.objective import Gaze, View, gazes_of

Floats: TypeAlias = NDArray[np.float64]

RATIO = 1.8
"""Blur from level to level: below 2 the peak found at one level lies in the basin of the next."""

_WIDEST_SHARE = 0.1  # of the observed extent: wider than that everything is one blob


def ladder(
    views: Sequence[View],
    body: Body,
    T_world_object: Floats,
    uncertainty: Floats,
    gazes: Sequence[Gaze] | None = None,
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
    gazes : sequence of Gaze or None
        Of the views' sensors at the body, where they are at hand.

    Returns
    -------
    list of list of float
        Standard deviation of a feature, per level and view; the last level is σ_ε.
    """
    if gazes is None:
        gazes = gazes_of([view.sensor for view in views], body)
    spreads = {}
    for gaze in gazes:
        for sensor, spread in zip(
            gaze.sensors, _spreads(gaze, T_world_object, uncertainty), strict=True
        ):
            spreads[id(sensor)] = spread
    finest = [view.observation.sigma for view in views]
    widest = [min(spreads[id(view.sensor)], _widest(view)) for view in views]
    largest = max(wide / fine for wide, fine in zip(widest, finest, strict=True))
    count = max(int(np.ceil(np.log(max(largest, 1.0)) / np.log(RATIO))), 0)
    levels = []
    for k in range(count, -1, -1):
        share = k / max(count, 1)
        levels.append([f * max(w / f, 1.0) ** share for w, f in zip(widest, finest, strict=True)])
    return levels


def _spreads(gaze: Gaze, T_world_object: Floats, uncertainty: Floats) -> list[float]:
    """Root mean square by which the features that each sensor sees may be off, sensor units."""
    at = gaze.project(T_world_object)
    variances = ((at.J * at.J) @ uncertainty**2).mean(axis=2)
    counts = at.seen.sum(axis=1)
    sums = (variances * at.seen).sum(axis=1)
    return [float(v) for v in np.sqrt(sums / np.maximum(counts, 1))]


def _widest(view: View) -> float:
    lower, upper = view.observation.extent
    return max(_WIDEST_SHARE * float((upper - lower).max()), view.observation.sigma)
