"""Where a shape, a few points at known distances, is found in the cloud of a frame."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from mixpose.body.symmetry import congruent_triples, motions
from mixpose.learning.points import Cloud
from mixpose.learning.rules import LearningRules
from mixpose.records import Floats, Indices
from mixpose.rigid import from_parts, transform

FEWEST = 3
_HEIGHT = 4.0  # deviations of a point above the longest side: less fixes no turn
_REFINED = 3  # fits to all that is met, of which later ones reach farther from the first three


@dataclass(frozen=True, eq=False)
class Shape:
    """Points of a body, as far as it is known."""

    points: Floats  # (N, 3)
    reach: Floats  # (N,): standard deviation of each, as of `Cloud`

    def __len__(self) -> int:
        return len(self.points)

    def only(self, chosen: Indices) -> Shape:
        """Some of the points."""
        return Shape(self.points[chosen], self.reach[chosen])


@dataclass(frozen=True, eq=False)
class Placement:
    """Where a shape is in a frame."""

    T_world_shape: Floats  # (4, 4)
    met: Indices  # (N,): the point of the cloud that each point of the shape is; -1 for none
    off: float  # root mean square distance of the two, by what they may be off

    @property
    def count(self) -> int:
        """How many points are met."""
        return int((self.met >= 0).sum())


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
    shape: Shape,
    bases: Indices,
    cloud: Cloud,
    rules: LearningRules,
    most: int,
    least: int = FEWEST,
) -> list[Placement]:
    """Placements of a shape in a cloud, of which no two have a point in common; the best first.

    Parameters
    ----------
    bases : (B, 3) int
        Triples of it that are looked for.
    most : int
        Placements that are wanted.
    least : int
        Points that must be met.
    """
    if len(cloud) < least or not len(bases):
        return []
    typical = np.hypot(np.median(cloud.reach), np.median(shape.reach))
    candidates = []
    for base in bases:
        triples = congruent_triples(
            shape.points[base], cloud.points, rules.gate * np.sqrt(2.0) * typical
        )
        candidates.append(motions(shape.points[base], cloud.points[triples]))
    poses = np.concatenate(candidates)
    if not len(poses):
        return []
    tree = cKDTree(cloud.points)
    away, nearest = tree.query(transform(poses, shape.points))
    allowed = rules.gate * np.hypot(cloud.reach[nearest], shape.reach)
    counts = (away < 2 * allowed).sum(axis=1) - 0.1 * np.minimum(away / allowed, 2).mean(axis=1)
    order = np.argsort(-counts, kind="stable")[: rules.placements * most]
    refined = list[Placement]()
    for k in order:
        # most triples of a shape lead to the one place where it is; triangles fit in many ways
        alone = most == 1 and len(shape) > FEWEST and refined
        if alone and max(each.count for each in refined) >= counts[k]:
            break
        refined.append(_refined(shape, poses[k], cloud, tree, rules))
    good = [each for each in refined if each.count >= least]
    good.sort(key=lambda each: (-each.count, each.off))
    kept, taken = list[Placement](), set[int]()
    for each in good:
        own = set(each.met[each.met >= 0].tolist())
        if not own & taken:
            kept.append(each)
            taken |= own
        if len(kept) == most:
            break
    return kept


def _refined(
    shape: Shape, T: Floats, cloud: Cloud, tree: cKDTree, rules: LearningRules
) -> Placement:
    """Fit a pose to all points that it meets."""
    met, off = np.full(len(shape), -1), np.inf
    for turn in range(_REFINED + 1):
        met, off = meetings(shape, T, cloud, tree, rules, 2.0 if turn < _REFINED - 1 else 1.0)
        own = np.flatnonzero(met >= 0)
        if len(own) < FEWEST or turn == _REFINED:
            break
        T = weighted_motion(shape.points[own], cloud.points[met[own]], cloud.reach[met[own]])
    return Placement(T, met, off)


def meetings(
    shape: Shape, T: Floats, cloud: Cloud, tree: cKDTree, rules: LearningRules, wide: float
) -> tuple[Indices, float]:
    """Which point of a cloud each point of a shape (N,) is at a pose, one to one; and the RMS."""
    away, nearest = tree.query(transform(T, shape.points))
    share = away / (rules.gate * wide * np.hypot(cloud.reach[nearest], shape.reach))
    met = np.full(len(shape), -1, dtype=np.intp)
    taken = set[int]()
    for k in np.argsort(share, kind="stable"):
        if share[k] < 1 and int(nearest[k]) not in taken:
            met[k] = nearest[k]
            taken.add(int(nearest[k]))
    found = met >= 0
    off = float(np.sqrt(np.mean(share[found] ** 2))) if found.any() else np.inf
    return met, off


def weighted_motion(source: Floats, target: Floats, reach: Floats) -> Floats:
    """The motion (4, 4) of points (n, 3) onto others, those that are known better counting more."""
    weight = 1 / reach**2
    weight = weight / weight.sum()
    a, b = weight @ source, weight @ target
    turn, _ = Rotation.align_vectors(target - b, source - a, weights=weight)
    R = turn.as_matrix()
    return from_parts(R, b - R @ a)


def apart(points: Floats, far: float) -> Indices:
    """Which of the poses that put a shape to points (K, N, 3) are new (K,): numbers from 0.

    Poses in which no point of the shape is farther away than `far` from where an earlier pose has
    it have the number of that.
    """
    number = np.full(len(points), -1, dtype=np.intp)
    count = 0
    for k in range(len(points)):
        if number[k] < 0:
            away = np.abs(points - points[k]).max(axis=(1, 2), initial=0.0)
            number[(number < 0) & (away <= far)] = count
            count += 1
    return number
