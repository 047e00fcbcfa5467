"""Find motions after which a body looks the same or nearly so, or looks like another body.

Coordinates alone tell: congruent parts of two bodies; all motions that put features of a body near
features of its own or of another body (a step of a grid, a turn of a square), by triples as in
`symmetry`; the other tilt of a flat body along a line of sight; and the mirror image.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from itertools import chain, combinations
from typing import TypeAlias

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

from mixpose.body.features import PointFeature
from mixpose.body.model import Body
from mixpose.body.symmetry import SAME_NORMAL, congruent_triples, motions, widest_triple
from mixpose.records import Floats, Indices, Mask
from mixpose.rigid import from_parts, rotation_angle_deg, transform

ASIDE = "the body explains as much a step of its grid aside"
TURNED = "the body explains as much turned by"

Pairs: TypeAlias = tuple[tuple[int, ...], tuple[int, ...]]

FEWEST = 3
"""Number of features that fix a motion."""

LOST = 0.15
"""Share of features that may lack a partner: a step of a grid of 7 by 7 leaves 1/7 without."""

_TOGETHER = 8  # features per batch in which motions are tested


@dataclass(frozen=True, eq=False)
class LookAlike:
    """Features of a body that are arranged like features of another body, or of the same."""

    body: Body
    other: Body
    # (4, 4) The motion of the other body's features onto the body's: if the body is at T, those of
    # the other at T @ T_body_other are in the same places.
    T_body_other: Floats
    features: tuple[int, ...]  # of the body, ascending
    partners: tuple[int, ...]  # of the other body, in the order of the features
    off: float  # largest distance between a feature and its partner, length units

    @property
    def turn_deg(self) -> float:
        """Angle between the orientations of the two bodies."""
        return float(rotation_angle_deg(self.T_body_other, np.eye(4)))

    @cached_property
    def is_step(self) -> bool:
        """Whether the motion shifts all features by the same step, to a tenth of its length."""
        points = self.body.means[list(self.features)]
        moved = transform(self.T_body_other, points) - points
        step = moved.mean(axis=0)
        return bool(np.abs(moved - step).max() < 0.1 * np.linalg.norm(step))

    @property
    def reason(self) -> str:
        """Explanation, in words, of what may be taken for the body."""
        if self.other is not self.body:
            return f"what is met lies like features of {self.other.name!r}"
        return ASIDE if self.is_step else f"{TURNED} {self.turn_deg:.0f} deg"


def tolerance_of(body: Body, other: Body, share: float) -> float:
    """Return the largest distance of partners: a share of the smaller radius, or the larger spread.

    The share gives a quarter of the distance of neighbours at most, lest these become partners.
    """
    least = max(body.spread, other.spread)
    return max(least, min(share * min(body.radius, other.radius), _spacing(other) / 4))


@lru_cache(maxsize=4096)
def like_features(
    body: Body, features: frozenset[int], other: Body, tolerance: float, fewest: int = FEWEST + 1
) -> tuple[LookAlike, ...]:
    """Find all motions that put features of a body on features of another body, or of itself.

    Of the features, such as those met in a frame, all but one or 15 % need a partner within the
    tolerance, and at least `fewest`: by default one more than fix a motion.  Symmetries of the body
    are excluded; normals of partners have to agree within 8°.
    """
    chosen = np.array(sorted(features), dtype=np.intp)
    points, targets = body.means[chosen], other.means
    parts: dict[Pairs, LookAlike] = {}
    least = min(len(points), max(len(points) - max(1, int(LOST * len(points))), fewest))
    for base in _bases(points, tolerance, fewest):
        triples = congruent_triples(points[base], targets, 2 * tolerance)
        T = motions(points[base], targets[triples])
        for part in _confirmed(body, chosen, other, T, tolerance, least):
            pairs = _modulo_symmetry(other, part)
            known = parts.get(pairs)
            if known is None or part.turn_deg < known.turn_deg:
                parts[pairs] = part
    if body is other:
        for part in _grid_steps(body, chosen, tolerance):
            parts.setdefault(_modulo_symmetry(body, part), part)
        parts = {pairs: part for pairs, part in parts.items() if not _is_symmetry(part)}
    return tuple(parts.values())


@lru_cache(maxsize=256)
def congruent_parts(body: Body, other: Body, tolerance: float) -> tuple[LookAlike, ...]:
    """Find the largest congruent parts of two bodies, and sort them by their largest distance.

    Parts have three features or more that are not on a line.  The identity of one body is excluded.
    Only the first 60 features are compared: triples of more take minutes.
    """
    points, targets = body.means[:60], other.means[:60]
    parts: dict[Pairs, LookAlike] = {}
    most, partners = 0, np.full((0, len(points)), -1)  # partners, a row per part
    # the widest triple fixes motions of the whole body most accurately
    first = [widest_triple(points)] if len(points) >= FEWEST else []
    for triple in chain(first, combinations(range(len(points)), FEWEST)):
        base = list(triple)
        if _is_narrow(points[base], tolerance):
            continue
        images = congruent_triples(points[base], targets, 2 * tolerance)
        if body is other:
            images = images[(images != base).any(axis=1)]
        images = images[~_are_among(images, partners[:, base])]
        while len(images):
            part = _extended(body, other, base, images[0], tolerance)
            images = images[1:]
            if part is None:
                continue
            row = np.full((1, len(points)), -1)
            row[0, list(part.features)] = part.partners
            partners = np.concatenate([partners, row])
            images = images[~_are_among(images, row[:, base])]
            if len(part.features) > most:
                most, parts = len(part.features), {}
            if len(part.features) == most:
                parts[part.features, part.partners] = part
        if most == len(points):  # all parts of this size contain this triple
            break
    return tuple(sorted(parts.values(), key=lambda part: part.off))


def other_tilt(
    body: Body, features: frozenset[int], T_world_object: Floats, towards: Floats
) -> Floats:
    """Return the pose (4, 4) of flat features tilted the other way, seen along a direction (3,).

    Depths about the centroid change sign, which changes the image only by perspective.
    """
    points = body.means[sorted(features)]
    centre = points.mean(axis=0)
    R, v = T_world_object[:3, :3], towards / np.linalg.norm(towards)
    n = np.linalg.svd(points - centre, full_matrices=False)[2][2]
    # two reflections make a rotation: in the plane of the features, which keeps them, and in depth
    R_tilted = (np.eye(3) - 2 * np.outer(v, v)) @ R @ (np.eye(3) - 2 * np.outer(n, n))
    return from_parts(R_tilted, T_world_object[:3, 3] + (R - R_tilted) @ centre)


@lru_cache(maxsize=1024)
def thickness(body: Body, features: frozenset[int] | None = None) -> float:
    """Return the extent of features across their plane over the shorter one in it; 0 if flat."""
    points = body.means if features is None else body.means[sorted(features)]
    extents = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    if len(extents) < 3 or extents[1] <= len(points) * np.finfo(np.float64).eps * extents[0]:
        return 0.0
    return float(extents[2] / extents[1])


def reflection(points: Floats) -> Floats:
    """Return the reflection (4, 4) in the plane nearest to points (N, 3)."""
    centre = points.mean(axis=0)
    normal = np.linalg.svd(points - centre)[2][-1]
    R = np.eye(3) - 2 * np.outer(normal, normal)
    return from_parts(R, centre - R @ centre)


@lru_cache(maxsize=64)
def mirror_image(body: Body, near: frozenset[int]) -> Body:
    """Reflect a body in the plane nearest to the given features."""
    T, outward = reflection(body.means[sorted(near)]), body.normals
    if outward is not None:
        outward = outward @ T[:3, :3]
    return of_points(body, transform(T, body.means), outward)


@lru_cache(maxsize=64)
def of_size(body: Body, factor: float) -> Body:
    """Scale the points and radii of a body by a factor."""
    larger = of_points(body, factor * body.means, body.normals)
    return larger if body.radii is None else replace(larger, radii=factor * body.radii)


def of_points(body: Body, points: Floats, normals: Floats | None) -> Body:
    """Replace the features of a body by points, and its normals."""
    return replace(body, features=tuple(PointFeature(point) for point in points), normals=normals)


@lru_cache(maxsize=256)
def _spacing(body: Body) -> float:
    """Return the smallest distance between two features."""
    distances = cdist(body.means, body.means)
    np.fill_diagonal(distances, np.inf)
    return float(distances.min())


@lru_cache(maxsize=256)
def _tree(body: Body) -> cKDTree:
    """Return a search tree of the features."""
    return cKDTree(body.means)


def _bases(points: Floats, tolerance: float, fewest: int) -> list[list[int]]:
    """Select wide triples of points (n, 3) such that no point is part of all, if there are enough.

    Triples on a line are left out; if the widest is on a line, there are none.
    """
    if len(points) < FEWEST:
        return []
    first = list(widest_triple(points))
    if _is_narrow(points[first], tolerance):
        return []
    parts = [np.delete(np.arange(len(points)), k) for k in first if len(points) > fewest]
    # after a step of a grid, points at an edge have no partners, those in the middle do
    distances = np.linalg.norm(points - points.mean(axis=0), axis=1)
    middle = distances.argsort(kind="stable")[: len(points) // 2]
    parts += [middle] if len(middle) > FEWEST else []
    others = [part[list(widest_triple(points[part]))].tolist() for part in parts]
    return [first, *(base for base in others if not _is_narrow(points[base], tolerance))]


def _is_narrow(points: Floats, tolerance: float) -> bool:
    """Test whether points (n, 3) lie on a line, within twice the tolerance."""
    extents = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return bool(extents[1] <= 2 * tolerance)


def _confirmed(
    body: Body, chosen: Indices, other: Body, T_other_body: Floats, tolerance: float, least: int
) -> Iterable[LookAlike]:
    """Yield the look-alikes by motions (K, 4, 4) that give enough chosen features a partner."""
    T, lacking = T_other_body, np.zeros(len(T_other_body), dtype=np.intp)
    tried: list[tuple[Indices, Mask]] = []
    # in random order: a wrong motion soon leaves too many of a mixed batch without partners
    chosen = np.random.default_rng(0).permutation(chosen)
    for first in range(0, len(chosen), _TOGETHER):
        selected = chosen[first : first + _TOGETHER]
        tried.append(_partners(body, selected, other, T, 2 * tolerance))
        lacking = lacking + (~tried[-1][1]).sum(axis=1)
        alive = lacking <= min(len(chosen) - least, 2 * LOST * (first + _TOGETHER))
        T, lacking = T[alive], lacking[alive]
        tried = [(partners[alive], near[alive]) for partners, near in tried]
    order = chosen.argsort()
    chosen = chosen[order]
    partners, near = (np.concatenate(sets, axis=1)[:, order] for sets in zip(*tried, strict=True))
    for nearest, keep in zip(partners, near, strict=True):
        # tested again after a fit to all pairs, which is more accurate than one to three
        part = _fitted(body, other, chosen[keep], nearest[keep])
        if part.off <= tolerance and len(set(part.partners)) >= least:
            yield part


def _grid_steps(body: Body, chosen: Indices, tolerance: float) -> Iterable[LookAlike]:
    """Yield grid steps that keep over half of the features; few steps of small grids keep more."""
    steps = np.tile(np.eye(4), (len(body.grid_steps), 1, 1))
    steps[:, :3, 3] = body.grid_steps
    for nearest, near in zip(*_partners(body, chosen, body, steps, 2 * tolerance), strict=True):
        if np.count_nonzero(near) > max(len(chosen) // 2, FEWEST):
            part = _fitted(body, body, chosen[near], nearest[near])
            if part.off <= tolerance:
                yield part


def _partners(
    body: Body, chosen: Indices, other: Body, T_other_body: Floats, reach: float
) -> tuple[Indices, Mask]:
    """Return nearest partners (K, n) of features moved by (K, 4, 4), and a mask of valid ones."""
    moved = transform(T_other_body, body.means[chosen])
    distances, partners = _tree(other).query(moved, distance_upper_bound=reach)
    near = np.isfinite(distances)
    partners[~near] = 0
    if body.normals is not None and other.normals is not None:
        turned = _unit(body.normals[chosen]) @ np.swapaxes(T_other_body[:, :3, :3], 1, 2)
        near &= (turned * _unit(other.normals)[partners]).sum(axis=2) > SAME_NORMAL
    return partners, near


def _fitted(body: Body, other: Body, features: Indices, partners: Indices) -> LookAlike:
    """Fit the motion of the partners onto the features."""
    points, targets = body.means[features], other.means[partners]
    T = motions(targets, points[None])[0]
    off = float(np.linalg.norm(points - transform(T, targets), axis=1).max())
    return LookAlike(body, other, T, tuple(features.tolist()), tuple(partners.tolist()), off)


def _extended(
    body: Body, other: Body, base: Sequence[int], image: Indices, tolerance: float
) -> LookAlike | None:
    """Extend a triple to all pairs that fit its motion; None if the triple itself does not fit."""
    points, targets = body.means[:60], other.means[:60]
    part = _fitted(body, other, np.array(base), image)
    if part.off > tolerance:
        return None
    distances = cdist(points, transform(part.T_body_other, targets))
    partners = distances.argmin(axis=1)
    mutual = distances.argmin(axis=0)[partners] == np.arange(len(points))
    near = mutual & (distances.min(axis=1) <= tolerance)
    if near.sum() < FEWEST:
        return None
    return _fitted(body, other, np.flatnonzero(near), partners[near])


def _are_among(triples: Indices, known: Indices) -> Mask:
    """Test which of triples (K, 3) of feature numbers are among known ones (F, 3)."""
    base = np.array([1_000_000, 1000, 1])
    return np.isin(triples @ base, (known @ base)[(known >= 0).all(axis=1)])


def _modulo_symmetry(other: Body, part: LookAlike) -> Pairs:
    """Return pairs of a part, equal for motions that differ by a symmetry of the other body."""
    images = _permutations(other)[:, list(part.partners)].tolist()
    return part.features, tuple(min(images))


def _is_symmetry(part: LookAlike) -> bool:
    """Test whether the motion of a part is one of the symmetries of its body."""
    images = _permutations(part.body)[:, list(part.features)]
    return bool((images == part.partners).all(axis=1).any())


@lru_cache(maxsize=256)
def _permutations(body: Body) -> Indices:
    """Return the feature (G, N) on which a symmetry puts a feature."""
    return np.array([cdist(moved, body.means).argmin(axis=1)
                     for moved in transform(body.symmetries, body.means)])  # fmt: skip


def _unit(vectors: Floats) -> Floats:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))
