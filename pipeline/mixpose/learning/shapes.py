"""Shapes, a few points at known distances: where they are in a frame, and how they grow to bodies.

Frames in which a body is where it was before tell nothing new of what belongs to it: whatever rests
beside it would.  What counts are poses apart from each other.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations
from typing import TypeAlias

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from mixpose.body import Body, PointFeature
from mixpose.body.symmetry import congruent_triples, motions
from mixpose.learning.points import Cloud, gathered_places
from mixpose.learning.rules import RULES
from mixpose.records import Floats, Indices, Mask
from mixpose.rigid import from_parts, inverse, transform

FEWEST = 3
_HEIGHT = 4.0  # deviations of a point above the longest side: less fixes no turn
# gates within which points are met before and after each fit to all that is met; later fits reach
# farther from the first three
_WIDE = (2.0, 2.0, 1.0, 1.0)
_SURER = 0.15  # of a point's reach: errors that many frames have in common


@dataclass(frozen=True, eq=False)
class Shape:
    """Points of a body, as far as it is known."""

    points: Floats  # (N, 3)
    reach: Floats  # (N,): standard deviation of each, as of `Cloud`

    def __len__(self) -> int:
        return len(self.points)


@dataclass(frozen=True, eq=False)
class Placement:
    """Where a shape is in a frame."""

    T_world_shape: Floats  # (4, 4)
    met: Indices  # (N,): the point of the cloud that each point of the shape is; -1 for none
    off: float  # root mean square distance of the two, by what they may be off

    @cached_property
    def own(self) -> Indices:
        """Points of the shape that are met."""
        return np.flatnonzero(self.met >= 0)

    @cached_property
    def there(self) -> Indices:
        """Points of the cloud that they meet."""
        return self.met[self.own]

    @property
    def count(self) -> int:
        """How many points are met."""
        return len(self.own)


Places: TypeAlias = Sequence[tuple[int, Placement]]
"""Placements with the index of the cloud that each is in."""


def body_of(name: str, points: Floats) -> Body:
    """A body of points without spread."""
    return Body(name, tuple(PointFeature(point) for point in points))


def triples_of(points: Floats, reach: Floats) -> Indices:
    """Triples (K, 3) of points (N, 3) that are not on a line, the largest heights first."""
    triples = np.array(list(combinations(range(len(points)), FEWEST)), dtype=np.intp)
    if not len(triples):
        return np.zeros((0, FEWEST), dtype=np.intp)
    a, b, c = np.moveaxis(points[triples], 1, 0)
    longest = np.linalg.norm(np.array([b - a, c - a, c - b]), axis=2).max(axis=0)
    height = np.linalg.norm(np.cross(b - a, c - a), axis=1) / np.maximum(longest, 1e-300)
    order = np.argsort(-height, kind="stable")
    return np.asarray(triples[order][(height > _HEIGHT * reach[triples].max(axis=1))[order]])


def wide_triples(points: Floats, reach: Floats, most: int) -> Indices:
    """Some of these triples (K, 3), in which all points stand about equally often."""
    triples = triples_of(points, reach)
    kept, used = list[int](), np.zeros(len(points))
    left = np.ones(len(triples), dtype=np.bool_)
    while left.any() and len(kept) < most:
        k = int(np.argmin(np.where(left, used[triples].sum(axis=1), np.inf)))
        used[triples[k]] += 1
        left[k] = False
        kept.append(k)
    return np.asarray(triples[kept])


def placements(
    shape: Shape, bases: Indices, cloud: Cloud, most: int, least: int
) -> list[Placement]:
    """Placements of a shape in a cloud, of which no two have a point in common; the best first.

    At most so many, by the triples (B, 3) of it that are looked for, and with at least so many
    points met.
    """
    if len(cloud) < least or not len(bases):
        return []
    typical = np.hypot(np.median(cloud.reach), np.median(shape.reach))
    off, candidates = RULES.gate * np.sqrt(2.0) * typical, []
    for base in shape.points[bases]:
        triples = congruent_triples(base, cloud.points, off)
        candidates.append(motions(base, cloud.points[triples]))
    poses = np.concatenate(candidates)
    if not len(poses):
        return []
    tree = cKDTree(cloud.points)
    away, nearest = tree.query(transform(poses, shape.points))
    allowed = RULES.gate * np.hypot(cloud.reach[nearest], shape.reach)
    counts = (away < 2 * allowed).sum(axis=1) - 0.1 * np.minimum(away / allowed, 2).mean(axis=1)
    order = np.argsort(-counts, kind="stable")[: RULES.placements * most]
    refined = list[Placement]()
    for k in order:
        # most triples of a shape lead to the one place where it is; triangles fit in many ways
        alone = most == 1 and len(shape) > FEWEST and refined
        if alone and max(each.count for each in refined) >= counts[k]:
            break
        refined.append(_refined(shape, poses[k], cloud, tree))
    good = [each for each in refined if each.count >= least]
    good.sort(key=lambda each: (-each.count, each.off))
    kept, taken = list[Placement](), set[int]()
    for each in good:
        own = set(each.there.tolist())
        if not own & taken:
            kept.append(each)
            taken |= own
        if len(kept) == most:
            break
    return kept


def _refined(shape: Shape, T: Floats, cloud: Cloud, tree: cKDTree) -> Placement:
    """Fit a pose to all points that it meets."""
    found = _placement(shape, T, cloud, tree, _WIDE[0])
    for wide in _WIDE[1:]:
        if found.count < FEWEST:
            break
        there = found.there
        T = _weighted_motion(shape.points[found.own], cloud.points[there], cloud.reach[there])
        found = _placement(shape, T, cloud, tree, wide)
    return found


def _placement(shape: Shape, T: Floats, cloud: Cloud, tree: cKDTree, wide: float) -> Placement:
    """Which point of a cloud each point of a shape is at a pose, one to one."""
    away, nearest = tree.query(transform(T, shape.points))
    share = away / (RULES.gate * wide * np.hypot(cloud.reach[nearest], shape.reach))
    met = np.full(len(shape), -1, dtype=np.intp)
    order = np.argsort(share, kind="stable")
    order = order[share[order] < 1]
    _, first = np.unique(nearest[order], return_index=True)
    found = np.sort(order[first])
    met[found] = nearest[found]
    off = float(np.sqrt(np.mean(share[found] ** 2))) if len(found) else np.inf
    return Placement(T, met, off)


def _weighted_motion(source: Floats, target: Floats, reach: Floats) -> Floats:
    """The motion (4, 4) of points (n, 3) onto others, those that are known better counting more."""
    weight = 1 / reach**2
    weight = weight / weight.sum()
    a, b = weight @ source, weight @ target
    turn, _ = Rotation.align_vectors(target - b, source - a, weights=weight)
    R = turn.as_matrix()
    return from_parts(R, b - R @ a)


@dataclass(frozen=True, eq=False)
class Found:
    """A body, and where it is in which frames."""

    shape: Shape  # in a frame of its own
    places: tuple[tuple[int, Placement], ...]  # of congruent bodies several in a cloud
    count: int = 1  # congruent bodies that are seen at a time
    loose: float = 1.0  # times the error of triangulation that its points may be off

    @property
    def met(self) -> int:
        """Points that are met, all frames together."""
        return sum(one.count for _, one in self.places)


def least_met(points: int) -> int:
    """Points of a shape that must be met, so that no other points lie like them by chance."""
    return FEWEST if points <= FEWEST + 1 else FEWEST + 1


def placed(
    shape: Shape,
    clouds: Sequence[Cloud],
    most: int = 1,
    least: int | None = None,
    bases: int | None = None,
) -> list[tuple[int, Placement]]:
    """Where a shape is in all clouds, at most so many times in each."""
    triples = wide_triples(shape.points, shape.reach, bases or RULES.bases)
    least = least_met(len(shape)) if least is None else least
    return [
        (k, one)
        for k, cloud in enumerate(clouds)
        for one in placements(shape, triples, cloud, most, least)
    ]


def grown(shape: Shape, clouds: Sequence[Cloud]) -> Found | None:
    """Find a shape of three points or more in all frames, and in these all that goes along.

    None where it does not recur.
    """
    for turn in range(RULES.rounds):
        places = placed(shape, clouds)
        if len(places) < RULES.least_frames:
            return None
        shape, _ = averaged(shape, places, clouds)
        if len(shape) < FEWEST:
            return None
        if turn + 1 == RULES.rounds:
            break
        before = len(shape)
        shape = _with_hidden(shape, places, clouds)
        if len(shape) == before and turn:
            break
    if not len(wide_triples(shape.points, shape.reach, 1)):
        return None
    places = placed(shape, clouds)
    _, different = _poses_apart(shape, places, clouds)
    return Found(shape, tuple(places)) if different >= RULES.least_frames else None


def usual_reach(places: Places, clouds: Sequence[Cloud]) -> float:
    """By how much points that are met are off, in most placements."""
    return float(np.median([clouds[k].reach[one.there].mean() for k, one in places]))


def _poses_apart(shape: Shape, places: Places, clouds: Sequence[Cloud]) -> tuple[Indices, int]:
    """Numbers (K,) of the poses of placements, the same where no point is far, and how many."""
    if not places:
        return np.zeros(0, dtype=np.intp), 0
    points = transform(np.array([one.T_world_shape for _, one in places]), shape.points)
    far = RULES.apart * RULES.gate * usual_reach(places, clouds)
    number, count = np.full(len(points), -1, dtype=np.intp), 0
    for k in range(len(points)):
        if number[k] < 0:
            away = np.abs(points - points[k]).max(axis=(1, 2), initial=0.0)
            number[(number < 0) & (away <= far)] = count
            count += 1
    return number, count


def averaged(shape: Shape, places: Places, clouds: Sequence[Cloud]) -> tuple[Shape, Mask]:
    """The shape as its frames show it on average, without points that few of them show.

    And which of its points (N,) are left.
    """
    weight, total = np.zeros(len(shape)), np.zeros((len(shape), 3))
    counts, reach = np.zeros(len(shape)), np.zeros(len(shape))
    number, different = _poses_apart(shape, places, clouds)
    seen = np.zeros((len(shape), different), dtype=np.bool_)
    for n, (k, one) in zip(number.tolist(), places, strict=True):
        own, there = one.own, one.there
        w = 1 / clouds[k].reach[there] ** 2
        total[own] += w[:, None] * transform(inverse(one.T_world_shape), clouds[k].points[there])
        weight[own] += w
        counts[own] += 1
        reach[own] += clouds[k].reach[there]
        seen[own, n] = True
    kept = seen.sum(axis=1) >= max(RULES.least_frames, RULES.least_share * seen.shape[1])
    near = RULES.alike * RULES.gate * reach / np.maximum(counts, 1)
    kept &= only_once(shape.points, counts, near)
    middle = total[kept] / weight[kept, None]
    return Shape(middle, _reach_of(reach[kept] / counts[kept], counts[kept])), kept


def only_once(points: Floats, counts: Floats | Indices, near: Floats) -> Mask:
    """Which points (N,) are not beside one that is seen more often: that is the same one."""
    kept = np.ones(len(points), dtype=np.bool_)
    for k in np.argsort(-counts, kind="stable"):
        if kept[k]:
            beside = np.linalg.norm(points - points[k], axis=1) < near[k]
            kept[beside] = False
            kept[k] = True
    return kept


def _reach_of(reach: Floats, counts: Floats) -> Floats:
    return np.asarray(reach * np.maximum(1 / np.sqrt(counts), _SURER))


def _with_hidden(shape: Shape, places: Places, clouds: Sequence[Cloud]) -> Shape:
    """The shape with points that are at one place of it at many poses."""
    points, reach, frame = [np.zeros((0, 3))], [np.zeros(0)], [np.zeros(0, dtype=np.intp)]
    number, different = _poses_apart(shape, places, clouds)
    for n, (k, one) in zip(number.tolist(), places, strict=True):
        free = clouds[k].without(clouds[k].detections[one.there])
        own = transform(inverse(one.T_world_shape), free.points)
        points.append(own)
        reach.append(RULES.gate * free.reach * _lever(shape, own, one.count))
        frame.append(np.full(len(own), n))
    least = max(RULES.least_frames, RULES.least_share * different)
    reaches = np.concatenate(reach)
    more = gathered_places(np.concatenate(points), reaches, np.concatenate(frame), least)
    if not more:
        return shape
    added = np.array([np.median(reaches[there]) / RULES.gate for _, there in more])
    counts = np.array([len(there) for _, there in more], dtype=np.float64)
    return Shape(
        np.concatenate([shape.points, [place for place, _ in more]]),
        np.concatenate([shape.reach, _reach_of(added, counts)]),
    )


def _lever(shape: Shape, points: Floats, met: int) -> Floats:
    """By how much errors of a pose make points (n, 3) err more than by themselves."""
    middle = shape.points.mean(axis=0)
    radius = np.sqrt(((shape.points - middle) ** 2).sum(axis=1).mean())
    away = np.linalg.norm(points - middle, axis=1) / radius
    return np.asarray(np.sqrt(1 + (1 + away**2) / met))
