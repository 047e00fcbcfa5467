"""Whose each detection is: a body's, nobody's so far, or two bodies' in one.

No detection belongs to two bodies.  What belongs to another is left out of what a body sees: from
its density, so that it does not pull, and from the clutter that its evidence is weighed against.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from mixpose.density import Observation
from mixpose.judgement import ScoredPose
from mixpose.objective import View
from mixpose.records import PointPattern

Floats: TypeAlias = NDArray[np.float64]
Owners: TypeAlias = dict[str, NDArray[np.intp]]

FREE, MERGED = -1, -2
"""Owners of detections that are nobody's so far, and that are two bodies' features in one spot."""


class Claim(NamedTuple):
    """The detections that a pose meets in one sensor: which, where it expects them, how far off."""

    detections: NDArray[np.intp]
    places: Floats
    squared: Floats


@dataclass(frozen=True)
class Left:
    """What others leave for a body.

    Attributes
    ----------
    views : tuple of View
    kept : mapping of str to (K,) int
        By sensor, the detections that are left, by their numbers in the whole view.
    """

    views: tuple[View, ...]
    kept: Mapping[str, NDArray[np.intp]]


def nobody(views: Sequence[View]) -> Owners:
    """Owners before anything is known; sensors without single detections have none."""
    return {
        view.name: np.full(len(view.observation.pattern.points), FREE)
        for view in views
        if isinstance(view.observation.pattern, PointPattern)
    }


def left_for(k: int, views: Sequence[View], owners: Owners) -> Left:
    """What others leave for body k."""
    some, kept = [], {}
    for view in views:
        pattern, own = view.observation.pattern, owners.get(view.name)
        if own is None or not isinstance(pattern, PointPattern):
            some.append(view)
            continue
        kept[view.name] = np.flatnonzero((own == FREE) | (own == k))
        some.append(_part(view, pattern, kept[view.name]))
    return Left(tuple(some), kept)


def _part(view: View, pattern: PointPattern, kept: NDArray[np.intp]) -> View:
    if len(kept) == len(pattern.points):
        return view
    part = PointPattern(pattern.points[kept], pattern.weights[kept])
    seen = view.observation
    return replace(view, observation=Observation(part, seen.sigma, seen.intrinsic))


def claims_of(judged: ScoredPose, left: Left) -> dict[str, Claim]:
    """The detections that a pose meets, numbered as in the whole views."""
    claims, used = {}, judged.used
    for k, (name, m) in enumerate(zip(used.names, used.dimensions)):
        if name in left.kept:
            met = used.detections[k] >= 0
            numbers = left.kept[name][used.detections[k, met]]
            claims[name] = Claim(numbers, used.places[k, met, :m], used.squared[k, met])
    return claims


def expected_owners(
    views: Sequence[View], places: Mapping[int, Mapping[str, Floats]], gate: float
) -> Owners:
    """Owners by where features are expected, each detection the one whose feature it lies nearest.

    Parameters
    ----------
    views : sequence of View
    places : mapping of int to mapping of str to (n, m) array
        By body and sensor.
    gate : float
        How far at most, in σ_ε.
    """
    owners = nobody(views)
    for view in views:
        pattern = view.observation.pattern
        if not places or not isinstance(pattern, PointPattern) or not len(pattern.points):
            continue
        own = [each[view.name] for each in places.values()]
        whose = np.repeat(list(places), [len(y) for y in own])
        if not len(whose):
            continue
        away = pattern.points[:, None] - np.concatenate(own)
        squared = (away * away).sum(axis=2)
        most = (gate * view.observation.sigma) ** 2
        rows, columns = linear_sum_assignment(np.minimum(squared, most))
        near = squared[rows, columns] < most
        owners[view.name][rows[near]] = whose[columns[near]]
    return owners


def claimed(views: Sequence[View], claims: Mapping[int, Mapping[str, Claim]]) -> Owners:
    """Owners by what poses meet; of a detection that two meet, the one that it lies nearer to.

    A detection that lies nearer to the middle of the two places than to either is both their
    images in one: it is neither's, as it is not where either is.
    """
    owners = nobody(views)
    for name, own in owners.items():
        nearest = np.full(len(own), np.inf)
        sigma = next(view.observation.sigma for view in views if view.name == name)
        points = _points(views, name)
        holds = np.zeros((len(own), points.shape[1]))
        for k, by_sensor in claims.items():
            if name not in by_sensor:
                continue
            claim = by_sensor[name]
            for j, place, squared in zip(*claim, strict=True):
                if own[j] in (FREE, k):
                    own[j], nearest[j], holds[j] = k, squared, place
                    continue
                middle = ((points[j] - (place + holds[j]) / 2) ** 2).sum() / sigma**2
                if middle < min(squared, nearest[j]) and ((place - holds[j]) ** 2).sum() > sigma**2:
                    own[j] = MERGED
                elif squared < nearest[j]:
                    own[j], nearest[j], holds[j] = k, squared, place
    return owners


def unmet_places(judged: ScoredPose) -> dict[str, Floats]:
    """Where a pose has features that nothing was found at, by sensor."""
    seen = judged.matches
    unmet = (seen.weights > 0) & (seen.shares == 0)
    sensors = enumerate(zip(seen.names, seen.dimensions))
    return {name: seen.places[k, unmet[k], :m] for k, (name, m) in sensors}


def merged_spots(
    views: Sequence[View],
    claims: Mapping[int, Mapping[str, Claim]],
    unmet: Mapping[int, Mapping[str, Floats]],
    touching: float,
    pulled: float,
) -> dict[str, set[int]]:
    """Detections that may be features of two bodies in one spot, by sensor.

    One body meets it loosely, and another has a feature beside it that nothing was found at.

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
    found: dict[str, set[int]] = {}
    for view in views:
        name, most = view.name, (touching * view.observation.sigma) ** 2
        for k, by_sensor in claims.items():
            loose = by_sensor[name].squared > pulled if name in by_sensor else np.zeros(0)
            others = [unmet[o][name] for o in unmet if o != k and name in unmet[o]]
            if not loose.any() or not any(map(len, others)):
                continue
            numbers = by_sensor[name].detections[loose.astype(bool)]
            away = _points(views, name)[numbers][:, None] - np.concatenate(others)
            near = ((away * away).sum(axis=2) < most).any(axis=1)
            if near.any():
                found.setdefault(name, set()).update(numbers[near].tolist())
    return found


