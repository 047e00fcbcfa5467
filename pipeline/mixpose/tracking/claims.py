"""Whose each detection is: a body's, or nobody's so far.

No detection belongs to two bodies.  What belongs to another is left out of what a body sees: from
its density, so that it does not pull, and from the clutter that its evidence is weighed against.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TypeAlias

import numpy as np
from scipy.spatial.distance import cdist

from mixpose.body import Body
from mixpose.judgement import ScoredPose
from mixpose.objective import View, project_body
from mixpose.records import Floats, Indices, Mask
from mixpose.sensors import clouds_among
from mixpose.tracking.rules import SceneRules

Met: TypeAlias = tuple[Indices, Floats]  # detections (K,) of a pose, squared offsets (K,) in σ_ε²


@dataclass(frozen=True, eq=False)
class Claims:
    """Whose the D detections of all sensors are; sensors without single detections have none.

    Places are in σ_ε of their sensor, with a third coordinate that keeps sensors apart.
    """

    views: tuple[View, ...]  # of L sensors
    places: Floats  # (D, 3)
    begins: Indices  # (L + 1,), where the detections of each sensor begin
    owners: Indices  # (D,), the number of a body; -1: nobody's so far, -2: two bodies'

    @classmethod
    def none(cls, views: Sequence[View]) -> Claims:
        """Before anything is known."""
        seen = [view.observation for view in views]
        points = [np.zeros((0, 2)) if one.points is None else one.points for one in seen]
        begins = np.cumsum([0, *map(len, points)])
        of = [places_of(k, points[k] / one.sigma) for k, one in enumerate(seen)]
        return cls(tuple(views), np.concatenate(of), begins, np.full(begins[-1], -1))

    def left(self, k: int) -> Mask:
        """What others leave for body k (D,)."""
        return np.asarray((self.owners == -1) | (self.owners == k))

    def part(self, left: Mask) -> list[View]:
        """The views with some of their detections (D,)."""
        masks = [left[a:b] for a, b in pairwise(self.begins.tolist())]
        return [
            view if mask.all() else replace(view, observation=view.observation.only(mask))
            for view, mask in zip(self.views, masks, strict=True)
        ]

    def features(self, body: Body, T_world_object: Floats) -> Floats:
        """Where the sensors have the features of a body at a pose (n, 3)."""
        at = project_body(tuple(view.sensor for view in self.views), body).project(
            T_world_object[None]
        )
        rows, features = np.nonzero(at.seen[:, 0])
        sigmas = np.array([view.observation.sigma for view in self.views])
        return places_of(rows, at.y[rows, 0, features] / sigmas[rows, None])

    def expected(self, places: Mapping[int, Floats], gate: float) -> Claims:
        """Each detection is that of the nearest feature of bodies, `gate` σ_ε off at most."""
        whose = np.array([-1, *(k for k, some in places.items() for _ in some)], dtype=np.intp)
        away = cdist(self.places, np.concatenate([self.places[:0], *places.values()]))
        return self._agreed(whose[np.insert(away, 0, gate, axis=1).argmin(axis=1)])

    def met_by(self, pose: ScoredPose, left: Mask) -> Met:
        """What a pose meets of the detections that are left for its body."""
        used, kept = pose.used, np.flatnonzero(left)
        numbers = {view.name: k for k, view in enumerate(self.views)}
        first = np.searchsorted(kept, self.begins[[numbers[name] for name in used.names]])
        met = used.detections >= 0
        return kept[(first[:, None] + used.detections)[met]], used.squared[met]

    def taken(self, met: Mapping[int, Met]) -> Claims:
        """By what bodies meet; of a detection that two meet, the one that it lies nearer to."""
        owners, nearest = self.owners.copy(), np.full(len(self.owners), np.inf)
        for k, (numbers, squared) in met.items():
            nearer = squared < nearest[numbers]
            owners[numbers[nearer]], nearest[numbers[nearer]] = k, squared[nearer]
        return self._agreed(owners)

    def without_merged(
        self, met: Mapping[int, Met], places: Mapping[int, Floats], rules: SceneRules
    ) -> Claims:
        """Without what a body meets loosely beside another's feature, at places (n, 3): both's."""
        owners = self.owners.copy()
        for k, (numbers, squared) in met.items():
            loose = numbers[(squared > rules.pulled) & (self.owners[numbers] == k)]
            others = np.concatenate([self.places[:0], *(places[j] for j in places if j != k)])
            near = cdist(self.places[loose], others).min(axis=1, initial=np.inf) < rules.touching
            owners[loose[near]] = -2
        return self._agreed(owners)

    def _agreed(self, owners: Indices) -> Claims:
        """With owners (D,); a point of a cloud belongs to whom two of its three images give it."""
        owners = owners.copy()
        for planes in clouds_among(tuple([view.sensor for view in self.views])):
            rows = [slice(*self.begins[k : k + 2].tolist()) for k in planes]
            first, second, third = (owners[row] for row in rows)
            both = np.where(second == third, second, -1)
            common = np.where((first == second) | (first == third), first, both)
            for row in rows:
                owners[row] = common
        return replace(self, owners=owners)


def places_of(sensors: int | Indices, y: Floats) -> Floats:
    """Places (K, 3) of points (K, m) in σ_ε: what two sensors see is far apart."""
    places = np.zeros((len(y), 3))
    places[:, : y.shape[1]] = y
    places[:, 2] = 1e6 * np.asarray(sensors)
    return places
