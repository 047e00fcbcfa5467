"""Motions of a body, or onto another body, under which it looks the same or nearly so.

Found from coordinates alone: parts of two bodies that are congruent, all ways in which some of a
body's features lie like others of it or of another body (a step of a grid, a turn of a square), by
triples as in `symmetry`, the other tilt of a flat body along a line of sight, and the mirror image.
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
"""Features that fix a motion."""

LOST = 0.15
"""Share of features that may be without a partner: a step of a grid of 7 by 7 takes 1/7 away."""

_TOGETHER = 8  # features that motions are tried with at a time


@dataclass(frozen=True, eq=False)
class LookAlike:
    """Features of a body that lie like features of another, or like others of its own."""

    body: Body
    other: Body
    # (4, 4) The motion that puts the other's features on the body's: with the body at T, the other
    # at T @ T_body_other has them in the same places.
    T_body_other: Floats
    features: tuple[int, ...]  # of the body, ascending
    partners: tuple[int, ...]  # of the other, pair by pair
    off: float  # the largest distance of a pair, length units

    @property
    def turn_deg(self) -> float:
        """Angle by which the other is turned against the body."""
        return float(rotation_angle_deg(self.T_body_other, np.eye(4)))

    @cached_property
    def is_step(self) -> bool:
        """Whether features are shifted, by far the most of the way the same for all of them."""
        points = self.body.means[list(self.features)]
        moved = transform(self.T_body_other, points) - points
        step = moved.mean(axis=0)
        return bool(np.abs(moved - step).max() < 0.1 * np.linalg.norm(step))

    @property
    def reason(self) -> str:
        """In words: what else there may be in place of the body."""
        if self.other is not self.body:
            return f"what is met lies like features of {self.other.name!r}"
        return ASIDE if self.is_step else f"{TURNED} {self.turn_deg:.0f} deg"


def tolerance_of(body: Body, other: Body, share: float) -> float:
    """How far features may be off each other: a share of the smaller body's radius, or its spread.

    At most a quarter of the way between neighbours, whose partners would be mistaken.
    """
    least = max(body.spread, other.spread)
    return max(least, min(share * min(body.radius, other.radius), _spacing(other) / 4))


@lru_cache(maxsize=4096)
def like_features(
    body: Body, features: frozenset[int], other: Body, tolerance: float, fewest: int = FEWEST + 1
) -> tuple[LookAlike, ...]:
    """All motions under which features of a body lie like features of another, or of itself.

    All but one or a seventh of the features, such as those met in a frame, need a partner within
    the tolerance, but no fewer than the fewest: as a rule more than fix a motion.  The body's own
    symmetries are left out, and what turns a face away that was seen.
    """
    chosen = np.array(sorted(features), dtype=np.intp)
    points, targets = body.means[chosen], other.means
    found: dict[Pairs, LookAlike] = {}
    least = min(len(points), max(len(points) - max(1, int(LOST * len(points))), fewest))
    for base in _bases(points, tolerance, fewest):
        triples = congruent_triples(points[base], targets, 2 * tolerance)
        T = motions(points[base], targets[triples])
        for part in _kept(body, chosen, other, T, tolerance, least):
            pairs = _modulo_symmetry(other, part)
            known = found.get(pairs)
            if known is None or part.turn_deg < known.turn_deg:
                found[pairs] = part
    if body is other:
        for part in _a_step_aside(body, chosen, tolerance):
            found.setdefault(_modulo_symmetry(body, part), part)
        found = {pairs: part for pairs, part in found.items() if not _is_symmetry(part)}
    return tuple(found.values())


@lru_cache(maxsize=256)
def congruent_parts(body: Body, other: Body, tolerance: float) -> tuple[LookAlike, ...]:
    """The largest parts of two bodies that are congruent, the closest first.

    Parts have three features or more that are not on a line.  Of a body by itself the identity is
    left out.  At most 60 features of each are compared: triples of more take minutes.
    """
    points, targets = body.means[:60], other.means[:60]
    found: dict[Pairs, LookAlike] = {}
    most, partners = 0, np.full((0, len(points)), -1)  # of each part's features
    # the widest tells the motions of all of a body best
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
            part = _grown(body, other, base, images[0], tolerance)
            images = images[1:]
            if part is None:
                continue
            own = np.full((1, len(points)), -1)
            own[0, list(part.features)] = part.partners
            partners = np.concatenate([partners, own])
            images = images[~_are_among(images, own[:, base])]
            if len(part.features) > most:
                most, found = len(part.features), {}
            if len(part.features) == most:
                found[part.features, part.partners] = part
        if most == len(points):  # all others as large have this triple, too
            break
    return tuple(sorted(found.values(), key=lambda part: part.off))


def other_tilt(
    body: Body, features: frozenset[int], T_world_object: Floats, towards: Floats
) -> Floats:
    """The pose (4, 4) with flat features tilted the other way, as seen along a direction (3,).

    Depths about their middle change their sign, which changes its image by perspective alone.
    """
    points = body.means[sorted(features)]
    centre = points.mean(axis=0)
    R, v = T_world_object[:3, :3], towards / np.linalg.norm(towards)
    n = np.linalg.svd(points - centre, full_matrices=False)[2][2]
    # two mirrors make a turn: across their own plane, which leaves it alone, and in depth
    R_tilted = (np.eye(3) - 2 * np.outer(v, v)) @ R @ (np.eye(3) - 2 * np.outer(n, n))
    return from_parts(R_tilted, T_world_object[:3, 3] + (R - R_tilted) @ centre)


@lru_cache(maxsize=1024)
def thickness(body: Body, features: frozenset[int] | None = None) -> float:
    """Extent across the plane nearest to some features, by the shorter extent in it; 0 if flat."""
    points = body.means if features is None else body.means[sorted(features)]
    extents = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    if len(extents) < 3 or extents[1] <= len(points) * np.finfo(np.float64).eps * extents[0]:
        return 0.0
    return float(extents[2] / extents[1])


def reflection(points: Floats) -> Floats:
    """The reflection (4, 4) in the plane nearest to points (N, 3)."""
    centre = points.mean(axis=0)
    normal = np.linalg.svd(points - centre)[2][-1]
    R = np.eye(3) - 2 * np.outer(normal, normal)
    return from_parts(R, centre - R @ centre)


@lru_cache(maxsize=64)
def mirror_image(body: Body, near: frozenset[int]) -> Body:
    """The body reflected in the plane nearest to some of its features."""
    T, outward = reflection(body.means[sorted(near)]), body.normals
    if outward is not None:
        outward = outward @ T[:3, :3]
    return of_points(body, transform(T, body.means), outward)


@lru_cache(maxsize=64)
def of_size(body: Body, factor: float) -> Body:
    """A body whose points, and what is about them, are so many times as large."""
    larger = of_points(body, factor * body.means, body.normals)
    return larger if body.radii is None else replace(larger, radii=factor * body.radii)


def of_points(body: Body, points: Floats, normals: Floats | None) -> Body:
    """A body of other points; one whose features have an extent is of points, too."""
    return replace(body, features=tuple(PointFeature(one) for one in points), normals=normals)


@lru_cache(maxsize=256)
def _spacing(body: Body) -> float:
    """The smallest distance between two features."""
    apart = cdist(body.means, body.means)
    np.fill_diagonal(apart, np.inf)
    return float(apart.min())


@lru_cache(maxsize=256)
def _tree(body: Body) -> cKDTree:
    """The features, for their neighbours."""
    return cKDTree(body.means)


def _bases(points: Floats, tolerance: float, fewest: int) -> list[list[int]]:
    """Wide triples of points (n, 3), such that each point is missing in one where there are more.

    None where they are on a line.
    """
    if len(points) < FEWEST:
        return []
    first = list(widest_triple(points))
    if _is_narrow(points[first], tolerance):
        return []
    parts = [np.delete(np.arange(len(points)), k) for k in first if len(points) > fewest]
    # where a step of a grid takes those at an edge away, those in the middle have partners
    away = np.linalg.norm(points - points.mean(axis=0), axis=1)
    middle = away.argsort(kind="stable")[: len(points) // 2]
    parts += [middle] if len(middle) > FEWEST else []
    others = [part[list(widest_triple(points[part]))].tolist() for part in parts]
    return [first, *(base for base in others if not _is_narrow(points[base], tolerance))]


def _is_narrow(points: Floats, tolerance: float) -> bool:
    """Whether points (n, 3) lie on a line, within what they may be off."""
    extents = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return bool(extents[1] <= 2 * tolerance)


def _kept(
    body: Body, chosen: Indices, other: Body, T_other_body: Floats, tolerance: float, least: int
) -> Iterable[LookAlike]:
    """Of motions (K, 4, 4), those that bring enough of the chosen features to partners."""
    T, lacking = T_other_body, np.zeros(len(T_other_body), dtype=np.intp)
    tried: list[tuple[Indices, Mask]] = []
    # some from everywhere at a time: few motions leave so many of them without
    chosen = np.random.default_rng(0).permutation(chosen)
    for first in range(0, len(chosen), _TOGETHER):
        some = chosen[first : first + _TOGETHER]
        tried.append(_partners(body, some, other, T, 2 * tolerance))
        lacking = lacking + (~tried[-1][1]).sum(axis=1)
        alive = lacking <= min(len(chosen) - least, 2 * LOST * (first + _TOGETHER))
        T, lacking = T[alive], lacking[alive]
        tried = [(partners[alive], near[alive]) for partners, near in tried]
    order = chosen.argsort()
    chosen = chosen[order]
    partners, near = (np.concatenate(one, axis=1)[:, order] for one in zip(*tried, strict=True))
    for own, keep in zip(partners, near, strict=True):
        # once more after a fit to all of them, which errs less than that to three
        part = _fitted(body, other, chosen[keep], own[keep])
        if part.off <= tolerance and len(set(part.partners)) >= least:
            yield part


def _a_step_aside(body: Body, chosen: Indices, tolerance: float) -> Iterable[LookAlike]:
    """Steps of a body's grid that leave half of the chosen features: of small ones few do more."""
    steps = np.tile(np.eye(4), (len(body.grid_steps), 1, 1))
    steps[:, :3, 3] = body.grid_steps
    for own, near in zip(*_partners(body, chosen, body, steps, 2 * tolerance), strict=True):
        if np.count_nonzero(near) > max(len(chosen) // 2, FEWEST):
            part = _fitted(body, body, chosen[near], own[near])
            if part.off <= tolerance:
                yield part


def _partners(
    body: Body, chosen: Indices, other: Body, T_other_body: Floats, reach: float
) -> tuple[Indices, Mask]:
    """Nearest partners (K, n) of features moved by motions (K, 4, 4), and whether they will do."""
    moved = transform(T_other_body, body.means[chosen])
    away, partners = _tree(other).query(moved, distance_upper_bound=reach)
    near = np.isfinite(away)
    partners[~near] = 0
    if body.normals is not None and other.normals is not None:
        turned = _unit(body.normals[chosen]) @ np.swapaxes(T_other_body[:, :3, :3], 1, 2)
        near &= (turned * _unit(other.normals)[partners]).sum(axis=2) > SAME_NORMAL
    return partners, near


def _fitted(body: Body, other: Body, features: Indices, partners: Indices) -> LookAlike:
    """The motion of the other's features onto a body's."""
    points, targets = body.means[features], other.means[partners]
    T = motions(targets, points[None])[0]
    off = float(np.linalg.norm(points - transform(T, targets), axis=1).max())
    return LookAlike(body, other, T, tuple(features.tolist()), tuple(partners.tolist()), off)


def _grown(
    body: Body, other: Body, base: Sequence[int], image: Indices, tolerance: float
) -> LookAlike | None:
    """All pairs that fit the motion of a triple, or none if the triple itself does not."""
    points, targets = body.means[:60], other.means[:60]
    part = _fitted(body, other, np.array(base), image)
    if part.off > tolerance:
        return None
    away = cdist(points, transform(part.T_body_other, targets))
    partners = away.argmin(axis=1)
    mutual = away.argmin(axis=0)[partners] == np.arange(len(points))
    near = mutual & (away.min(axis=1) <= tolerance)
    if near.sum() < FEWEST:
        return None
    return _fitted(body, other, np.flatnonzero(near), partners[near])


def _are_among(triples: Indices, known: Indices) -> Mask:
    """Whether triples (K, 3) of numbers are among known ones (F, 3)."""
    one, other = (each @ [1_000_000, 1000, 1] for each in (triples, known))
    return np.isin(one, other[(known >= 0).all(axis=1)])


def _modulo_symmetry(other: Body, part: LookAlike) -> Pairs:
    """Pairs of a part, the same for all motions that differ by a symmetry of the other body."""
    images = _permutations(other)[:, list(part.partners)].tolist()
    return part.features, tuple(min(images))


def _is_symmetry(part: LookAlike) -> bool:
    """Whether a motion of a body is the identity or one of its symmetries."""
    images = _permutations(part.body)[:, list(part.features)]
    return bool((images == part.partners).all(axis=1).any())


@lru_cache(maxsize=256)
def _permutations(body: Body) -> Indices:
    """The feature that each feature goes to (G, N), by each symmetry."""
    return np.array([cdist(moved, body.means).argmin(axis=1)
                     for moved in transform(body.symmetries, body.means)])  # fmt: skip


def _unit(vectors: Floats) -> Floats:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))
