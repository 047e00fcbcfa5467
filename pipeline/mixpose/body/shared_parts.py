"""Parts that bodies have in common: markers of the one that could be markers of the other.

Three markers or more of a body that lie like as many of another look like that other body where
the rest is hidden.  Triples are compared by the lengths of their sides; what fits a motion so
found belongs to the part.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations, permutations
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from mixpose.rigid import from_parts, transform

Floats: TypeAlias = NDArray[np.float64]

MOST_POINTS = 16
"""Bodies with more markers are not compared: they are seldom met by three alone."""


@dataclass(frozen=True)
class SharedPart:
    """Markers of a body that lie like markers of another.

    Attributes
    ----------
    T_body_other : (4, 4) float64
        The motion that puts the other's markers on the body's.
    own, others : tuple of int
        Markers of the body and of the other, pair by pair, by ascending number of the body's.
    off : float
        The largest distance of a pair, length units.
    """

    T_body_other: Floats
    own: tuple[int, ...]
    others: tuple[int, ...]
    off: float


def shared_parts(points: Floats, other: Floats, tolerance: float) -> list[SharedPart]:
    """Find the parts of two bodies that are congruent, largest first, none within another.

    Parameters
    ----------
    points, other : (n, 3), (k, 3) array
        Markers of the body, and of the other; given the same array, the identity is left out.
    tolerance : float
        How far markers may be off each other, length units.
    """
    if not 3 <= len(points) <= MOST_POINTS or not 3 <= len(other) <= MOST_POINTS:
        return []
    found: list[SharedPart] = []
    for own, theirs in _triples(points, other, tolerance):
        if points is other and own == theirs:
            continue
        part = _grown(points, other, own, theirs, tolerance)
        if part is None or any(_holds(known, part) for known in found):
            continue
        found = [known for known in found if not _holds(part, known)]
        found.append(part)
    return sorted(found, key=lambda part: (-len(part.own), part.off))


def _triples(
    points: Floats, other: Floats, tolerance: float
) -> Iterator[tuple[tuple[int, ...], tuple[int, ...]]]:
    """Triples of both whose sides differ by no more than both ends may be off."""
    mine = np.array(list(combinations(range(len(points)), 3)))
    theirs = np.array(list(permutations(range(len(other)), 3)))
    away = np.abs(_sides(points, mine)[:, None] - _sides(other, theirs)).max(axis=2)
    for i, j in zip(*np.nonzero(away <= 2 * tolerance), strict=True):
        yield tuple(mine[i].tolist()), tuple(theirs[j].tolist())


def _sides(points: Floats, triples: NDArray[np.intp]) -> Floats:
    corners = points[triples]
    return np.asarray(np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2))


def _grown(
    points: Floats, other: Floats, own: tuple[int, ...], theirs: tuple[int, ...], tolerance: float
) -> SharedPart | None:
    """All pairs that fit the motion of a triple, or none if the triple itself does not."""
    T = _motion(other[list(theirs)], points[list(own)])
    away = np.linalg.norm(points[:, None] - transform(T, other), axis=2)
    if max(away[i, j] for i, j in zip(own, theirs, strict=True)) > tolerance:
        return None
    pairs = []
    for i, j in zip(range(len(points)), away.argmin(axis=1).tolist(), strict=True):
        if away[i, j] <= tolerance and away[:, j].argmin() == i:
            pairs.append((i, j))
    if len(pairs) < 3:
        return None
    mine, others = (tuple(each) for each in zip(*pairs, strict=True))
    T = _motion(other[list(others)], points[list(mine)])
    off = np.linalg.norm(points[list(mine)] - transform(T, other[list(others)]), axis=1).max()
    return SharedPart(T, mine, others, float(off))


def _motion(source: Floats, target: Floats) -> Floats:
    """The least-squares motion (4, 4) of points (n, 3) onto points (n, 3)."""
    a, b = source.mean(axis=0), target.mean(axis=0)
    U, _, Vt = np.linalg.svd((target - b).T @ (source - a))
    R = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
    return from_parts(R, b - R @ a)


def _holds(one: SharedPart, other: SharedPart) -> bool:
    """Whether a part has all pairs of another."""
    pairs = set(zip(one.own, one.others, strict=True))
    return pairs >= set(zip(other.own, other.others, strict=True))
