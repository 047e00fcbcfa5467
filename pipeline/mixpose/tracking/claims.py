"""Whose each detection is: a body's, nobody's so far, or two bodies' in one.

No detection belongs to two bodies.  What belongs to another is left out of what a body sees: from
its density, so that it does not pull, and from the clutter that its evidence is weighed against.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from mixpose.body import Body
from mixpose.judgement import ScoredPose
from mixpose.matching import Matches
from mixpose.objective import View, project_body
from mixpose.records import Floats, Indices, Mask

FREE, MERGED = -1, -2  # owners of what is nobody's so far, and of two bodies' features in one spot

# what a pose meets: detections (K,), where it expects them (K, 3), squared offsets (K,) in σ_ε²
Met: TypeAlias = tuple[Indices, Floats, Floats]


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
        whose, at = _joined({k: [some] for k, some in places.items()})
        owners = self.owners.copy()
        for sensor in np.unique(at[:, 2]):
            rows, columns = (np.flatnonzero(some[:, 2] == sensor) for some in (self.places, at))
            squared = np.minimum(_squared(self.places[rows], at[columns]), gate**2)
            i, j = linear_sum_assignment(squared)
            near = squared[i, j] < gate**2
            owners[rows[i[near]]] = whose[columns[j[near]]]
        return replace(self, owners=owners)

    def met_by(self, pose: ScoredPose, left: Mask) -> Met:
        """What a pose meets of the detections that are left for its body."""
        met = pose.used.detections >= 0
        sensors, places = self._expected(pose.used, met)
        kept = np.flatnonzero(left)
        first = np.searchsorted(kept, self.begins)[sensors]
        return kept[first + pose.used.detections[met]], places, pose.used.squared[met]

    def unmet_by(self, pose: ScoredPose) -> Floats:
        """Where a pose has features that nothing was found at (n, 3)."""
        seen = pose.matches
        return self._expected(seen, (seen.weights > 0) & (seen.shares == 0))[1]

    def taken(self, met: Mapping[int, Met]) -> Claims:
        """By what bodies meet; of a detection that two meet, the one that it lies nearer to."""
        if not met:
            return self
        whose, numbers, _, squared = _joined(met)
        owners = self.owners.copy()
        # what is written last stays: the nearest, and of equals the first
        order = np.argsort(squared, kind="stable")[::-1]
        owners[numbers[order]] = whose[order]
        return replace(self, owners=owners)

    def merged(
        self, met: Mapping[int, Met], unmet: Mapping[int, Floats], touching: float, pulled: float
    ) -> Indices:
        """Detections that may be features of two bodies in one spot.

        Their owner meets them loosely, by a squared offset over `pulled` σ_ε², and another has a
        feature within `touching` σ_ε that has no other detection: nothing was found there, or the
        same spot, to which the owner is nearer.
        """
        whose, numbers, at, squared = _joined(met)
        first = self.owners[numbers] == whose
        loose = first & (squared > pulled)
        lost, places = _joined({k: [some] for k, some in unmet.items()})
        others, theirs = np.concatenate([at[~first], places]), np.append(whose[~first], lost)
        near = _squared(self.places[numbers[loose]], others) < touching**2
        both = (near & (theirs != whose[loose][:, None])).any(axis=1)
        return np.unique(numbers[loose][both])

    def are_near(self, chosen: Mask, places: Floats, reach: float) -> bool:
        """Whether some detections (D,) lie within reach, in σ_ε, of places (n, 3)."""
        return bool((_squared(self.places[chosen], places) < reach**2).any())

    def _expected(self, seen: Matches, chosen: Mask) -> tuple[Indices, Floats]:
        """Sensors (K,) of features (L, N) of matches, and their places (K, 3)."""
        numbers = {view.name: k for k, view in enumerate(self.views)}
        rows = np.nonzero(chosen)[0]
        sensors = np.array([numbers[name] for name in seen.names])[rows]
        return sensors, places_of(sensors, seen.places[chosen] / seen.sigmas[rows, None])


def overlap(a: Met, b: Met) -> float:
    """Share of the detections of the one that meets fewer that both meet."""
    fewer = min(len(np.unique(detections)) for detections, *_ in (a, b))
    return len(np.intersect1d(a[0], b[0])) / max(fewer, 1)


def places_of(sensors: int | Indices, y: Floats) -> Floats:
    """Places (K, 3) of points (K, m) in σ_ε: what two sensors see is far apart."""
    places = np.zeros((len(y), 3))
    places[:, : y.shape[1]] = y
    places[:, 2] = 1e6 * np.asarray(sensors)
    return places


def _joined(arrays: Mapping[int, Sequence[NDArray[Any]]]) -> list[NDArray[Any]]:
    """Bodies (K,), and their arrays (K, ...) one after the other."""
    whose = np.repeat(list(arrays), [len(first) for first, *_ in arrays.values()])
    return [whose, *map(np.concatenate, zip(*arrays.values(), strict=True))]


def _squared(points: Floats, places: Floats) -> Floats:
    """Squared distances (K, n) of points (K, 3) and places (n, 3)."""
    away = points[:, None] - places
    return np.asarray((away * away).sum(axis=2))
