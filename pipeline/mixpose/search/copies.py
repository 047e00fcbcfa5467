"""Search the poses of many bodies together, from points in space that any of them may own.

Rays of several cameras meet at points of all bodies.  Triangles of these points that are no larger
than a body are matched with its features, as in `from_point_triples`.  Of the poses found, a set
is kept in which few detections are shared; a detection that two poses meet goes to the likelier.
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
    feature_triangles,
    poses_of_triples,
    sort_by_support,
    triangulate,
)
from mixpose.search.poses import (
    LabelImage,
    count_inliers,
    distinct_poses,
    label_image,
    matches_of,
    odds_at,
)
from mixpose.search.problem import (
    THOROUGH,
    SearchBudget,
    SearchProblem,
    SensorDetections,
    is_pointlike,
    sensor_detections,
)
from mixpose.sensors import Rays

_AT_ONCE = 64  # points per step: 40,000 triples where all are near each other


class _Candidates(NamedTuple):
    """Candidate poses of one body."""

    poses: Floats  # (K, 4, 4)
    evidence: Floats  # (K,) log odds against clutter, without the price of having been chosen
    log_priors: Floats  # (K,) nats
    numbers: Indices  # (K, L N) detections met, numbered over all cameras; -1 for none


@dataclass(frozen=True, eq=False)
class SeenTogether:
    """Triangulated points of one frame for the search of any body; computed once, on demand."""

    views: Sequence[View] = ()
    rules: JudgementRules = JudgementRules()
    budget: SearchBudget = THOROUGH
    _copies: dict[Body, list[Copy]] = field(default_factory=dict)

    def copies_of(self, body: Body, free: Mask) -> list[Copy]:
        """Return the poses that `search_copies` finds of one body without a prior.

        They are kept by body: all bodies of a scene have the same free directions.
        """
        if body not in self._copies:
            self._copies[body] = search_copies(self, [body], free)
        return self._copies[body]

    @cached_property
    def detections(self) -> list[SensorDetections]:
        """Detections of all views that are not empty."""
        return sensor_detections(self.views)

    @cached_property
    def _cameras(self) -> list[tuple[SensorDetections, Rays, float]]:
        """Sensors with lines of sight, and the largest errors of their detections."""
        sensors = [(sensor, sensor.rays) for sensor in self.detections if sensor.rays]
        return [(sensor, rays, sensor.reach(self.rules)) for sensor, rays in sensors]

    @cached_property
    def points(self) -> TriangulatedPoints | None:
        """Points where rays of two cameras or more meet; None with fewer cameras."""
        if len(self._cameras) < 2:
            return None
        _, rays, reaches = zip(*self._cameras, strict=True)
        return triangulate(rays, reaches, self.budget)

    @cached_property
    def images(self) -> list[LabelImage]:
        """Label images of the detections, one per camera."""
        return [label_image(*camera) for camera in self._cameras]


class Copy(NamedTuple):
    """A pose of one of several bodies, and the body's next best pose that shares detections."""

    kind: int  # index of the body
    T_world_object: Floats  # (4, 4)
    evidence: float
    rival: Floats | None  # (4, 4)


