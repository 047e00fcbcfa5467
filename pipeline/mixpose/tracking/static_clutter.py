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
from mixpose.records import Floats, Indices, Mask
from mixpose.sensors import clouds_among


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
            old, count = self._known(view, points)
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
        moving = [self._moving(view, frames) for view in views]
        for planes in clouds_among(tuple([view.sensor for view in views])):
            # a point stays where it is if it does in all three images
            common = np.any([moving[k] for k in planes], axis=0)
            for k in planes:
                moving[k] = common
        return [
            view if mask.all() else replace(view, observation=view.observation.only(mask))
            for view, mask in zip(views, moving, strict=True)
        ]

    def _moving(self, view: View, frames: int) -> Mask:
        """Whether each detection (M,) of a view was not there in so many frames more than not."""
        if (points := view.observation.points) is None:
            return np.zeros(0, dtype=np.bool_)  # of no detections at all
        places, counts = self._known(view, points)
        static = places[counts >= frames]
        return np.asarray(_nearest(static, view.observation) == len(static))

    def _known(self, view: View, points: Floats) -> tuple[Floats, Indices]:
        """Places of a view that has points (M, m), and their counts; none before it was seen."""
        return self.places.get(view.name, (points[:0], np.zeros(0, dtype=np.intp)))


def _nearest(places: Floats, seen: Observation) -> Indices:
    """Index of the place within σ_ε, five times what they err by, of detections; K for none."""
    return np.asarray(cKDTree(places).query(seen.points, distance_upper_bound=seen.sigma)[1])
