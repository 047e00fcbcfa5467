"""Guesses of several cameras from one point in space and two more rays.

Where cameras see different features, few points in space are known.  From one of them a feature
at a known distance lies where its ray cuts a sphere; two such features must be as far
apart as they are on the body.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from mixpose.search.alignment import align_triples
from mixpose.search.triangulation import TriangulatedPoints
from mixpose.sensors import Rays

Floats: TypeAlias = NDArray[np.float64]


@dataclass(frozen=True)
class _Lines:
    """Lines of sight of all cameras, without those that make up the anchor."""

    origins: Floats
    directions: Floats
    along: Floats  # where they pass the anchor
    across: Floats  # how far from it
    error: Floats  # length by which a point on the line may be off
    central: NDArray[np.bool_]


@dataclass(frozen=True)
class _Spots:
    """Where features may be: on a line, at the right distance from the anchor."""

    points: Floats
    feature: NDArray[np.intp]
    line: NDArray[np.intp]
    error: Floats


def from_point_and_rays(
    found: TriangulatedPoints,
    lines: Sequence[Rays],
    gates: Sequence[float],
    features: Floats,
    max_pairs: int,
) -> Iterator[Floats]:
    """Poses (K, 4, 4) with one point in space as a certain feature, anchor by anchor.

    Parameters
    ----------
    found : TriangulatedPoints
        The points in space.
    lines : sequence of Rays
        One per camera.
    gates : sequence of float
        Largest error of a detection per camera, in px.
    features : (n, 3) array
        Of the body.
    """
    distances = np.linalg.norm(features[:, None] - features[None], axis=-1)
    for p in range(len(found)):
        around = _lines_around(found, p, lines, gates)
        for i in range(len(features)):
            spots = _spots(found.points[p], around, distances[i], i)
            a, b = _agreeing(spots, distances, max_pairs)
            if len(a) == 0:
                continue
            body = np.stack(
                [
                    np.tile(features[i], (len(a), 1)),
                    features[spots.feature[a]],
                    features[spots.feature[b]],
                ]
            )
            anchor = np.tile(found.points[p], (len(a), 1))
            world = np.stack([anchor, spots.points[a], spots.points[b]])
            yield align_triples(body.transpose(0, 2, 1), world.transpose(0, 2, 1))


def _lines_around(
    found: TriangulatedPoints, p: int, lines: Sequence[Rays], gates: Sequence[float]
) -> _Lines:
    parts = []
    for k, each in enumerate(lines):
        used = found.rays[p][found.sensors[p] == k]
        rest = each.select(np.setdiff1d(np.arange(len(each)), used))
        away = found.points[p] - rest.origins
        along = (away * rest.directions).sum(axis=1)
        across = np.linalg.norm(away - along[:, None] * rest.directions, axis=1)
        error = gates[k] * (rest.offset + rest.slope * np.abs(along))
        error = np.hypot(error, found.tolerance[p])
        central = np.full(len(rest), rest.central)
        parts.append((rest.origins, rest.directions, along, across, error, central))
    return _Lines(*(np.concatenate(column) for column in zip(*parts)))


def _spots(anchor: Floats, around: _Lines, distances: Floats, i: int) -> _Spots:
    """Where lines cut the spheres on which the other features lie."""
    half2 = distances[None] ** 2 - around.across[:, None] ** 2
    near_rim = np.abs(around.across[:, None] - distances[None]) <= around.error[:, None]
    half = np.sqrt(np.maximum(half2, 0.0))
    cuts = (half2 >= 0) | near_rim
    cuts[:, i] = False
    line, feature = np.nonzero(cuts)
    both = np.concatenate([half[line, feature], -half[line, feature]])
    line, feature = np.tile(line, 2), np.tile(feature, 2)
    place = around.along[line] + both
    ahead = ~around.central[line] | (place > 0)
    line, feature, place = line[ahead], feature[ahead], place[ahead]
    points = around.origins[line] + place[:, None] * around.directions[line]
    return _Spots(points, feature, line, around.error[line])


def _agreeing(
    spots: _Spots, distances: Floats, most: int
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Pairs of spots of two features and two lines that are the right distance apart."""
    x = spots.points
    squares = (x * x).sum(axis=1)
    apart = np.sqrt(np.maximum(squares[:, None] + squares[None] - 2 * x @ x.T, 0.0))
    wanted = distances[np.ix_(spots.feature, spots.feature)]
    error = np.sqrt(0.5) * (spots.error[:, None] + spots.error[None])
    good = (np.abs(apart - wanted) <= error) & (wanted > 0)
    good &= spots.line[:, None] != spots.line[None]
    a, b = np.nonzero(np.triu(good, 1))
    return a[:most], b[:most]