def search_copies(
    seen: SeenTogether,
    bodies: Sequence[Body],
    free: Mask,
    log_prior: Callable[[int, Floats], Floats] = lambda kind, poses: np.zeros(len(poses)),
) -> list[Copy]:
    """Find poses of bodies, any number of each, that explain a frame together; likeliest first.

    This needs detections of two cameras or more that meet in space, and bodies whose features are
    points; other bodies have no poses.  `log_prior` returns nats (K,) of a kind's poses (K, 4, 4).
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
    # a point that errs by half of a body or more says nothing about its pose
    points = TriangulatedPoints._make(array[points.tolerance < longest / 2] for array in points)
    points = sort_by_support(problems[0], points)
    triples = _near_triples(points, longest, budget.batch)
    poses = [
        poses_of_triples(problem, points, corners, triples)
        for problem, corners in zip(problems, triangles, strict=True)
    ]
    candidates = {
        k: _candidates(problem, guesses, seen, partial(log_prior, k))
        for k, problem, guesses in zip(kinds, problems, poses, strict=True)
    }
    return _resolve_shared(candidates, bodies, budget)


def _candidates(
    problem: SearchProblem,
    poses: Floats,
    seen: SeenTogether,
    log_prior: Callable[[Floats], Floats],
) -> _Candidates:
    """Return the possible ones among poses (K, 4, 4) of one body, with the detections they meet."""
    body, budget = problem.body, problem.budget
    poses = poses[distinct_poses(body, poses, budget.alike)]
    if not len(poses):
        return _Candidates(poses, np.zeros(0), np.zeros(0), np.zeros((0, 1), dtype=np.intp))
    if len(poses) > budget.shortlist:
        counts, near = count_inliers(seen.images, body, poses)
        ranks = counts.sum(axis=0) + 0.1 * near
        poses = poses[np.argsort(-ranks, kind="stable")[: budget.shortlist]]
    matches = matches_of(problem, poses)
    first = np.cumsum([0, *(len(sensor.points) for sensor, _ in problem.cameras)])
    is_met = matches.detections >= 0
    numbers = np.where(is_met, matches.detections + first[:-1, None], -1).reshape(len(poses), -1)
    odds = odds_at(problem, matches)
    # candidates are compared with each other without the price, which all of them pay
    kept = paid_by_count(odds, matches, problem.free) > budget.hopeless
    poses, evidence = poses[kept], (odds[0] + odds[1])[kept]
    return _Candidates(poses, evidence, log_prior(poses), numbers[kept])


def _near_triples(points: TriangulatedPoints, longest: float, limit: int) -> Indices:
    """Return the first `limit` triples (K, 3) of points within `longest` that share no ray."""
    pairs = cKDTree(points.points).query_pairs(2 * longest, output_type="ndarray")
    distances = np.linalg.norm(np.subtract(*points.points[pairs.T]), axis=1)
    pairs = pairs[distances < longest + points.tolerance[pairs].sum(axis=1)]
    rays = points.sensors * (points.rays.max(initial=0) + 1) + points.rays
    pairs = pairs[(rays[pairs[:, 0], :, None] != rays[pairs[:, 1], None]).all(axis=(1, 2))]
    are_near = np.zeros((len(rays), len(rays)), dtype=np.bool_)
    are_near[pairs[:, 0], pairs[:, 1]] = True
    triples, count = [np.zeros((0, 3), dtype=np.intp)], 0
    for start in range(0, len(rays), _AT_ONCE):
        # i < j < k, all three pairs near, k in the next block of points
        near, block = pairs[pairs[:, 1] < start + _AT_ONCE], slice(start, start + _AT_ONCE)
        pair, third = np.nonzero(are_near[near[:, 0], block] & are_near[near[:, 1], block])
        order = np.argsort(third, kind="stable")
        triples.append(np.column_stack([near[pair], start + third])[order])
        if (count := count + len(order)) >= limit:
            break
    return np.concatenate(triples)[:limit]


def _are_alike(body: Body, a: Floats, b: Floats, budget: SearchBudget) -> bool:
    """Test whether two poses (4, 4) are the same for the body, symmetries aside."""
    offsets = transform(a @ body.symmetries, body.means) - transform(b, body.means)
    return bool(np.linalg.norm(offsets, axis=-1).max(axis=-1).min() < budget.alike * body.radius)


def _resolve_shared(
    candidates: Mapping[int, _Candidates], bodies: Sequence[Body], budget: SearchBudget
) -> list[Copy]:
    """Keep poses, likeliest first, most of whose detections no likelier pose has taken."""
    groups = list(candidates.values())
    kinds = np.repeat(list(candidates), [len(group.poses) for group in groups]).tolist()
    poses = np.concatenate([group.poses for group in groups])
    evidence = np.concatenate([group.evidence for group in groups])
    scores = evidence + np.concatenate([group.log_priors for group in groups])
    rows = [row[row >= 0].tolist() for group in groups for row in group.numbers]
    owners, rivals = dict[int, int](), dict[int, int]()
    order = np.argsort(-scores, kind="stable")
    kept = list[int]()
    for k in order.tolist():
        taken = [owners[number] for number in rows[k] if number in owners]
        if len(taken) <= (1 - budget.convincing) * len(rows[k]):
            kept.append(k)
            owners = dict.fromkeys(rows[k], k) | owners
            continue
        for j in set(taken) - set(rivals):
            is_rival = kinds[j] == kinds[k] and scores[k] > scores[j] - budget.outdone
            if is_rival and not _are_alike(bodies[kinds[k]], poses[j], poses[k], budget):
                rivals[j] = k
    return [
        Copy(kinds[k], poses[k], float(evidence[k]), poses[rivals[k]] if k in rivals else None)
        for k in kept
    ]
