"""Poses of many bodies at once: points in space as features of any of them, shared out.

Points where rays of several cameras meet are those of all bodies.  Triangles of them that are no
larger than a body are its features', as `from_point_triples` has it; and what is found goes to the
set of poses of which no two have the same detections, the likelier having what both meet.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from mixpose.body import Body
from mixpose.judgement import JudgementRules, paid_by_count
from mixpose.objective import View
from mixpose.records import Floats, Indices, Mask
from mixpose.rigid import transform
from mixpose.search.from_points import (
    TriangulatedPoints,
    by_promise,
    feature_triangles,
    of_triples,
    triangulate,
)
from mixpose.search.poses import (
    LabelImage,
    count_inliers,
    label_image,
    matches_of,
    odds_at,
    unlike,
)
from mixpose.search.problem import (
    THOROUGH,
    SearchBudget,
    SearchProblem,
    SensorDetections,
    is_pointlike,
    largest_error,
    sensor_detections,
)
from mixpose.sensors import Rays

_AT_ONCE = 64  # points: where all are near each other 40,000 triples of them


class _Candidates(NamedTuple):
    """Poses of one body."""

    poses: Floats  # (K, 4, 4)
    evidence: Floats  # (K,) log odds against clutter, if they had not been chosen to fit
    gains: Floats  # (K,) nats that what is known before the frame adds to them
    numbers: Indices  # (K, L N) detections of all cameras that they meet; -1 for none


@dataclass(frozen=True, eq=False)
class SeenTogether:
    """What cameras see together, for whichever body: worked out once, when it is asked for."""

    views: Sequence[View] = ()
    rules: JudgementRules = JudgementRules()
    budget: SearchBudget = THOROUGH
    _copies: dict[Body, list[Copy]] = field(default_factory=dict)

    def copies_of(self, body: Body, free: Mask) -> list[Copy]:
        """Poses of a body as `search_copies` finds them, of which nothing is known.

        All bodies of a scene have the same free directions.
        """
        if body not in self._copies:
            self._copies[body] = search_copies(self, [body], free)
        return self._copies[body]

    @cached_property
    def detections(self) -> list[SensorDetections]:
        """Of all views that saw something."""
        return sensor_detections(self.views)

    @cached_property
    def _cameras(self) -> list[tuple[SensorDetections, Rays, float]]:
        """Those with lines of sight, and the largest errors of detections."""
        return [
            (one, one.rays, largest_error(one, self.rules)) for one in self.detections if one.rays
        ]

    @cached_property
    def points(self) -> TriangulatedPoints | None:
        """Where rays of two cameras or more meet; None of fewer."""
        if len(self._cameras) < 2:
            return None
        _, rays, reaches = zip(*self._cameras, strict=True)
        return triangulate(rays, reaches, self.budget)

    @cached_property
    def images(self) -> list[LabelImage]:
        """The detections of each camera."""
        return [label_image(*camera) for camera in self._cameras]


class Copy(NamedTuple):
    """A pose of one of several bodies, and the next best of it by some of the same detections."""

    kind: int  # which of the bodies
    T_world_object: Floats  # (4, 4)
    evidence: float
    rival: Floats | None  # (4, 4)


def search_copies(
    seen: SeenTogether,
    bodies: Sequence[Body],
    free: Mask,
    known: Callable[[int, Floats], Floats] = lambda kind, poses: np.zeros(len(poses)),
) -> list[Copy]:
    """Find poses of bodies, any number of each, that explain a frame together; most evident first.

    By detections of two cameras or more that meet in space; there are none without, nor of a body
    whose features are no points.  What is `known` of a kind's poses (K, 4, 4) before the frame are
    nats (K,) that they gain.
    """
    kinds = [k for k, body in enumerate(bodies) if is_pointlike(body)]
    points, budget = seen.points, seen.budget
    if points is None or not kinds or not free.all():
        return []
    problems = [
        SearchProblem(seen.detections, bodies[k], free, np.eye(4), seen.rules, budget)
        for k in kinds
    ]
    triangles = [feature_triangles(bodies[k], 6 * budget.sample, budget.min_sine) for k in kinds]
    longest = max(float(tree.data.max(initial=0.0)) for _, tree in triangles)
    # a point that may be anywhere in a body tells nothing of it
    points = TriangulatedPoints._make(one[points.tolerance < longest / 2] for one in points)
    points = by_promise(problems[0], points)
    triples = _near_triples(points, longest, budget.batch)
    poses = [
        of_triples(problem, points, own, triples)
        for problem, own in zip(problems, triangles, strict=True)
    ]
    found = {
        k: _candidates(problem, some, seen, partial(known, k))
        for k, problem, some in zip(kinds, problems, poses, strict=True)
    }
    return _shared_out(found, bodies, budget)


def _candidates(
    problem: SearchProblem,
    poses: Floats,
    seen: SeenTogether,
    known: Callable[[Floats], Floats],
) -> _Candidates:
    """Of poses (K, 4, 4) of one body those that may be, and what they meet."""
    body, budget = problem.body, problem.budget
    poses = poses[unlike(body, poses, budget.alike)]
    if not len(poses):
        return _Candidates(poses, np.zeros(0), np.zeros(0), np.zeros((0, 1), dtype=np.intp))
    if len(poses) > budget.shortlist:
        counts, near = count_inliers(seen.images, body, poses)
        ranks = counts.sum(axis=0) + 0.1 * near
        poses = poses[np.argsort(-ranks, kind="stable")[: budget.shortlist]]
    matches = matches_of(problem, poses)
    begins = np.cumsum([0, *(len(sensor.points) for sensor, _ in problem.cameras)])
    met = matches.detections >= 0
    numbers = np.where(met, matches.detections + begins[:-1, None], -1).reshape(len(poses), -1)
    odds = odds_at(problem, matches)
    # against each other they are as free to fit
    possible = paid_by_count(odds, matches, problem.free) > budget.hopeless
    poses, evidence = poses[possible], (odds[0] + odds[1])[possible]
    return _Candidates(poses, evidence, known(poses), numbers[possible])


def _near_triples(points: TriangulatedPoints, longest: float, most: int) -> Indices:
    """Triples (K, 3) of points that share no ray and are as near to each other as features are.

    The most promising first, so many at most.
    """
    pairs = cKDTree(points.points).query_pairs(2 * longest, output_type="ndarray")
    away = np.linalg.norm(np.subtract(*points.points[pairs.T]), axis=1)
    pairs = pairs[away < longest + points.tolerance[pairs].sum(axis=1)]
    rays = points.sensors * (points.rays.max(initial=0) + 1) + points.rays
    pairs = pairs[(rays[pairs[:, 0], :, None] != rays[pairs[:, 1], None]).all(axis=(1, 2))]
    are_near = np.zeros((len(rays), len(rays)), dtype=np.bool_)
    are_near[pairs[:, 0], pairs[:, 1]] = True
    found, count = [np.zeros((0, 3), dtype=np.intp)], 0
    for start in range(0, len(rays), _AT_ONCE):
        # i < j < k, each pair of them near, k of the next points
        some, block = pairs[pairs[:, 1] < start + _AT_ONCE], slice(start, start + _AT_ONCE)
        pair, third = np.nonzero(are_near[some[:, 0], block] & are_near[some[:, 1], block])
        order = np.argsort(third, kind="stable")
        found.append(np.column_stack([some[pair], start + third])[order])
        if (count := count + len(order)) >= most:
            break
    return np.concatenate(found)[:most]


def _are_alike(body: Body, a: Floats, b: Floats, budget: SearchBudget) -> bool:
    """Whether two poses (4, 4) put the body, symmetries aside, into the same place."""
    away = transform(a @ body.symmetries, body.means) - transform(b, body.means)
    return bool(np.linalg.norm(away, axis=-1).max(axis=-1).min() < budget.alike * body.radius)


def _shared_out(
    found: Mapping[int, _Candidates], bodies: Sequence[Body], budget: SearchBudget
) -> list[Copy]:
    """The poses of which no two have the same detections, the likeliest first."""
    some = list(found.values())
    kinds = np.repeat(list(found), [len(one.poses) for one in some]).tolist()
    poses = np.concatenate([one.poses for one in some])
    evidence = np.concatenate([one.evidence for one in some])
    likely = evidence + np.concatenate([one.gains for one in some])
    rows = [row[row >= 0].tolist() for one in some for row in one.numbers]
    owners, rivals = dict[int, int](), dict[int, int]()
    order = np.argsort(-likely, kind="stable")
    kept = list[int]()
    for k in order.tolist():
        others = [owners[number] for number in rows[k] if number in owners]
        if len(others) <= (1 - budget.convincing) * len(rows[k]):
            kept.append(k)
            owners = dict.fromkeys(rows[k], k) | owners
            continue
        for j in set(others) - set(rivals):
            is_near = kinds[j] == kinds[k] and likely[k] > likely[j] - budget.outdone
            if is_near and not _are_alike(bodies[kinds[k]], poses[j], poses[k], budget):
                rivals[j] = k
    return [
        Copy(kinds[k], poses[k], float(evidence[k]), poses[rivals[k]] if k in rivals else None)
        for k in kept
    ]
