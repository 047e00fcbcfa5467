"""Whose each detection is: a body's, nobody's so far, or two bodies' in one.

No detection belongs to two bodies.  What belongs to another is left out of what a body sees: from
its density, so that it does not pull, and from the clutter that its evidence is weighed against.

Owners are arrays, by sensor: for each detection the number of its body, FREE or MERGED.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from mixpose.density import Observation
from mixpose.judgement import ScoredPose
from mixpose.objective import View
from mixpose.records import Floats, PointPattern

Owners: TypeAlias = dict[str, NDArray[np.intp]]
Places: TypeAlias = Mapping[str, Floats]

FREE, MERGED = -1, -2
"""Owners of detections that are nobody's so far, and that are two bodies' features in one spot."""


class Claim(NamedTuple):
    """The detections that a pose meets in one sensor: which, where it expects them, how far off."""

    detections: NDArray[np.intp]
    places: Floats
    squared: Floats


Claims: TypeAlias = Mapping[str, Claim]


@dataclass(frozen=True)
class Unclaimed:
    """What others leave for a body.

    Attributes
    ----------
    views : tuple of View
    kept : mapping of str to (K,) int
        By sensor, the detections that are left, by their numbers in the whole view.
    sensors : int
        That had a frame, also those that saw nothing.
    """

    views: tuple[View, ...]
    kept: Mapping[str, NDArray[np.intp]]
    sensors: int

    @classmethod
    def whole(cls, views: Sequence[View]) -> Unclaimed:
        """All that is seen."""
        return left_for(FREE, views, nobody(views), len(views))


def _patterns(views: Sequence[View]) -> Iterator[tuple[View, PointPattern]]:
    """Views with single detections."""
    for view in views:
        if isinstance(view.observation.pattern, PointPattern):
            yield view, view.observation.pattern


def nobody(views: Sequence[View]) -> Owners:
    """Owners before anything is known; sensors without single detections have none."""
    return {view.name: np.full(len(seen.points), FREE) for view, seen in _patterns(views)}


def _is_left(k: int, own: NDArray[np.intp]) -> NDArray[np.bool_]:
    return np.asarray((own == FREE) | (own == k))


def left_for(k: int, views: Sequence[View], owners: Owners, sensors: int) -> Unclaimed:
    """What others leave for body k."""
    kept = {
        view.name: np.flatnonzero(_is_left(k, owners[view.name])) for view, _ in _patterns(views)
    }
    some = [_part(view, kept[view.name]) if view.name in kept else view for view in views]
    return Unclaimed(tuple(some), kept, sensors)


def _part(view: View, kept: NDArray[np.intp]) -> View:
    seen, pattern = view.observation, view.observation.pattern
    if not isinstance(pattern, PointPattern) or len(kept) == len(pattern.points):
        return view
    part = PointPattern(pattern.points[kept], pattern.weights[kept])
    return replace(view, observation=Observation(part, seen.sigma, seen.intrinsic))


def claims_of(judged: ScoredPose, left: Unclaimed) -> dict[str, Claim]:
    """The detections that a pose meets, numbered as in the whole views."""
    claims, used = {}, judged.used
    for k, (name, m) in enumerate(zip(used.names, used.dimensions)):
        if name in left.kept:
            met = used.detections[k] >= 0
            numbers = left.kept[name][used.detections[k, met]]
            claims[name] = Claim(numbers, used.places[k, met, :m], used.squared[k, met])
    return claims


def unmet_places(judged: ScoredPose) -> dict[str, Floats]:
    """Where a pose has features that nothing was found at, by sensor."""
    seen = judged.matches
    unmet = (seen.weights > 0) & (seen.shares == 0)
    sensors = enumerate(zip(seen.names, seen.dimensions))
    return {name: seen.places[k, unmet[k], :m] for k, (name, m) in sensors}


def expected_owners(views: Sequence[View], places: Mapping[int, Places], gate: float) -> Owners:
    """Owners by where features are expected: each detection is that of the feature it is nearest.

    Parameters
    ----------
    views : sequence of View
    places : mapping of int to mapping of str to (n, m) array
        By body and sensor.
    gate : float
        How far at most, in σ_ε.
    """
    owners = nobody(views)
    for view, pattern in _patterns(views):
        own = [by_sensor[view.name] for by_sensor in places.values()]
        whose = np.repeat(list(places), [len(y) for y in own])
        if not len(whose) or not len(pattern.points):
            continue
        squared = _squared(pattern.points, np.concatenate(own))
        most = (gate * view.observation.sigma) ** 2
        rows, columns = linear_sum_assignment(np.minimum(squared, most))
        near = squared[rows, columns] < most
        owners[view.name][rows[near]] = whose[columns[near]]
    return owners


def owners_of(views: Sequence[View], claims: Mapping[int, Claims]) -> Owners:
    """Owners by what poses meet; of a detection that two meet, the one that it lies nearer to."""
    owners = nobody(views)
    for name, own in owners.items():
        if some := _claimed(name, claims):
            whose, numbers, _, squared = some
            # what is written last stays: the nearest, and of equals the first
            order = np.argsort(squared, kind="stable")[::-1]
            own[numbers[order]] = whose[order]
    return owners


def _claimed(
    name: str, claims: Mapping[int, Claims]
) -> tuple[NDArray[np.intp], NDArray[np.intp], Floats, Floats] | None:
    """All claims in one sensor: bodies (K,), detections (K,), places (K, m), squared offsets."""
    some = {k: by_sensor[name] for k, by_sensor in claims.items() if name in by_sensor}
    if not some:
        return None
    whose = np.repeat(list(some), [len(claim.detections) for claim in some.values()])
    detections, places, squared = map(np.concatenate, zip(*some.values(), strict=True))
    return whose, detections, places, squared


def merged_spots(
    views: Sequence[View],
    claims: Mapping[int, Claims],
    unmet: Mapping[int, Places],
    touching: float,
    pulled: float,
) -> dict[str, NDArray[np.intp]]:
    """Detections that may be features of two bodies in one spot, by sensor.

    One body meets it loosely, and another has a feature beside it that has no other detection:
    nothing was found there, or the same spot, to which the other is nearer.

    Parameters
    ----------
    views : sequence of View
    claims, unmet
        By body.
    touching : float
        How near the other's feature is at most, in σ_ε.
    pulled : float
        Squared offset in σ_ε² from which a detection is met loosely.
    """
    merged: dict[str, NDArray[np.intp]] = {}
    owners = owners_of(views, claims)
    for view, pattern in _patterns(views):
        some = _claimed(view.name, claims)
        if some is None:
            continue
        whose, numbers, at, squared = some
        first = owners[view.name][numbers] == whose
        loose = first & (squared > pulled)
        lost = {k: places[view.name] for k, places in unmet.items() if view.name in places}
        others = np.concatenate([at[~first], *lost.values()])
        numbered = [np.full(len(places), k) for k, places in lost.items()]
        theirs = np.concatenate([whose[~first], *numbered])
        squares = _squared(pattern.points[numbers[loose]], others)
        near = squares < (touching * view.observation.sigma) ** 2
        both = (near & (theirs != whose[loose][:, None])).any(axis=1)
        if both.any():
            merged[view.name] = np.unique(numbers[loose][both])
    return merged


def overlap(a: Claims, b: Claims) -> float:
    """Share of the detections of the one that claims fewer that both claim."""
    both = sum(len(np.intersect1d(a[n].detections, b[n].detections)) for n in a.keys() & b.keys())
    fewer = min(sum(len(np.unique(c.detections)) for c in claims.values()) for claims in (a, b))
    return both / max(fewer, 1)


def is_changed(k: int, left: Unclaimed, owners: Owners) -> bool:
    """Whether other detections than those are left for body k by now."""
    return any(
        not np.array_equal(kept, np.flatnonzero(_is_left(k, owners[name])))
        for name, kept in left.kept.items()
    )


def is_reached(
    k: int, views: Sequence[View], left: Unclaimed, owners: Owners, places: Places, reach: float
) -> bool:
    """Whether detections come to or go from body k within a reach, in σ_ε, of places."""
    for view, pattern in _patterns(views):
        changed = _is_left(k, owners[view.name])
        changed[left.kept[view.name]] ^= True
        if _is_near(view, pattern.points[changed], places[view.name], reach):
            return True
    return False


def hides_near(views: Sequence[View], left: Unclaimed, places: Places, reach: float) -> bool:
    """Whether a detection that is left out lies within reach, in σ_ε, of places (n, m)."""
    return any(
        _is_near(
            view, np.delete(seen.points, left.kept[view.name], axis=0), places[view.name], reach
        )
        for view, seen in _patterns(views)
    )


def _is_near(view: View, points: Floats, places: Floats, reach: float) -> bool:
    return bool((_squared(points, places) < (reach * view.observation.sigma) ** 2).any())


def _squared(points: Floats, places: Floats) -> Floats:
    """Squared distances (K, n) of points (K, m) and places (n, m)."""
    away = points[:, None] - places
    return np.asarray((away * away).sum(axis=2))
