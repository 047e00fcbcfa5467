"""Where a shape, a few points at known distances, is found in the cloud of a frame."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import combinations

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from mixpose.body import Body, PointFeature
from mixpose.body.symmetry import congruent_triples, motions
from mixpose.learning.points import Cloud
from mixpose.learning.rules import RULES
from mixpose.records import Floats, Indices
from mixpose.rigid import from_parts, transform

FEWEST = 3
_HEIGHT = 4.0  # deviations of a point above the longest side: less fixes no turn
# gates within which points are met before and after each fit to all that is met; later fits reach
# farther from the first three
_WIDE = (2.0, 2.0, 1.0, 1.0)


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
