"""The first pose from nothing: guesses, a shortlist, descent, and what is left of it."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from mixpose.body import Body
from mixpose.errors import SessionError
from mixpose.objective import View
from mixpose.search.constraint import Constraint
from mixpose.search.counting import GATE, LabelMap, explained, label_maps
from mixpose.search.evidence import evidence
from mixpose.search.guesses import (
    from_cameras,
    from_restricted_turns,
    from_slips,
    from_spread_orientations,
)
from mixpose.search.layout import far_apart
from mixpose.search.levels import levels
from mixpose.search.refinement import Stage, descend, first_of_each, unlike
from mixpose.search.scoring import scores
from mixpose.search.sightings import Sighting, sightings

Floats: TypeAlias = NDArray[np.float64]

SHORTLISTED = 300
CONVINCING = 0.7
"""Share of the body that all sensors together must meet for no other kind of guess to be made."""

SUFFICIENT = 0.45
"""Share at which guesses of lines of sight are not followed by all orientations."""

OVERWHELMING = 24.0
"""Evidence, in nats, at which several cameras leave no doubt: a million guesses make 14."""

_FEW_FEATURES = 8  # with more, fewer guesses need to be kept
_MANY_FEATURES = 16  # with as many, chance does not explain most of them
_LEAST = 40
_GRIDS = 120  # features of a body up to which slips by a step of a grid are looked for
_ENOUGH = 0.8  # of all detections: the search for better guesses of a kind ends
_CELL = 0.05  # of the body's radius: guesses that put features so close together are one
_BEHIND = 3.0  # detections that a guess may explain less than the best


@dataclass(frozen=True)
class Candidate:
    """A pose that may explain the views.

    Attributes
    ----------
    T_world_object : (4, 4) float64
    score : float
        Matched objective at the finest blur, summed over views, every detection counting alike:
        (k/n)² per view with k of n features met exactly.
    evidence : float
        What candidates are ranked by: logarithm of the odds that this is not chance; with
        ranges among the sensors, the score.
    """

    T_world_object: Floats
    score: float
    evidence: float = 0.0


@dataclass(frozen=True)
class _Task:
    """What stays the same during a search."""

    sightings: Sequence[Sighting]
    body: Body
    constraint: Constraint
    maps: Sequence[LabelMap]
    rng: np.random.Generator


def search(
    views: Sequence[View],
    body: Body,
    *,
    free: NDArray[np.bool_],
    T_reference: Floats | None,
    count: int = 8,
    seed: int = 0,
) -> list[Candidate]:
    """Find poses that explain the views, without a start.

    Parameters
    ----------
    views : sequence of View
        Views that saw nothing are passed over.
    body : Body
    free : (6,) bool
        World directions to search, order of `mixpose.rigid`.
    T_reference : (4, 4) array or None
        Where the directions that are not free stay; may be None when all are free.
    count : int
        Most candidates returned.
    seed : int
        Of the order in which guesses are tried, where not all can be.

    Returns
    -------
    list of Candidate
        Best first, no two alike modulo the body's symmetries; empty where nothing was seen.

    Raises
    ------
    SessionError
        If directions are held without a reference pose.
    """
    free = np.asarray(free, dtype=np.bool_)
    if T_reference is None and not free.all():
        raise SessionError(
            "search: start: found none, but some directions are not free: a start must say where "
            "they stay"
        )
    seen = sightings(views, body)
    if not seen:
        return []
    reference = np.eye(4) if T_reference is None else np.asarray(T_reference, dtype=np.float64)
    maps = label_maps(seen, GATE)
    task = _Task(seen, body, Constraint(free, reference), maps, np.random.default_rng(seed))
    poses, ranks = _found(task)
    if len(poses) and maps and _MANY_FEATURES <= len(body) <= _GRIDS:
        slips = _shortlist(task, [from_slips(body, poses[ranks.argmax()])])
        found = _descended(task, slips)
        poses, ranks = np.concatenate([poses, found]), np.append(ranks, _rank(task, found))
    return _candidates(task, poses, ranks, count)


def _found(task: _Task) -> tuple[Floats, Floats]:
    """Refined poses with their ranks, of as many kinds of guesses as are needed."""
    poses, ranks, coverage = np.zeros((0, 4, 4)), np.zeros(0), 0.0
    for attempt in (_sharp_attempts, _blunt_attempt):
        for found in attempt(task):
            poses, ranks = np.concatenate([poses, found]), np.append(ranks, _rank(task, found))
            coverage = _coverage(task, poses[ranks.argmax()]) if len(poses) else 0.0
            overwhelming = len(task.sightings) > 1 and ranks.max(initial=0.0) > OVERWHELMING
            if coverage >= (SUFFICIENT if overwhelming else CONVINCING):
                break
        if coverage >= SUFFICIENT:
            break
    return poses, ranks


def _is_seen_by_cameras(task: _Task) -> bool:
    """Whether all sensors have detections in an image, of features that are points.

    Ranges are met by chance too often, and err too coarsely, for single detections to count.
    """
    return len(task.maps) == len(task.sightings) and _is_pointlike(task.body)


def _is_pointlike(body: Body) -> bool:
    return len(body.nodes.points) == len(body)


def _rank(task: _Task, poses: Floats) -> Floats:
    """Evidence where all sensors are cameras, else the score."""
    if _is_seen_by_cameras(task):
        return evidence(task.sightings, task.body, poses, task.constraint.free)
    finest = levels(task.sightings, [1.0] * len(task.sightings), len(task.body))
    return np.asarray(scores(finest, task.body, poses).sum(axis=0))


def _descended(task: _Task, guesses: Floats) -> Floats:
    """Guesses that are off by a few σ_ε, refined in two ways.

    Once to σ_ε; and once from less to less, where clutter beside a feature pulls less.  Where
    detections err by as much as σ_ε the second is no gain, and the ranking keeps the first.
    """
    plans = [((3.0, 1), (1.5, 2), (1.0, 3))]
    if _is_seen_by_cameras(task):
        plans.append(((1.5, 2), (0.75, 2), (0.4, 2)))
    count = len(task.sightings)
    found = [
        descend(
            task.sightings,
            task.body,
            guesses,
            [Stage([factor] * count, steps, SHORTLISTED) for factor, steps in plan],
            task.constraint.free,
        )
        for plan in plans
    ]
    return np.concatenate(found)


def _blunt_attempt(task: _Task) -> Iterator[Floats]:
    """Refined poses of all orientations on blurred densities."""
    poses, plan = from_spread_orientations(task.sightings, task.body, task.constraint)
    yield descend(task.sightings, task.body, poses, plan, task.constraint.free)


def _sharp_attempts(task: _Task) -> Iterator[Floats]:
    """Refined poses of one kind of guess after the other, the quickest kind first."""
    if task.maps and _is_pointlike(task.body):
        kinds: list[Iterable[Floats]] = []
        if task.constraint.turns.sum() < 2:
            kinds.append(from_restricted_turns(task.sightings, task.body, task.constraint))
        kinds += from_cameras(task.sightings, task.body, task.rng)
        for guesses in kinds:
            shortlist = _shortlist(task, guesses)
            if len(shortlist):
                yield _descended(task, shortlist)


def _shortlist(task: _Task, guesses: Iterable[Floats]) -> Floats:
    """The guesses that explain most distinct detections, and among equals most closely."""
    poses, ranks = np.zeros((0, 4, 4)), np.zeros(0)
    most = max(min(SHORTLISTED, SHORTLISTED * _FEW_FEATURES // len(task.body)), _LEAST)
    for batch in guesses:
        allowed = _promising(task, task.constraint.apply(batch))
        counts, near = explained(task.maps, task.body.means, task.body.normals, allowed)
        rank = counts.sum(axis=0) + 0.1 * near
        if len(ranks) == most:
            better = rank > ranks[-1]
            allowed, rank = allowed[better], rank[better]
        poses, ranks = np.concatenate([poses, allowed]), np.concatenate([ranks, rank])
        order = np.argsort(-ranks, kind="stable")
        order = order[unlike(task.body, poses[order], _CELL)][:most]
        poses, ranks = poses[order], ranks[order]
        if ranks.max(initial=0.0) > _ENOUGH * _most_explainable(task):
            break
    return np.asarray(poses[ranks > ranks.max(initial=0.0) - _BEHIND])


def _promising(task: _Task, poses: Floats) -> Floats:
    """The better of many guesses, judged by some features where the body has many."""
    few = far_apart(task.body.means, _MANY_FEATURES)
    if len(few) == len(task.body) or len(poses) <= SHORTLISTED:
        return poses
    normals = None if task.body.normals is None else task.body.normals[few]
    counts, near = explained(task.maps, task.body.means[few], normals, poses)
    rank = counts.sum(axis=0) + 0.1 * near
    return poses[np.argsort(-rank, kind="stable")[:SHORTLISTED]]


def _most_explainable(task: _Task) -> float:
    """Detections that a perfect pose explains; infinite where chance could reach it too."""
    each = [min(len(task.body), each.count) for each in task.maps]
    return float(sum(each)) if min(each) >= _MANY_FEATURES else np.inf


def _coverage(task: _Task, pose: Floats) -> float:
    """Mean share of the features that the sensors meet."""
    finest = levels(task.sightings, [1.0] * len(task.sightings), len(task.body))
    return float(np.sqrt(scores(finest, task.body, pose[None])).mean())


def _candidates(task: _Task, poses: Floats, ranks: Floats, count: int) -> list[Candidate]:
    """Distinct poses, best first."""
    finest = levels(task.sightings, [1.0] * len(task.sightings), len(task.body))
    kept = first_of_each(task.body, poses, ranks, count)
    values = scores(finest, task.body, poses[kept]).sum(axis=0)
    return [Candidate(poses[k], float(v), float(ranks[k])) for k, v in zip(kept, values)]
