"""The owner of each detection: a body, or none so far.

No detection belongs to two bodies.  Detections of other bodies are left out of the views of a body:
out of its density, so that they do not pull, and out of the clutter of its evidence.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TypeAlias

import numpy as np
from scipy.spatial.distance import cdist

from mixpose.body import Body
from mixpose.judgement import ScoredPose
from mixpose.objective import View, project_body
from mixpose.records import Floats, Indices, Mask, replace
from mixpose.sensors import clouds_among
from mixpose.tracking.rules import SceneRules

Met: TypeAlias = tuple[Indices, Floats]  # met detections (K,), squared offsets (K,) in σ_ε²


@dataclass(frozen=True, eq=False)
class Claims:
    """The owners of all D detections of all sensors; sensors without single detections have none.

    Places are in σ_ε of their sensor, with a third coordinate that keeps sensors apart.
    """

    views: tuple[View, ...]  # of L sensors
    places: Floats  # (D, 3)
    begins: Indices  # (L + 1,), index of the first detection of each sensor
    owners: Indices  # (D,), number of a body; -1: no owner so far, -2: shared by two bodies

    @classmethod
    def none(cls, views: Sequence[View]) -> Claims:
        """Return the claims of no body."""
        observations = [view.observation for view in views]
        points = [np.zeros((0, 2)) if seen.points is None else seen.points for seen in observations]
        begins = np.cumsum([0, *map(len, points)])
        places = [places_of(k, points[k] / seen.sigma) for k, seen in enumerate(observations)]
        return cls(tuple(views), np.concatenate(places), begins, np.full(begins[-1], -1))

    def available(self, k: int) -> Mask:
        """Return which detections (D,) body k owns or no body does."""
        return np.asarray((self.owners == -1) | (self.owners == k))

    def views_with(self, chosen: Mask) -> list[View]:
        """Return the views with only some of their detections (D,)."""
        masks = [chosen[a:b] for a, b in pairwise(self.begins.tolist())]
        return [view.only(mask) for view, mask in zip(self.views, masks, strict=True)]

    def features(self, body: Body, T_world_object: Floats) -> Floats:
        """Return the places (n, 3) of a body's features in all sensors at a pose."""
        images = project_body(tuple(view.sensor for view in self.views), body).project(
            T_world_object[None]
        )
        rows, features = np.nonzero(images.seen[:, 0])
        sigmas = np.array([view.observation.sigma for view in self.views])
        return places_of(rows, images.y[rows, 0, features] / sigmas[rows, None])

    def expected(self, places: Mapping[int, Floats], gate: float) -> Claims:
        """Give each detection to the body of the nearest feature, within `gate` σ_ε."""
        numbers = np.array([-1, *(k for k in places for _ in places[k])], dtype=np.intp)
        distances = cdist(self.places, np.concatenate([self.places[:0], *places.values()]))
        return self._with_owners(numbers[np.insert(distances, 0, gate, axis=1).argmin(axis=1)])

    def met_by(self, pose: ScoredPose, available: Mask) -> Met:
        """Return the detections that a pose meets among those available to its body."""
        used, kept = pose.used, np.flatnonzero(available)
        numbers = {view.name: k for k, view in enumerate(self.views)}
        first = np.searchsorted(kept, self.begins[[numbers[name] for name in used.names]])
        met = used.detections >= 0
        return kept[(first[:, None] + used.detections)[met]], used.squared[met]

    def claimed_by(self, met: Mapping[int, Met]) -> Claims:
        """Give detections to the bodies that meet them; of two, to the one that lies nearer."""
        owners, nearest = self.owners.copy(), np.full(len(self.owners), np.inf)
        for k, (numbers, squared) in met.items():
            nearer = squared < nearest[numbers]
            owners[numbers[nearer]], nearest[numbers[nearer]] = k, squared[nearer]
        return self._with_owners(owners)

    def without_merged(
        self, met: Mapping[int, Met], places: Mapping[int, Floats], rules: SceneRules
    ) -> Claims:
        """Mark loosely met detections near another body's feature, at places (n, 3), as shared."""
        owners = self.owners.copy()
        for k, (numbers, squared) in met.items():
            loose = numbers[(squared > rules.pulled) & (self.owners[numbers] == k)]
            others = np.concatenate([self.places[:0], *(places[j] for j in places if j != k)])
            is_near = cdist(self.places[loose], others).min(axis=1, initial=np.inf) < rules.touching
            owners[loose[is_near]] = -2
        return self._with_owners(owners)

    def _with_owners(self, owners: Indices) -> Claims:
        """Return claims with owners (D,); a point of a cloud needs the same owner in two images."""
        owners = owners.copy()
        for planes in clouds_among(tuple([view.sensor for view in self.views])):
            rows = [slice(*self.begins[k : k + 2].tolist()) for k in planes]
            first, second, third = (owners[row] for row in rows)
            last_two = np.where(second == third, second, -1)
            common = np.where((first == second) | (first == third), first, last_two)
            for row in rows:
                owners[row] = common
        return replace(self, owners=owners)


def places_of(sensors: int | Indices, y: Floats) -> Floats:
    """Return places (K, 3) of points (K, m) in σ_ε, far apart for different sensors."""
    places = np.zeros((len(y), 3))
    places[:, : y.shape[1]] = y
    places[:, 2] = 1e6 * np.asarray(sensors)
    return places