def _points(views: Sequence[View], name: str) -> Floats:
    pattern = next(view.observation.pattern for view in views if view.name == name)
    assert isinstance(pattern, PointPattern)
    return pattern.points


def overlap(a: Mapping[str, Claim], b: Mapping[str, Claim]) -> float:
    """Share of the detections of the one that claims fewer that both claim."""
    both = sum(len(np.intersect1d(a[n].detections, b[n].detections)) for n in a.keys() & b.keys())
    fewer = min(sum(len(np.unique(c.detections)) for c in each.values()) for each in (a, b))
    return both / max(fewer, 1)


def are_alike(k: int, owners: Owners, before: Owners) -> bool:
    """Whether the same is left for body k."""
    return all(
        np.array_equal(now, before[name])
        or np.array_equal((now == FREE) | (now == k), (before[name] == FREE) | (before[name] == k))
        for name, now in owners.items()
    )


def is_reached(
    k: int,
    views: Sequence[View],
    owners: Owners,
    before: Owners,
    places: Mapping[str, Floats],
    reach: float,
) -> bool:
    """Whether other detections than before are left for body k within its reach, in σ_ε."""
    for view in views:
        if view.name not in owners or view.name not in places:
            continue
        now, then = owners[view.name], before[view.name]
        changed = ((now == FREE) | (now == k)) != ((then == FREE) | (then == k))
        if changed.any() and _is_near(view, changed, places[view.name], reach):
            return True
    return False


def hides_near(view: View, kept: NDArray[np.intp], places: Floats, reach: float) -> bool:
    """Whether a detection that is left out lies within reach, in σ_ε, of places (n, m)."""
    pattern = view.observation.pattern
    assert isinstance(pattern, PointPattern)
    if len(kept) == len(pattern.points):
        return False
    hidden = np.ones(len(pattern.points), dtype=np.bool_)
    hidden[kept] = False
    return _is_near(view, hidden, places, reach)


def _is_near(view: View, chosen: NDArray[np.bool_], places: Floats, reach: float) -> bool:
    pattern = view.observation.pattern
    assert isinstance(pattern, PointPattern)
    if not len(places):
        return False
    away = pattern.points[chosen][:, None] - places
    return bool(((away * away).sum(axis=2) < (reach * view.observation.sigma) ** 2).any())
