"""Whose each detection is: a body's, nobody's so far, or two bodies' in one.

No detection belongs to two bodies.  What belongs to another is left out of what a body sees: from
its density, so that it does not pull, and from the clutter that its evidence is weighed against.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.spatial.distance import cdist

from mixpose.body import Body
from mixpose.judgement import ScoredPose
from mixpose.objective import View, project_body
from mixpose.records import Floats, Indices, Mask

FREE, MERGED = -1, -2  # owners of what is nobody's so far, and of two bodies' features in one spot

Met: TypeAlias = tuple[Indices, Floats]  # detections (K,) of a pose, squared offsets (K,) in σ_ε²


@dataclass(frozen=True, eq=False)
class Claims:
    """Whose the D detections of all sensors are; sensors without single detections have none.

    Places are in σ_ε of their sensor, with a third coordinate that keeps sensors apart.
    """

    views: tuple[View, ...]  # of L sensors
    places: Floats  # (D, 3)
    begins: Indices  # (L + 1,), where the detections of each sensor begin
    owners: Indices  # (D,), the number of a body, FREE or MERGED

    @classmethod
    def none(cls, views: Sequence[View]) -> Claims:
        """Before anything is known."""
        seen = [view.observation for view in views]
        points = [np.zeros((0, 2)) if one.points is None else one.points for one in seen]
        begins = np.cumsum([0, *map(len, points)])
        of = [places_of(k, points[k] / one.sigma) for k, one in enumerate(seen)]
        return cls(tuple(views), np.concatenate(of), begins, np.full(begins[-1], FREE))

    def left(self, k: int) -> Mask:
        """What others leave for body k (D,)."""
        return np.asarray((self.owners == FREE) | (self.owners == k))

    def part(self, left: Mask) -> list[View]:
        """The views with some of their detections (D,)."""
        masks = np.split(left, self.begins[1:-1])
        return [
            view if mask.all() else replace(view, observation=view.observation.only(mask))
            for view, mask in zip(self.views, masks, strict=True)
        ]

    def features(self, body: Body, T_world_object: Floats) -> Floats:
        """Where the sensors have the features of a body at a pose (n, 3)."""
        sensors = tuple(view.sensor for view in self.views)
        at = project_body(sensors, body).project(T_world_object[None])
        rows, features = np.nonzero(at.seen[:, 0])
        sigmas = np.array([view.observation.sigma for view in self.views])
        return places_of(rows, at.y[rows, 0, features] / sigmas[rows, None])

    def expected(self, places: Mapping[int, Floats], gate: float) -> Claims:
        """Each detection is that of the feature, `gate` σ_ε off at most, that it is expected of.

        `places` (n, 3) of features are by body; all are assigned at once, as near as can be.
        """
        if not places:
            return self
        whose = np.repeat(list(places), [len(some) for some in places.values()])
        at, owners = np.concatenate(list(places.values())), self.owners.copy()
        for sensor in np.unique(at[:, 2]):
            rows, columns = (np.flatnonzero(some[:, 2] == sensor) for some in (self.places, at))
            squared = np.minimum(cdist(self.places[rows], at[columns], "sqeuclidean"), gate**2)
            i, j = linear_sum_assignment(squared)
            near = squared[i, j] < gate**2
            owners[rows[i[near]]] = whose[columns[j[near]]]
        return replace(self, owners=owners)

    def met_by(self, pose: ScoredPose, left: Mask) -> Met:
        """What a pose meets of the detections that are left for its body."""
        used, kept = pose.used, np.flatnonzero(left)
        numbers = {view.name: k for k, view in enumerate(self.views)}
        first = np.searchsorted(kept, self.begins[[numbers[name] for name in used.names]])
        met = used.detections >= 0
        return kept[(first[:, None] + used.detections)[met]], used.squared[met]

    def taken(self, met: Mapping[int, Met], merged: Sequence[int]) -> Claims:
        """By what bodies meet; of a detection that two meet, the one that it lies nearer to."""
        if not met:
            return self
        whose = np.repeat(list(met), [len(numbers) for numbers, _ in met.values()])
        numbers, squared = map(np.concatenate, zip(*met.values(), strict=True))
        owners = self.owners.copy()
        # what is written last stays: the nearest, and of equals the first
        order = np.argsort(squared, kind="stable")[::-1]
        owners[numbers[order]] = whose[order]
        owners[merged] = MERGED
        return replace(self, owners=owners)

    def near(self, chosen: Mask, places: Floats, reach: float) -> Indices:
        """Those of some detections (D,) that lie within reach, in σ_ε, of places (n, 3)."""
        near: Mask = cdist(self.places[chosen], places).min(axis=1, initial=np.inf) < reach
        return np.flatnonzero(chosen)[near]


def places_of(sensors: int | Indices, y: Floats) -> Floats:
    """Places (K, 3) of points (K, m) in σ_ε: what two sensors see is far apart."""
    places = np.zeros((len(y), 3))
    places[:, : y.shape[1]] = y
    places[:, 2] = 1e6 * np.asarray(sensors)
    return places
