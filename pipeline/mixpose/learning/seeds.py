"""Shapes to begin with: points of one frame that lie alike in others."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from mixpose.body.symmetry import congruent_triples, motions
from mixpose.learning.placing import FEWEST, Shape, triples_of
from mixpose.learning.points import Cloud
from mixpose.learning.rules import LearningRules
from mixpose.records import Floats, Indices, Mask
from mixpose.rigid import transform

_OF_MATCHED = 0.34  # frames in which a point goes along with a triple, of those that show this


@dataclass(frozen=True, eq=False)
class Seed:
    """A shape taken from one frame."""

    shape: Shape
    score: int  # points beyond two that other frames show alike, all frames together
    frames: int  # in which it was found, of those compared


def seeds(clouds: Sequence[Cloud], rules: LearningRules, rng: np.random.Generator) -> list[Seed]:
    """Shapes that recur, the most promising first.

    Parameters
    ----------
    rng : Generator
        By which triples are drawn where there are too many.
    """
    sizes = np.array([len(cloud) for cloud in clouds])
    usable = np.flatnonzero(sizes >= FEWEST)
    if len(usable) < rules.least_frames:
        return []
    compared = usable[_spread(len(usable), rules.compared)]
    found = []
    for part in np.array_split(usable, min(rules.references, len(usable))):
        reference = clouds[part[np.argmax(sizes[part])]]
        others = [clouds[k] for k in compared if clouds[k] is not reference]
        for triple in _near_triples(reference, rules, rng):
            seed = _seed(reference, triple, others, rules)
            if seed is not None:
                found.append(seed)
    return sorted(found, key=lambda seed: -seed.score)


def _spread(count: int, most: int) -> Indices:
    return np.unique(np.linspace(0, count - 1, min(count, most)).astype(np.intp))


def _near_triples(
    cloud: Cloud, rules: LearningRules, rng: np.random.Generator
) -> list[tuple[int, int, int]]:
    """Triples that are not on a line: of a point and two of its neighbours, and of any."""
    reach = min(rules.neighbours + 1, len(cloud))
    _, near = cKDTree(cloud.points).query(cloud.points, k=reach)
    found = set[tuple[int, int, int]]()
    for row in near:
        own = np.sort(row[triples_of(cloud.points[row], cloud.reach[row])], axis=1)
        found |= {(a, b, c) for a, b, c in own.tolist()}
    drawn = sorted(found)
    if len(drawn) > rules.triples:
        drawn = [drawn[k] for k in rng.choice(len(drawn), rules.triples, replace=False)]
    for _ in range(rules.far_triples if len(cloud) > reach else 0):
        a, b, c = np.sort(rng.choice(len(cloud), FEWEST, replace=False)).tolist()
        some = [a, b, c]
        if (a, b, c) not in found and len(triples_of(cloud.points[some], cloud.reach[some])):
            drawn.append((a, b, c))
    return drawn


def _seed(
    reference: Cloud, triple: tuple[int, int, int], others: Sequence[Cloud], rules: LearningRules
) -> Seed | None:
    base = list(triple)
    goes_along, matched, score = np.zeros(len(reference)), 0, 0
    seen = [reference.points[base]]
    far = rules.apart * rules.gate * reference.reach[base].max()
    for other in others:
        there = _goes_along(reference, base, other, rules)
        if there is None:
            continue
        met, places = there
        if min(np.abs(places - each).max() for each in seen) > far:
            seen.append(places)
            matched += 1
            score += int(met.sum()) - FEWEST + 1
            goes_along += met
    if matched < FEWEST:
        return None
    chosen = np.flatnonzero(goes_along >= max(_OF_MATCHED * matched, 2.0))
    if len(chosen) < FEWEST:
        return None
    return Seed(Shape(reference.points[chosen], reference.reach[chosen]), score, matched)


def _goes_along(
    reference: Cloud, base: list[int], other: Cloud, rules: LearningRules
) -> tuple[Mask, Floats] | None:
    """Points (P,) of a cloud that lie in another as they do about a triple, and where this is."""
    points = reference.points[base]
    typical = np.hypot(np.median(other.reach), reference.reach[base].max())
    triples = congruent_triples(points, other.points, rules.gate * np.sqrt(2.0) * typical)
    if not len(triples):
        return None
    poses = motions(points, other.points[triples])
    away, nearest = cKDTree(other.points).query(transform(poses, reference.points))
    share = away / (2 * rules.gate * np.hypot(other.reach[nearest], reference.reach))
    met = share < 1
    met &= (share[:, base] < 1).all(axis=1)[:, None]
    counts = met.sum(axis=1) - np.minimum(share[:, base], 1).mean(axis=1)
    best = int(np.argmax(counts))
    return (met[best], other.points[triples[best]]) if met[best].any() else None
