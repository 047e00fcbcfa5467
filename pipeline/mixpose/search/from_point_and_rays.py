"""Guesses of several cameras from one triangulated point and two more rays.

Where cameras see different features, few points in space are known.  From one of them a feature
at a known distance lies where its ray cuts a sphere; two such features must be as far apart as
they are on the body.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from mixpose.search.alignment import align_triples
from mixpose.search.budget import SearchBudget
from mixpose.search.triangulation import TriangulatedPoints
from mixpose.sensors import Rays

Floats: TypeAlias = NDArray[np.float64]
Indices: TypeAlias = NDArray[np.intp]


@dataclass(frozen=True)
class _NearRays:
    """Rays of all cameras that pass a point, the nearest, without those that made it."""

    origins: Floats
    directions: Floats
    along: Floats  # where they pass the point
    across: Floats  # how far from it
    error: Floats  # length by which a place on the ray may be off
    central: NDArray[np.bool_]


@dataclass(frozen=True)
class _Places:
    """Where features may be: on a ray, at the right distance from the point."""

    points: Floats
    feature: Indices
    ray: Indices
    error: Floats


def from_point_and_rays(
    found: TriangulatedPoints,
    rays: Sequence[Rays],
    gates: Sequence[float],
    features: Floats,
    budget: SearchBudget,
    skipped: int = 0,
) -> Iterator[Floats]:
    """Poses (K, 4, 4) with one point in space as each feature, point by point.

    Parameters
    ----------
    found : TriangulatedPoints
        Most promising first.
    rays : sequence of Rays
        One per camera.
    gates : sequence of float
        Largest error of a detection per camera, in px.
    features : (n, 3) array
        Of the body.
    budget : SearchBudget
    skipped : int
        Points left out, as they were tried before.
    """
    distances = np.linalg.norm(features[:, None] - features[None], axis=-1)
    for p in range(skipped, min(len(found), budget.max_ray_points)):
        near = _rays_near(found, p, rays, gates, budget.max_rays)
        body, world = [], []
        for i in range(len(features)):
            places = _places(found.points[p], near, distances[i], i)
            a, b = _agreeing(places, distances, budget.max_pairs)
            first = np.full(len(a), i)
            body.append(features[np.stack([first, places.feature[a], places.feature[b]])])
            point = np.broadcast_to(found.points[p], (len(a), 3))
            world.append(np.stack([point, places.points[a], places.points[b]]))
        triples = [np.concatenate(each, axis=1).transpose(0, 2, 1) for each in (body, world)]
        yield align_triples(*triples)


def _rays_near(
    found: TriangulatedPoints, p: int, rays: Sequence[Rays], gates: Sequence[float], count: int
) -> _NearRays:
    parts = []
    for k, each in enumerate(rays):
        used = found.rays[p][found.sensors[p] == k]
        rest = each.select(np.setdiff1d(np.arange(len(each)), used))
        away = found.points[p] - rest.origins
        along = (away * rest.directions).sum(axis=1)
        across = np.linalg.norm(away - along[:, None] * rest.directions, axis=1)
        error = gates[k] * (rest.offset + rest.slope * np.abs(along))
        error = np.hypot(error, found.tolerance[p])
        central = np.full(len(rest), rest.central)
        parts.append((rest.origins, rest.directions, along, across, error, central))
    together = [np.concatenate(column) for column in zip(*parts)]
    nearest = np.argsort(together[3], kind="stable")[:count]
    return _NearRays(*(column[nearest] for column in together))


def _places(point: Floats, near: _NearRays, distances: Floats, i: int) -> _Places:
    """Where rays cut the spheres about the point on which the other features lie."""
    half2 = distances[None] ** 2 - near.across[:, None] ** 2
    at_rim = np.abs(near.across[:, None] - distances[None]) <= near.error[:, None]
    half = np.sqrt(np.maximum(half2, 0.0))
    cuts = (half2 >= 0) | at_rim
    cuts[:, i] = False
    ray, feature = np.nonzero(cuts)
    both = np.concatenate([half[ray, feature], -half[ray, feature]])
    ray, feature = np.tile(ray, 2), np.tile(feature, 2)
    place = near.along[ray] + both
    ahead = ~near.central[ray] | (place > 0)
    ray, feature, place = ray[ahead], feature[ahead], place[ahead]
    points = near.origins[ray] + place[:, None] * near.directions[ray]
    return _Places(points, feature, ray, near.error[ray])


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
