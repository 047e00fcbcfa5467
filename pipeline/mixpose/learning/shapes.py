"""Shapes, a few points at known distances: find them in frames, and grow them to bodies.

Only frames at different poses show what belongs to a body: at one pose, anything at rest near it
seems to.
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
_HEIGHT = 4.0  # deviations: least height of a triangle above its longest side that fixes its turn
# gates within which points are met before and after each fit to the points met; the first fits
# extrapolate from three points
_WIDE = (2.0, 2.0, 1.0, 1.0)
_COMMON = 0.15  # of a point's deviation: errors that many frames have in common


@dataclass(frozen=True, eq=False)
class Shape:
    """Points of a body, as far as they are known."""

    points: Floats  # (N, 3)
    sigma: Floats  # (N,): standard deviations, as those of `Cloud`

    def __len__(self) -> int:
        return len(self.points)

    def part(self, chosen: Mask) -> Shape:
        """Return the shape of the chosen points (N,)."""
        return Shape(self.points[chosen], self.sigma[chosen])


@dataclass(frozen=True, eq=False)
class Placement:
    """The pose of a shape in the cloud of a frame, and the points that it meets."""

    T_world_shape: Floats  # (4, 4)
    met: Indices  # (N,): for each point of the shape its point of the cloud; -1 for none
    misfit: float  # root mean square distance of these pairs, in gates

    @cached_property
    def shape_rows(self) -> Indices:
        """Indices (n,) of the points of the shape that are met."""
        return np.flatnonzero(self.met >= 0)

    @cached_property
    def cloud_rows(self) -> Indices:
        """Indices (n,) of the points of the cloud that they meet."""
        return self.met[self.shape_rows]

    @property
    def count(self) -> int:
        """Number of points met."""
        return len(self.shape_rows)


Placements: TypeAlias = Sequence[tuple[int, Placement]]
"""Placements with the index of the cloud that each is in."""


def body_of(name: str, points: Floats) -> Body:
    """Return a body of points without spread."""
    return Body(name, tuple(PointFeature(point) for point in points))


def triples_of(points: Floats, sigma: Floats) -> Indices:
    """Return triples (K, 3) of points (N, 3) that are not on a line, the largest heights first."""
    triples = np.array(list(combinations(range(len(points)), FEWEST)), dtype=np.intp)
    if not len(triples):
        return np.zeros((0, FEWEST), dtype=np.intp)
    a, b, c = np.moveaxis(points[triples], 1, 0)
    longest = np.linalg.norm(np.array([b - a, c - a, c - b]), axis=2).max(axis=0)
    height = np.linalg.norm(np.cross(b - a, c - a), axis=1) / np.maximum(longest, 1e-300)
    order = np.argsort(-height, kind="stable")
    return np.asarray(triples[order][(height > _HEIGHT * sigma[triples].max(axis=1))[order]])


def wide_triples(points: Floats, sigma: Floats, most: int) -> Indices:
    """Select up to `most` of these triples (K, 3), in which all points are used about equally."""
    triples = triples_of(points, sigma)
    chosen, uses = list[int](), np.zeros(len(points))
    is_unused = np.ones(len(triples), dtype=np.bool_)
    while is_unused.any() and len(chosen) < most:
        k = int(np.argmin(np.where(is_unused, uses[triples].sum(axis=1), np.inf)))
        uses[triples[k]] += 1
        is_unused[k] = False
        chosen.append(k)
    return np.asarray(triples[chosen])


def placements_in(
    shape: Shape, bases: Indices, cloud: Cloud, most: int, least: int
) -> list[Placement]:
    """Find placements of a shape in a cloud that have no point in common; the best first.

    They are at most `most`, from the triples (B, 3) of the shape that are tried, and each has at
    least `least` points met.
    """
    if len(cloud) < least or not len(bases):
        return []
    typical = np.hypot(np.median(cloud.sigma), np.median(shape.sigma))
    tolerance, candidates = RULES.gate * np.sqrt(2.0) * typical, []
    for base in shape.points[bases]:
        triples = congruent_triples(base, cloud.points, tolerance)
        candidates.append(motions(base, cloud.points[triples]))
    poses = np.concatenate(candidates)
    if not len(poses):
        return []
    tree = cKDTree(cloud.points)
    gaps, nearest = tree.query(transform(poses, shape.points))
    allowed = RULES.gate * np.hypot(cloud.sigma[nearest], shape.sigma)
    counts = (gaps < 2 * allowed).sum(axis=1) - 0.1 * np.minimum(gaps / allowed, 2).mean(axis=1)
    order = np.argsort(-counts, kind="stable")[: RULES.placements * most]
    refined = list[Placement]()
    for k in order:
        # most triples of a shape lead to its true pose; mere triangles fit in many places
        is_unique = most == 1 and len(shape) > FEWEST and refined
        if is_unique and max(placement.count for placement in refined) >= counts[k]:
            break
        refined.append(_refined(shape, poses[k], cloud, tree))
    valid = [placement for placement in refined if placement.count >= least]
    valid.sort(key=lambda placement: (-placement.count, placement.misfit))
    chosen, taken = list[Placement](), set[int]()
    for placement in valid:
        rows = set(placement.cloud_rows.tolist())
        if not rows & taken:
            chosen.append(placement)
            taken |= rows
        if len(chosen) == most:
            break
    return chosen


def _refined(shape: Shape, T: Floats, cloud: Cloud, tree: cKDTree) -> Placement:
    """Fit a pose to all points that it meets, repeatedly."""
    placement = _placement(shape, T, cloud, tree, _WIDE[0])
    for wide in _WIDE[1:]:
        if placement.count < FEWEST:
            break
        rows, source = placement.cloud_rows, shape.points[placement.shape_rows]
        T = _weighted_motion(source, cloud.points[rows], cloud.sigma[rows])
        placement = _placement(shape, T, cloud, tree, wide)
    return placement


def _placement(shape: Shape, T: Floats, cloud: Cloud, tree: cKDTree, wide: float) -> Placement:
    """Pair points of a shape at a pose with the nearest points of a cloud, one to one."""
    distance, nearest = tree.query(transform(T, shape.points))
    share = distance / (RULES.gate * wide * np.hypot(cloud.sigma[nearest], shape.sigma))
    met = np.full(len(shape), -1, dtype=np.intp)
    order = np.argsort(share, kind="stable")
    order = order[share[order] < 1]
    _, first = np.unique(nearest[order], return_index=True)
    rows = np.sort(order[first])
    met[rows] = nearest[rows]
    misfit = float(np.sqrt(np.mean(share[rows] ** 2))) if len(rows) else np.inf
    return Placement(T, met, misfit)


def _weighted_motion(source: Floats, target: Floats, sigma: Floats) -> Floats:
    """Fit the motion (4, 4) of points (n, 3) onto others with standard deviations (n,)."""
    weight = 1 / sigma**2
    weight = weight / weight.sum()
    a, b = weight @ source, weight @ target
    turn, _ = Rotation.align_vectors(target - b, source - a, weights=weight)
    R = turn.as_matrix()
    return from_parts(R, b - R @ a)


@dataclass(frozen=True, eq=False)
class PlacedBody:
    """A body with its placements."""

    shape: Shape  # in arbitrary axes
    placements: tuple[tuple[int, Placement], ...]  # several in a cloud for congruent bodies
    count: int = 1  # congruent bodies that are seen at the same time
    looseness: float = 1.0  # times the error of triangulation: allowed offsets of its points

    @property
    def met_count(self) -> int:
        """Number of points met in all frames together."""
        return sum(placement.count for _, placement in self.placements)


def least_met(points: int) -> int:
    """Return how many points of a shape must be met so that it is not there by chance."""
    return FEWEST if points <= FEWEST + 1 else FEWEST + 1


def find_placements(
    shape: Shape,
    clouds: Sequence[Cloud],
    most: int = 1,
    least: int | None = None,
    bases: int | None = None,
) -> list[tuple[int, Placement]]:
    """Find a shape in all clouds, at most `most` times in each."""
    triples = wide_triples(shape.points, shape.sigma, bases or RULES.bases)
    least = least_met(len(shape)) if least is None else least
    return [
        (k, placement)
        for k, cloud in enumerate(clouds)
        for placement in placements_in(shape, triples, cloud, most, least)
    ]


def grow_body(shape: Shape, clouds: Sequence[Cloud]) -> PlacedBody | None:
    """Find a shape in all frames and add points that move along; None if it does not recur."""
    for n in range(RULES.rounds):
        placements = find_placements(shape, clouds)
        if len(placements) < RULES.least_frames:
            return None
        shape, _ = averaged(shape, placements, clouds)
        if len(shape) < FEWEST:
            return None
        if n + 1 == RULES.rounds:
            break
        before = len(shape)
        shape = _with_further_points(shape, placements, clouds)
        if len(shape) == before and n:
            break
    if not len(wide_triples(shape.points, shape.sigma, 1)):
        return None
    placements = find_placements(shape, clouds)
    _, different = _pose_ids(shape, placements, clouds)
    return PlacedBody(shape, tuple(placements)) if different >= RULES.least_frames else None


def usual_sigma(placements: Placements, clouds: Sequence[Cloud]) -> float:
    """Return the median over placements of the mean standard deviation of the points met."""
    return float(np.median([clouds[k].sigma[p.cloud_rows].mean() for k, p in placements]))


def _pose_ids(shape: Shape, placements: Placements, clouds: Sequence[Cloud]) -> tuple[Indices, int]:
    """Number the different poses of placements (K,), equal if no point is far away; count them."""
    if not placements:
        return np.zeros(0, dtype=np.intp), 0
    points = transform(np.array([p.T_world_shape for _, p in placements]), shape.points)
    far = RULES.apart * RULES.gate * usual_sigma(placements, clouds)
    number, count = np.full(len(points), -1, dtype=np.intp), 0
    for k in range(len(points)):
        if number[k] < 0:
            distance = np.abs(points - points[k]).max(axis=(1, 2), initial=0.0)
            number[(number < 0) & (distance <= far)] = count
            count += 1
    return number, count


def averaged(shape: Shape, placements: Placements, clouds: Sequence[Cloud]) -> tuple[Shape, Mask]:
    """Average a shape without rarely seen points and duplicates; also return which points stay."""
    weight, total = np.zeros(len(shape)), np.zeros((len(shape), 3))
    counts, sigma = np.zeros(len(shape)), np.zeros(len(shape))
    number, different = _pose_ids(shape, placements, clouds)
    is_seen = np.zeros((len(shape), different), dtype=np.bool_)
    for n, (k, placement) in zip(number.tolist(), placements, strict=True):
        rows, cloud_rows = placement.shape_rows, placement.cloud_rows
        in_shape = transform(inverse(placement.T_world_shape), clouds[k].points[cloud_rows])
        information = 1 / clouds[k].sigma[cloud_rows] ** 2
        total[rows] += information[:, None] * in_shape
        weight[rows] += information
        counts[rows] += 1
        sigma[rows] += clouds[k].sigma[cloud_rows]
        is_seen[rows, n] = True
    is_kept = is_seen.sum(axis=1) >= max(RULES.least_frames, RULES.least_share * is_seen.shape[1])
    near = RULES.alike * RULES.gate * sigma / np.maximum(counts, 1)
    is_kept &= are_unique(shape.points, counts, near)
    mean = total[is_kept] / weight[is_kept, None]
    return Shape(mean, _averaged_sigma(sigma[is_kept] / counts[is_kept], counts[is_kept])), is_kept


def are_unique(points: Floats, counts: Floats | Indices, near: Floats) -> Mask:
    """Test which points (N,) are not within the distance `near` of a point with more counts."""
    is_kept = np.ones(len(points), dtype=np.bool_)
    for k in np.argsort(-counts, kind="stable"):
        if is_kept[k]:
            is_near = np.linalg.norm(points - points[k], axis=1) < near[k]
            is_kept[is_near] = False
            is_kept[k] = True
    return is_kept


def _averaged_sigma(sigma: Floats, counts: Floats) -> Floats:
    """Return the standard deviations of means over `counts` frames."""
    return np.asarray(sigma * np.maximum(1 / np.sqrt(counts), _COMMON))


def _with_further_points(shape: Shape, placements: Placements, clouds: Sequence[Cloud]) -> Shape:
    """Return the shape with further points that are at one place of it at many poses."""
    points, radius, pose_number = [np.zeros((0, 3))], [np.zeros(0)], [np.zeros(0, dtype=np.intp)]
    number, different = _pose_ids(shape, placements, clouds)
    for n, (k, placement) in zip(number.tolist(), placements, strict=True):
        unclaimed = clouds[k].without(clouds[k].detections[placement.cloud_rows])
        in_shape = transform(inverse(placement.T_world_shape), unclaimed.points)
        points.append(in_shape)
        radius.append(RULES.gate * unclaimed.sigma * _lever(shape, in_shape, placement.count))
        pose_number.append(np.full(len(in_shape), n))
    least = max(RULES.least_frames, RULES.least_share * different)
    radii = np.concatenate(radius)
    gathered = gathered_places(np.concatenate(points), radii, np.concatenate(pose_number), least)
    if not gathered:
        return shape
    added = np.array([np.median(radii[rows]) / RULES.gate for _, rows in gathered])
    counts = np.array([len(rows) for _, rows in gathered], dtype=np.float64)
    all_points = np.concatenate([shape.points, [place for place, _ in gathered]])
    return Shape(all_points, np.concatenate([shape.sigma, _averaged_sigma(added, counts)]))


def _lever(shape: Shape, points: Floats, met: int) -> Floats:
    """Return the factors by which errors of a pose enlarge those of points (n, 3)."""
    mean = shape.points.mean(axis=0)
    radius = np.sqrt(((shape.points - mean) ** 2).sum(axis=1).mean())
    distance = np.linalg.norm(points - mean, axis=1) / radius
    return np.asarray(np.sqrt(1 + (1 + distance**2) / met))
