"""Detections that stay in place, frame after frame, while the body is lost.

What is static, as lamps are, is searched last: a body that stands still is only found later.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial import cKDTree

from mixpose.density import Observation
from mixpose.objective import View
from mixpose.records import Floats, Indices, Mask
from mixpose.sensors import clouds_among


@dataclass(frozen=True)
class StaticClutter:
    """Places (K, m) by sensor, and in how many more frames each was seen than not (K,)."""

    places: Mapping[str, tuple[Floats, Indices]] = field(default_factory=dict)

    def learnt(self, views: Sequence[View], frames: int) -> StaticClutter:
        """Return the clutter after one more frame; places missed as often as seen are dropped."""
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
        """Return the views without detections seen in place in `frames` more frames than not."""
        moving = [self._moving(view, frames) for view in views]
        for planes in clouds_among(tuple([view.sensor for view in views])):
            # a point of a cloud is static if it is in all three images
            common = np.any([moving[k] for k in planes], axis=0)
            for k in planes:
                moving[k] = common
        return [view.only(mask) for view, mask in zip(views, moving, strict=True)]

    def _moving(self, view: View, frames: int) -> Mask:
        """Return which detections (M,) of a view are not static."""
        if (points := view.observation.points) is None:
            return np.zeros(0, dtype=np.bool_)  # a view without single detections
        places, counts = self._known(view, points)
        static = places[counts >= frames]
        return np.asarray(_nearest(static, view.observation) == len(static))

    def _known(self, view: View, points: Floats) -> tuple[Floats, Indices]:
        """Return the places of a view with points (M, m), and their counts; none for a new view."""
        return self.places.get(view.name, (points[:0], np.zeros(0, dtype=np.intp)))


def _nearest(places: Floats, seen: Observation) -> Indices:
    """Return the index of the place within σ_ε, five times its error, of detections; K for none."""
    return np.asarray(cKDTree(places).query(seen.points, distance_upper_bound=seen.sigma)[1])
