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
from mixpose.records import PointPattern
from mixpose.rigid import Floats


@dataclass(frozen=True)
class StaticRules:
    """When a detection counts as static."""

    frames: int = constant(
        10, "without the body in which a detection must be there: a moving one is for one or two"
    )
    same: float = constant(1.0, "σ_ε by which a static detection may be off: five times its noise")
    most: int = constant(2000, "places remembered of a sensor: features of a textured room")


@dataclass(frozen=True)
class StaticClutter:
    """Places (K, m) by sensor, and in how many frames more they were seen than not (K,)."""

    places: Mapping[str, tuple[Floats, NDArray[np.intp]]] = field(default_factory=dict)

    def learnt(self, views: Sequence[View], rules: StaticRules) -> StaticClutter:
        """What is remembered after one more frame without the body."""
        places = dict(self.places)
        for view in views:
            pattern = view.observation.pattern
            if not isinstance(pattern, PointPattern):
                continue
            old, count = places.get(view.name, (pattern.points[:0], np.zeros(0, dtype=np.intp)))
            reach = rules.same * view.observation.sigma
            near = cKDTree(old).query(pattern.points, distance_upper_bound=reach)[1]
            met = np.isin(np.arange(len(old)), near)
            count = np.minimum(count + np.where(met, 1, -1), 2 * rules.frames)
            fresh = pattern.points[near == len(old)]
            joined = np.concatenate([old, fresh])
            count = np.concatenate([count, np.ones(len(fresh), dtype=np.intp)])
            kept = np.argsort(-count, kind="stable")[: rules.most]
            kept = kept[count[kept] > 0]
            places[view.name] = joined[kept], count[kept]
        return StaticClutter(places)

    def without(self, views: Sequence[View], rules: StaticRules) -> list[View]:
        """The views without static detections."""
        moving = list(views)
        for k, view in enumerate(views):
            pattern = view.observation.pattern
            if not isinstance(pattern, PointPattern) or view.name not in self.places:
                continue
            places, counts = self.places[view.name]
            static = places[counts >= rules.frames]
            reach = rules.same * view.observation.sigma
            away = cKDTree(static).query(pattern.points, distance_upper_bound=reach)[0]
            alone = np.isinf(away)
            if not alone.all():
                rest = PointPattern(pattern.points[alone], pattern.weights[alone])
                moving[k] = replace(view, observation=replace(view.observation, pattern=rest))
        return moving
