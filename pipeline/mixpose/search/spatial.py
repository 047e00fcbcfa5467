"""Guesses of several cameras: from points in space, and from one such point and two lines.

A pair (point in space, feature of the body) is a match.  Two matches agree when the points are as
far apart as the features are.  Three that agree fix the pose.
"""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from mixpose.search.alignment import align_triples
from mixpose.search.triangulation import Meetings

Floats: TypeAlias = NDArray[np.float64]

_MOST_TRIPLES = 6000


def from_points(meetings: Meetings, features: Floats, rng: np.random.Generator) -> Floats:
    """Poses (K, 4, 4) of all agreeing triples of points in space, or many of the best.

    Parameters
    ----------
    meetings : Meetings
    features : (n, 3) array
        Of the body.
    rng : numpy Generator
        Draws among too many triples.
    """
    agree = _agreement(meetings, features)
    common = (agree @ agree) * agree
    u, v = np.nonzero(np.triu(common))
    if len(u) == 0:
        return np.zeros((0, 4, 4))
    most = common[u, v]
    total = most.sum() / 3
    if total > _MOST_TRIPLES:
        # sides with many common partners first: a true match has as many as features are seen
        order = np.argsort(-most + rng.uniform(0, 0.5, len(most)), kind="stable")
        enough = int(np.searchsorted(np.cumsum(most[order]), _MOST_TRIPLES)) + 1
        u, v = u[order[:enough]], v[order[:enough]]
    thirds = (agree[u] * agree[v]) > 0
    if total <= _MOST_TRIPLES:
        thirds &= np.arange(len(agree)) > v[:, None]
    side, w = np.nonzero(thirds)
    triples = np.stack([u[side], v[side], w])[:, : 2 * _MOST_TRIPLES]
    n = len(features)
    world = meetings.points[triples // n].transpose(0, 2, 1)
    return align_triples(features[triples % n].transpose(0, 2, 1), world)


def _agreement(meetings: Meetings, features: Floats) -> NDArray[np.float32]:
    """Which matches agree (P n, P n), 0 or 1; match p n + i is point p as feature i."""
    P, n = len(meetings), len(features)
    apart = np.linalg.norm(meetings.points[:, None] - meetings.points[None], axis=-1)
    tolerance = np.hypot(meetings.tolerance[:, None], meetings.tolerance[None])
    distance = np.linalg.norm(features[:, None] - features[None], axis=-1)
    agree = (
        np.abs(apart[:, None, :, None] - distance[None, :, None, :])
        <= (tolerance[:, None, :, None])
    )
    agree &= ~np.eye(P, dtype=np.bool_)[:, None, :, None]
    agree &= ~np.eye(n, dtype=np.bool_)[None, :, None, :]
    agree &= ~_exclusive(meetings)[:, None, :, None]
    return np.asarray(agree.reshape(P * n, P * n), dtype=np.float32)


def _exclusive(meetings: Meetings) -> NDArray[np.bool_]:
    """Pairs of points (P, P) that share a line: at most one of them is a feature."""
    shared = np.zeros((len(meetings), len(meetings)), dtype=np.bool_)
    for a in range(2):
        for b in range(2):
            shared |= (meetings.sensors[:, a, None] == meetings.sensors[None, :, b]) & (
                meetings.lines[:, a, None] == meetings.lines[None, :, b]
            )
    return shared
