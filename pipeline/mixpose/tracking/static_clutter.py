"""Detections that stay where they are, frame after frame, while the body is lost.

What is static, as lamps are, is searched last: a body that stands still is only found later.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial import cKDTree

from mixpose.density import Observation
from mixpose.objective import View
from mixpose.records import Floats, Indices


@dataclass(frozen=True)
class StaticClutter:
    """Places (K, m) by sensor, and in how many frames more they were seen than not (K,)."""

    places: Mapping[str, tuple[Floats, Indices]] = field(default_factory=dict)

    def learnt(self, views: Sequence[View], frames: int) -> StaticClutter:
        """After one more frame without the body; what was seen as often as not is forgotten."""
        places = dict(self.places)
        for view in views:
            if (points := view.observation.points) is None:
                continue
            old, count = places.get(view.name, (points[:0], np.zeros(0, dtype=np.intp)))
            nearest = _nearest(old, view.observation)
            is_met = np.isin(np.arange(len(old)), nearest)
            count = np.minimum(count + np.where(is_met, 1, -1), 2 * frames)
            kept, new = count > 0, points[nearest == len(old)]
            places[view.name] = (
                np.concatenate([old[kept], new]),
                np.append(count[kept], np.ones(len(new), np.intp)),
            )
        return StaticClutter(places)

    def without(self, views: Sequence[View], frames: int) -> list[View]:
        """The views without detections that were there in so many frames more than not."""
        moving = list(views)
        for k, view in enumerate(views):
            if view.name in self.places:
                places, counts = self.places[view.name]
                static = places[counts >= frames]
                moves = _nearest(static, view.observation) == len(static)
                if not moves.all():
                    moving[k] = replace(view, observation=view.observation.only(moves))
        return moving


def _nearest(places: Floats, seen: Observation) -> Indices:
    """Index of the place within σ_ε, five times what they err by, of detections; K for none."""
    return np.asarray(cKDTree(places).query(seen.points, distance_upper_bound=seen.sigma)[1])
