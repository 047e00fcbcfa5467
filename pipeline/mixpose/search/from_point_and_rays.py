"""Guesses of several cameras from one triangulated point and two more rays.

Where cameras see different features, few points in space are known.  From one of them a feature
at a known distance lies where its ray cuts a sphere; two such features must be as far apart as
they are on the body.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import numpy as np

from mixpose.records import Floats, Indices
from mixpose.search.problem import Generator, SearchProblem
from mixpose.search.spread import far_apart
from mixpose.search.three_points import align_triples
from mixpose.search.triangulation import TriangulatedPoints


class _Places(NamedTuple):
    """Where features may be: on a ray, at the right distance from the point."""

    points: Floats
    feature: Indices
    ray: Indices
    error: Floats  # length by which a place on the ray may be off


def from_point_and_rays(problem: SearchProblem, points: TriangulatedPoints) -> Generator:
    """Poses with one point in space as each feature, point by point, the most promising first."""
    most = min(len(points), 2 * problem.budget.sample)
    return Generator("point and rays", range(most), partial(_poses, problem, points))


def _poses(problem: SearchProblem, points: TriangulatedPoints, p: int) -> Floats:
    means, budget = problem.body.means, problem.budget
    features = means[far_apart(means, budget.sample)]
    distances = np.linalg.norm(features[:, None] - features[None], axis=-1)
    body, world = [], []
    for i, places in enumerate(_places(problem, points, p, distances)):
        a, b = _agreeing(places, distances, budget.batch // len(features))
        corners = np.stack([np.full(len(a), i), places.feature[a], places.feature[b]])
        point = np.broadcast_to(points.points[p], (len(a), 3))
        body.append(features[corners])
        world.append(np.stack([point, places.points[a], places.points[b]]))
    triples = (np.concatenate(parts, axis=1).swapaxes(1, 2) for parts in (body, world))
    return align_triples(*triples)


def _places(
    problem: SearchProblem, points: TriangulatedPoints, p: int, distances: Floats
) -> list[_Places]:
    """For a point as each feature, where rays cut the spheres on which the others lie.

    Of the rays those that pass nearest to the point, without those that made it.
    """
    parts = []
    for k, (sensor, rays) in enumerate(problem.cameras):
        used = points.rays[p][points.sensors[p] == k]
        rest = rays.select(np.setdiff1d(np.arange(len(rays)), used))
        away = points.points[p] - rest.origins
        along = (away * rest.directions).sum(axis=1)
        across = np.linalg.norm(away - along[:, None] * rest.directions, axis=1)
        error = problem.reach(sensor) * (rest.offset + rest.slope * np.abs(along))
        first = np.full(len(rest), 0.0 if rest.central else -np.inf)
        parts.append((across, rest.origins, rest.directions, along, error, first))
    across, *columns = (np.concatenate(column) for column in zip(*parts, strict=True))
    nearest = np.argsort(across, kind="stable")[: 3 * problem.budget.sample]
    origins, directions, along, error, first = (column[nearest] for column in columns)
    across, error = across[nearest, None], np.hypot(error, points.tolerance[p])
    places = []
    for i, distance in enumerate(distances):
        half2 = distance**2 - across**2
        cuts = (half2 >= 0) | (np.abs(across - distance) <= error[:, None])
        cuts[:, i] = False
        ray, feature = np.nonzero(cuts)
        half = np.sqrt(np.maximum(half2[ray, feature], 0.0))
        ray, feature = np.tile(ray, 2), np.tile(feature, 2)
        place = along[ray] + np.concatenate([half, -half])
        ahead = place > first[ray]
        ray, feature, place = ray[ahead], feature[ahead], place[ahead]
        at = origins[ray] + place[:, None] * directions[ray]
        places.append(_Places(at, feature, ray, error[ray]))
    return places


def _agreeing(places: _Places, distances: Floats, most: int) -> tuple[Indices, Indices]:
    """Pairs of places of two features and two rays that are best the right distance apart."""
    x = (places.points - places.points[:1]).astype(np.float32)
    squares, error = (x * x).sum(axis=1), (np.sqrt(0.5) * places.error).astype(np.float32)
    off = -2 * x @ x.T
    off += squares
    off += squares[:, None]
    np.sqrt(np.maximum(off, 0, out=off), out=off)
    off -= distances.astype(np.float32)[np.ix_(places.feature, places.feature)]
    np.abs(off, out=off)
    off -= error
    a, b = np.nonzero(off <= error[:, None])
    apart = (a < b) & (places.ray[a] != places.ray[b]) & (places.feature[a] != places.feature[b])
    a, b = a[apart], b[apart]
    if len(a) > most:
        best = np.argpartition(off[a, b] + error[b], most)[:most]
        a, b = a[best], b[best]
    return a, b
