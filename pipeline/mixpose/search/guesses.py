"""All kinds of guesses, from the sharpest to the bluntest."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from mixpose.body import Body
from mixpose.search.anchored import from_anchors
from mixpose.search.constraint import Constraint
from mixpose.search.layout import far_apart
from mixpose.search.orientations import spread_turns
from mixpose.search.placement import centres, middle, on_lines, on_points, place
from mixpose.search.refinement import Stage
from mixpose.search.sightings import Sighting
from mixpose.search.sightlines import Sightlines
from mixpose.search.single import from_three_lines
from mixpose.search.spatial import from_points
from mixpose.search.triangulation import Meetings, triangulate

Floats: TypeAlias = NDArray[np.float64]

POINT_GATE = 3.0
"""Largest error of a detection in σ_ε."""

_MOST_MATCHES = 900  # of points in space and features
_MOST_ANCHORS = 24
_FEW_FEATURES = 10
_MANY_LINES = 20
_HEADING_STEP = np.radians(4.0)
_ORIENTATION_STEP = np.radians(12.0)
_WIDE = 0.2  # of the body's spread in the sensor: what a turn by a step moves features by


def from_cameras(
    sightings: Sequence[Sighting], body: Body, rng: np.random.Generator
) -> list[Iterator[Floats]]:
    """Kinds of guesses from lines of sight, the quickest first.

    Points in space; one such point and two lines of sight; three lines of one camera.  Of many
    detections, one point is as good as another, and three lines of one camera come before it.
    """
    lines, gates = _lines(sightings)
    single = [from_three_lines(each, body.means, rng) for each in lines]
    if len(lines) < 2:
        return single
    points = _by_points(lines, gates, body.means, rng)
    anchors = _by_anchors(lines, gates, body.means)
    many = max(len(each) for each in lines) > _MANY_LINES
    return [points, *single, anchors] if many else [points, anchors, *single]


def _lines(sightings: Sequence[Sighting]) -> tuple[list[Sightlines], list[float]]:
    cameras = [s for s in sightings if s.lines is not None and len(s.lines)]
    lines = [s.lines for s in cameras if s.lines is not None]
    return lines, [POINT_GATE * s.sigma for s in cameras]


def _by_points(
    lines: Sequence[Sightlines], gates: Sequence[float], features: Floats, rng: np.random.Generator
) -> Iterator[Floats]:
    meetings = triangulate(lines, gates)
    if len(features) > _FEW_FEATURES:
        features = features[far_apart(features, _FEW_FEATURES)]
    most = _MOST_MATCHES // len(features)
    if len(meetings) > most:
        meetings = meetings.select(far_apart(meetings.points, most))
    yield from_points(meetings, features, rng)


def _by_anchors(
    lines: Sequence[Sightlines], gates: Sequence[float], features: Floats
) -> Iterator[Floats]:
    lines = [
        each.select(far_apart(each.pixels, _MANY_LINES)) if len(each) > _MANY_LINES else each
        for each in lines
    ]
    meetings = triangulate(lines, gates)
    if len(meetings) > _MOST_ANCHORS:
        meetings = meetings.select(np.argsort(meetings.tolerance)[:_MOST_ANCHORS])
    if len(features) > _FEW_FEATURES:
        features = features[far_apart(features, _FEW_FEATURES)]
    yield from from_anchors(meetings, lines, gates, features)


def from_restricted_turns(
    sightings: Sequence[Sighting], body: Body, constraint: Constraint
) -> Iterator[Floats]:
    """Guesses for at most one free axis: all headings, one feature on one line or point."""
    rotations = spread_turns(constraint.turns, _HEADING_STEP) @ constraint.T_reference[:3, :3]
    lines, gates = _lines(sightings)
    if constraint.shifts.sum() <= 2:
        yield from on_lines(sightings, body, rotations, constraint)
    elif len(lines) >= 2:
        meetings: Meetings = triangulate(lines, gates)
        yield on_points(meetings, body, rotations)


def from_spread_orientations(
    sightings: Sequence[Sighting], body: Body, constraint: Constraint
) -> tuple[Floats, list[Stage]]:
    """All orientations, placed by the middle of what is seen, and how to descend from them."""
    rotations = spread_turns(constraint.turns, _ORIENTATION_STEP) @ constraint.T_reference[:3, :3]
    places = centres(sightings, body, constraint)
    poses = [place(sightings, body, rotations, centre, constraint) for centre in places]
    wide = [max(_WIDE * middle(s)[1] / s.sigma, 1.0) for s in sightings]
    stages = []
    for share, steps, survivors in ((1, 0, 500), (1, 3, 300), (0.6, 4, 150), (0.3, 4, 60)):
        stages.append(Stage([max(w**share, 1.0) for w in wide], steps, survivors))
    stages.append(Stage([1.0] * len(wide), 6, 24))
    return np.concatenate(poses) if poses else np.zeros((0, 4, 4)), stages


def from_slips(body: Body, pose: Floats) -> Floats:
    """A pose with the body shifted by the way from any feature to any other (n (n - 1), 4, 4).

    On a grid of features a pose that is a step off explains most of them.
    """
    n = len(body)
    i, j = np.nonzero(~np.eye(n, dtype=np.bool_))
    shifts = np.tile(np.eye(4), (len(i), 1, 1))
    shifts[:, :3, 3] = body.means[i] - body.means[j]
    return pose @ shifts
