"""Detections that stay where they are, frame after frame, while the body is lost.

Lamps, screws and reflections do not move; a body that is looked for will.  What is static is
searched last.  A body that stands still is found all the same, only later.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from mixpose.constants import constant
from mixpose.objective import View
from mixpose.records import Floats, PointPattern


@dataclass(frozen=True)
class StaticRules:
    """When a detection counts as static."""

    frames: int = constant(
        10, "without the body in which a detection must be there: a moving one is for one or two"
    )


@dataclass(frozen=True)
class StaticClutter:
    """Places (K, m) by sensor, and in how many frames more they were seen than not (K,)."""

    places: Mapping[str, tuple[Floats, NDArray[np.intp]]] = field(default_factory=dict)

    def learnt(self, views: Sequence[View], rules: StaticRules) -> StaticClutter:
        """What is remembered after one more frame without the body.

        A place that was seen as often as not is forgotten.
        """
        places = dict(self.places)
        for view in views:
            pattern = view.observation.pattern
            if not isinstance(pattern, PointPattern):
                continue
            old, count = places.get(view.name, (pattern.points[:0], np.zeros(0, dtype=np.intp)))
            _, nearest = _nearest(old, view, pattern)
            is_met = np.isin(np.arange(len(old)), nearest)
            count = np.minimum(count + np.where(is_met, 1, -1), 2 * rules.frames)
            new = pattern.points[nearest == len(old)]
            joined = np.concatenate([old[count > 0], new])
            count = np.concatenate([count[count > 0], np.ones(len(new), dtype=np.intp)])
            places[view.name] = joined, count
        return StaticClutter(places)

    def without(self, views: Sequence[View], rules: StaticRules) -> list[View]:
        """The views without static detections."""
        moving = list(views)
        for k, view in enumerate(views):
            pattern = view.observation.pattern
            if not isinstance(pattern, PointPattern) or view.name not in self.places:
                continue
            places, counts = self.places[view.name]
            away, _ = _nearest(places[counts >= rules.frames], view, pattern)
            moves = np.isinf(away)
            if not moves.all():
                rest = PointPattern(pattern.points[moves], pattern.weights[moves])
                moving[k] = replace(view, observation=replace(view.observation, pattern=rest))
        return moving


def _nearest(places: Floats, view: View, pattern: PointPattern) -> tuple[Floats, NDArray[np.intp]]:
    """Distance and index of the place within σ_ε of each detection; inf and their number for none.

    That is five times what detections err by.
    """
    reach = view.observation.sigma
    away, nearest = cKDTree(places).query(pattern.points, distance_upper_bound=reach)
    return away, nearest
