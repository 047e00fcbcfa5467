"""Bodies of a recording, one after the other.

Each begins with a shape: points of one frame that lie alike in others.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

from mixpose.body.symmetry import congruent_triples_of_each, motions
from mixpose.calibration.task import Progress
from mixpose.learning import shapes
from mixpose.learning.copies import is_chance, left_by, with_copies
from mixpose.learning.points import Cloud
from mixpose.learning.rules import RULES
from mixpose.learning.shapes import FEWEST, Found, Places, Shape, placed
from mixpose.records import Floats, Mask
from mixpose.rigid import transform

_TRIED = 8  # seeds that may fail one after the other
_OF_MATCHED = 0.34  # frames in which a point goes along with a triple, of those that show this


def find_bodies(
    clouds: Sequence[Cloud], rng: np.random.Generator, progress: Progress
) -> list[Found]:
    """Find what moves rigidly in clouds without what stands still; most points seen first.

    Which points the bodies meet is told by `Cloud.rows`.
    """
    left, found = list(clouds), list[Found]()
    while len(found) < RULES.most_bodies:
        progress("looking for bodies", len(found), RULES.most_bodies)
        body = _next(left, rng)
        if body is None:
            break
        # a frame that shows few points of a body may show none of the triples it was found by
        least = shapes.least_met(len(body.shape))
        more = _missed(body, left_by(body.places, left), least, RULES.many_bases)
        body = replace(body, places=tuple(sorted([*body.places, *more], key=lambda each: each[0])))
        places = []
        for k, one in body.places:  # with points numbered as they were before any were left out
            met = np.where(one.met >= 0, left[k].rows[one.met], -1)
            places.append((k, replace(one, met=met)))
        found.append(replace(body, places=tuple(places)))
        # also where too few of its points are seen for a frame to count
        left = left_by(body.places, left)
        left = left_by(_missed(body, left, FEWEST, RULES.bases), left)
    return sorted(found, key=lambda each: -each.met)


def _next(clouds: Sequence[Cloud], rng: np.random.Generator) -> Found | None:
    """The most evident body of what is left."""
    for loose in RULES.looser[:2]:
        looser = [cloud.loosened(loose) for cloud in clouds]
        for shape in _shapes(looser, rng)[:_TRIED]:
            body = _loose_enough(shape, loose, clouds)
            if body is not None:
                return body
    return None


def _loose_enough(shape: Shape, least: float, clouds: Sequence[Cloud]) -> Found | None:
    """The body of a shape, as rigid as it can be without losing points in many frames."""
    best, frames = None, 0
    for loose in RULES.looser[RULES.looser.index(least) :]:
        looser = [cloud.loosened(loose) for cloud in clouds]
        body = shapes.grown(shape, looser)
        if body is None or is_chance(body, looser):
            break
        if best is not None and len(body.places) < RULES.worth * frames:
            break
        best = replace(with_copies(body, looser), loose=loose)
        # with as few points as a looser shape is met by, where it has other bodies' among them
        frames = len(placed(best.shape, looser, best.count, FEWEST))
    return best


def _missed(body: Found, left: Sequence[Cloud], least: int, bases: int) -> Places:
    """Where it is in what it left, in frames in which fewer of it were found than there are."""
    missing = body.count - np.bincount([k for k, _ in body.places], minlength=len(left))
    frames = np.flatnonzero(missing > 0)
    some = [left[k].loosened(body.loose) for k in frames.tolist()]
    found, rest = placed(body.shape, some, body.count, least, bases), []
    for k, one in found:
        if missing[frames[k]] > 0:
            rest.append((int(frames[k]), one))
            missing[frames[k]] -= 1
    return rest


def _shapes(clouds: Sequence[Cloud], rng: np.random.Generator) -> list[Shape]:
    """Shapes that recur, the most promising first; where there are too many, triples are drawn."""
    sizes = np.array([len(cloud) for cloud in clouds])
    usable = np.flatnonzero(sizes >= FEWEST)
    if len(usable) < RULES.least_frames:
        return []
    some = np.linspace(0, len(usable) - 1, min(len(usable), RULES.compared)).astype(np.intp)
    compared = usable[np.unique(some)]
    found = list[tuple[int, Shape]]()
    for part in np.array_split(usable, min(RULES.references, len(usable))):
        reference = clouds[part[np.argmax(sizes[part])]]
        others = _Others.of([clouds[k] for k in compared if clouds[k] is not reference])
        for triple in _near_triples(reference, rng):
            scored = _scored(reference, triple, others)
            if scored is not None:
                found.append(scored)
    return [shape for _, shape in sorted(found, key=lambda scored: -scored[0])]


def _near_triples(cloud: Cloud, rng: np.random.Generator) -> list[tuple[int, int, int]]:
    """Triples that are not on a line: of a point and two of its neighbours, and of any."""
    reach = min(RULES.neighbours + 1, len(cloud))
    _, near = cKDTree(cloud.points).query(cloud.points, k=reach)
    found = set[tuple[int, int, int]]()
    for row in near:
        own = np.sort(row[shapes.triples_of(cloud.points[row], cloud.reach[row])], axis=1)
        found |= {(a, b, c) for a, b, c in own.tolist()}
    drawn = sorted(found)
    if len(drawn) > RULES.triples:
        drawn = [drawn[k] for k in rng.choice(len(drawn), RULES.triples, replace=False)]
    for _ in range(RULES.far_triples if len(cloud) > reach else 0):
        a, b, c = np.sort(rng.choice(len(cloud), FEWEST, replace=False)).tolist()
        some = [a, b, c]
        if (a, b, c) not in found and len(shapes.triples_of(cloud.points[some], cloud.reach[some])):
            drawn.append((a, b, c))
    return drawn


def _scored(
    reference: Cloud, triple: tuple[int, int, int], others: _Others
) -> tuple[int, Shape] | None:
    """What goes along with a triple, and how many points other frames show alike beyond two."""
    base = list(triple)
    goes_along, matched, score = np.zeros(len(reference)), 0, 0
    seen = reference.points[base][None]
    far = RULES.apart * RULES.gate * reference.reach[base].max()
    for met, places in _going_along(reference, base, others):
        if np.abs(places - seen).max(axis=(1, 2)).min() > far:
            seen = np.concatenate([seen, places[None]])
            matched += 1
            score += int(met.sum()) - FEWEST + 1
            goes_along += met
    chosen = np.flatnonzero(goes_along >= max(_OF_MATCHED * matched, 2.0))
    if matched < FEWEST or len(chosen) < FEWEST:
        return None
    return score, Shape(reference.points[chosen], reference.reach[chosen])


@dataclass(frozen=True, eq=False)
class _Others:
    """Clouds in which triples are looked for, filled up to the same number of points."""

    points: Floats  # (O, P, 3)
    reach: Floats  # (O, P)
    apart: Floats  # (O, P, P): distances; infinite of a point to itself, and of those filled up
    typical: Floats  # (O,): median of reach

    @classmethod
    def of(cls, clouds: Sequence[Cloud]) -> _Others:
        """Fill clouds up."""
        most = max(len(cloud) for cloud in clouds)
        points, reach = np.full((len(clouds), most, 3), np.inf), np.ones((len(clouds), most))
        apart = np.full((len(clouds), most, most), np.inf)
        for k, cloud in enumerate(clouds):
            points[k, : len(cloud)], reach[k, : len(cloud)] = cloud.points, cloud.reach
            apart[k, : len(cloud), : len(cloud)] = cdist(cloud.points, cloud.points)
        apart[:, range(most), range(most)] = np.inf
        return cls(points, reach, apart, np.array([np.median(cloud.reach) for cloud in clouds]))


def _going_along(
    reference: Cloud, base: list[int], others: _Others
) -> Iterator[tuple[Mask, Floats]]:
    """Points (P,) of a cloud that lie in others as they do about a triple, and where this is."""
    points = reference.points[base]
    slack = RULES.gate * np.sqrt(2.0) * np.hypot(others.typical, reference.reach[base].max())
    cloud, triples = congruent_triples_of_each(points, others.apart, slack)
    poses = motions(points, others.points[cloud[:, None], triples])
    moved = transform(poses, reference.points)
    away, reach = np.empty((2, *moved.shape[:2]))
    edges = np.searchsorted(cloud, np.arange(len(others.points) + 1))
    parts = [slice(*each) for each in pairwise(edges.tolist())]
    for k, own in enumerate(parts):
        found = cdist(others.points[k], moved[own].reshape(-1, 3))
        nearest = found.argmin(axis=0)
        away[own] = found[nearest, np.arange(len(nearest))].reshape(away[own].shape)
        reach[own] = others.reach[k, nearest].reshape(away[own].shape)
    share = away / (2 * RULES.gate * np.hypot(reach, reference.reach))
    met = share < 1
    met &= met[:, base].all(axis=1)[:, None]
    counts = met.sum(axis=1) - np.minimum(share[:, base], 1).mean(axis=1)
    for k, own in enumerate(parts):
        if own.start == own.stop:
            continue
        best = own.start + int(np.argmax(counts[own]))
        if met[best].any():
            yield met[best], others.points[k, triples[best]]
