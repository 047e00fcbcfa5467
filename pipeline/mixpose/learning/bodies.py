"""Find the bodies of a recording, one after the other.

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
from mixpose.learning.copies import is_chance, with_copies, without_bodies
from mixpose.learning.points import Cloud
from mixpose.learning.rules import RULES
from mixpose.learning.shapes import FEWEST, PlacedBody, Placements, Shape, find_placements
from mixpose.records import Floats, Mask
from mixpose.rigid import transform

_TRIED = 8  # most promising shapes that are tried for a body
_OF_MATCHED = 0.34  # of the frames with a triple: share in which a point must move along with it


def find_bodies(
    clouds: Sequence[Cloud], rng: np.random.Generator, progress: Progress
) -> list[PlacedBody]:
    """Find what moves rigidly in clouds without points at rest; the bodies with most points first.

    Their placements name points by `Cloud.rows`.
    """
    unclaimed, bodies = list(clouds), list[PlacedBody]()
    while len(bodies) < RULES.most_bodies:
        progress("looking for bodies", len(bodies), RULES.most_bodies)
        if (body := _next(unclaimed, rng)) is None:
            break
        # a frame with few points of a body may show none of the triples by which it is searched
        least = shapes.least_met(len(body.shape))
        more = _missed(body, without_bodies(body.placements, unclaimed), least, RULES.many_bases)
        all_frames = sorted([*body.placements, *more], key=lambda entry: entry[0])
        body = replace(body, placements=tuple(all_frames))
        placements = []
        for k, placement in body.placements:  # with the numbers of points before any was claimed
            met = np.where(placement.met >= 0, unclaimed[k].rows[placement.met], -1)
            placements.append((k, replace(placement, met=met)))
        bodies.append(replace(body, placements=tuple(placements)))
        # also remove its points in frames that show too few of them to count
        unclaimed = without_bodies(body.placements, unclaimed)
        unclaimed = without_bodies(_missed(body, unclaimed, FEWEST, RULES.bases), unclaimed)
    return sorted(bodies, key=lambda body: -body.met_count)


def _next(clouds: Sequence[Cloud], rng: np.random.Generator) -> PlacedBody | None:
    """Return the most evident body of unclaimed points."""
    for looseness in RULES.looser[:2]:
        loosened = [cloud.loosened(looseness) for cloud in clouds]
        for shape in _shapes(loosened, rng)[:_TRIED]:
            if (body := _tightest_body(shape, looseness, clouds)) is not None:
                return body
    return None


def _tightest_body(shape: Shape, least: float, clouds: Sequence[Cloud]) -> PlacedBody | None:
    """Return the body of a shape, as rigid as it can be without losing points in many frames."""
    best, frames = None, 0
    for looseness in RULES.looser[RULES.looser.index(least) :]:
        loosened = [cloud.loosened(looseness) for cloud in clouds]
        body = shapes.grow_body(shape, loosened)
        if body is None or is_chance(body, loosened):
            break
        if best is not None and len(body.placements) < RULES.worth * frames:
            break
        best = replace(with_copies(body, loosened), looseness=looseness)
        # count with as few points as suffice for a looser shape with points of other bodies too
        frames = len(find_placements(best.shape, loosened, best.count, FEWEST))
    return best


def _missed(body: PlacedBody, unclaimed: Sequence[Cloud], least: int, bases: int) -> Placements:
    """Find a body among unclaimed points, in frames with fewer placements than its copies."""
    missing = body.count - np.bincount([k for k, _ in body.placements], minlength=len(unclaimed))
    frames = np.flatnonzero(missing > 0)
    clouds = [unclaimed[k].loosened(body.looseness) for k in frames.tolist()]
    candidates, more = find_placements(body.shape, clouds, body.count, least, bases), []
    for k, placement in candidates:
        if missing[frames[k]] > 0:
            more.append((int(frames[k]), placement))
            missing[frames[k]] -= 1
    return more


def _shapes(clouds: Sequence[Cloud], rng: np.random.Generator) -> list[Shape]:
    """Return shapes that recur, the most promising first; of too many triples some are drawn."""
    sizes = np.array([len(cloud) for cloud in clouds])
    usable = np.flatnonzero(sizes >= FEWEST)
    if len(usable) < RULES.least_frames:
        return []
    spaced = np.linspace(0, len(usable) - 1, min(len(usable), RULES.compared)).astype(np.intp)
    compared = usable[np.unique(spaced)]
    candidates = list[tuple[int, Shape]]()
    for group in np.array_split(usable, min(RULES.references, len(usable))):
        reference = clouds[group[np.argmax(sizes[group])]]
        others = _PaddedClouds.of([clouds[k] for k in compared if clouds[k] is not reference])
        for triple in _reference_triples(reference, rng):
            if (scored := _scored(reference, triple, others)) is not None:
                candidates.append(scored)
    return [shape for _, shape in sorted(candidates, key=lambda scored: -scored[0])]


def _reference_triples(cloud: Cloud, rng: np.random.Generator) -> list[tuple[int, int, int]]:
    """Return triples that are not on a line: of a point and two neighbours, and of any points."""
    count = min(RULES.neighbours + 1, len(cloud))
    _, neighbours = cKDTree(cloud.points).query(cloud.points, k=count)
    near = set[tuple[int, int, int]]()
    for row in neighbours:
        triples = np.sort(row[shapes.triples_of(cloud.points[row], cloud.sigma[row])], axis=1)
        near |= {(a, b, c) for a, b, c in triples.tolist()}
    drawn = sorted(near)
    if len(drawn) > RULES.triples:
        drawn = [drawn[k] for k in rng.choice(len(drawn), RULES.triples, replace=False)]
    for _ in range(RULES.far_triples if len(cloud) > count else 0):
        a, b, c = np.sort(rng.choice(len(cloud), FEWEST, replace=False)).tolist()
        rows = [a, b, c]
        if (a, b, c) not in near and len(shapes.triples_of(cloud.points[rows], cloud.sigma[rows])):
            drawn.append((a, b, c))
    return drawn


def _scored(
    reference: Cloud, triple: tuple[int, int, int], others: _PaddedClouds
) -> tuple[int, Shape] | None:
    """Count points beyond two that other frames show like a triple; also return their shape."""
    base = list(triple)
    times_met, poses_matched, score = np.zeros(len(reference)), 0, 0
    places_seen = reference.points[base][None]
    far = RULES.apart * RULES.gate * reference.sigma[base].max()
    for met, places in _matches_of(reference, base, others):
        if np.abs(places - places_seen).max(axis=(1, 2)).min() > far:
            places_seen = np.concatenate([places_seen, places[None]])
            poses_matched += 1
            score += int(met.sum()) - FEWEST + 1
            times_met += met
    chosen = np.flatnonzero(times_met >= max(_OF_MATCHED * poses_matched, 2.0))
    if poses_matched < FEWEST or len(chosen) < FEWEST:
        return None
    return score, Shape(reference.points[chosen], reference.sigma[chosen])


@dataclass(frozen=True, eq=False)
class _PaddedClouds:
    """Clouds in which triples are searched, padded to the same number of points."""

    points: Floats  # (O, P, 3): infinite for padding
    sigma: Floats  # (O, P)
    distances: Floats  # (O, P, P): between points; infinite from a point to itself and to padding
    typical: Floats  # (O,): median of sigma

    @classmethod
    def of(cls, clouds: Sequence[Cloud]) -> _PaddedClouds:
        """Pad clouds."""
        most = max(len(cloud) for cloud in clouds)
        points, sigma = np.full((len(clouds), most, 3), np.inf), np.ones((len(clouds), most))
        distances = np.full((len(clouds), most, most), np.inf)
        for k, cloud in enumerate(clouds):
            points[k, : len(cloud)], sigma[k, : len(cloud)] = cloud.points, cloud.sigma
            distances[k, : len(cloud), : len(cloud)] = cdist(cloud.points, cloud.points)
        distances[:, range(most), range(most)] = np.inf
        return cls(points, sigma, distances, np.array([np.median(cloud.sigma) for cloud in clouds]))


def _matches_of(
    reference: Cloud, base: list[int], others: _PaddedClouds
) -> Iterator[tuple[Mask, Floats]]:
    """Yield, by cloud, the points (P,) met at the best pose of a triple, and its points (3, 3)."""
    points = reference.points[base]
    slack = RULES.gate * np.sqrt(2.0) * np.hypot(others.typical, reference.sigma[base].max())
    cloud, triples = congruent_triples_of_each(points, others.distances, slack)
    poses = motions(points, others.points[cloud[:, None], triples])
    moved = transform(poses, reference.points)
    distance, sigma = np.empty((2, *moved.shape[:2]))
    edges = np.searchsorted(cloud, np.arange(len(others.points) + 1))
    parts = [slice(*ends) for ends in pairwise(edges.tolist())]
    for k, rows in enumerate(parts):
        distances = cdist(others.points[k], moved[rows].reshape(-1, 3))
        nearest = distances.argmin(axis=0)
        distance[rows] = distances[nearest, np.arange(len(nearest))].reshape(distance[rows].shape)
        sigma[rows] = others.sigma[k, nearest].reshape(distance[rows].shape)
    share = distance / (2 * RULES.gate * np.hypot(sigma, reference.sigma))
    met = share < 1
    met &= met[:, base].all(axis=1)[:, None]
    counts = met.sum(axis=1) - np.minimum(share[:, base], 1).mean(axis=1)
    for k, rows in enumerate(parts):
        if rows.start == rows.stop:
            continue
        best = rows.start + int(np.argmax(counts[rows]))
        if met[best].any():
            yield met[best], others.points[k, triples[best]]
