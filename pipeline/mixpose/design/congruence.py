"""Subsets of one body's markers that another body has too: where the one is taken for the other."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np
from scipy.optimize import linear_sum_assignment

from mixpose.body import Body
from mixpose.rigid import Floats

FEWEST = 3  # points that a pose can be had from
_MOST = 60  # markers of a body; triples of more would take minutes


@dataclass(frozen=True)
class Congruence:
    """Markers of two bodies that lie alike.

    Attributes
    ----------
    bodies : (str, str)
    markers : tuple of (int, int)
        Pairs of markers, from 0, of the first and the second body.
    misfit : float
        Largest distance between the paired markers once they lie on each other.
    """

    bodies: tuple[str, str]
    markers: tuple[tuple[int, int], ...]
    misfit: float


def congruent_subsets(first: Body, second: Body, tolerance: float) -> Congruence | None:
    """The largest subset of one body's markers that a motion lays onto markers of another.

    Parameters
    ----------
    first, second : Body
    tolerance : float
        Largest distance of a marker from its partner, length units.

    Returns
    -------
    Congruence or None
        None where fewer than three markers, not on a line, lie alike.
    """
    A, B = first.means[:_MOST], second.means[:_MOST]
    between_a, between_b = (np.linalg.norm(P[:, None] - P, axis=-1) for P in (A, B))
    best: Congruence | None = None
    for triple in combinations(range(len(A)), 3):
        if not _spans(A[list(triple)], tolerance):
            continue
        for image in _images(triple, between_a, between_b, 2 * tolerance):
            found = _extended(A, B, list(triple), list(image), tolerance)
            if found is None:
                continue
            pairs, misfit = found
            if best is None or (len(pairs), -misfit) > (len(best.markers), -best.misfit):
                best = Congruence((first.name, second.name), pairs, misfit)
    return best


def _spans(points: Floats, tolerance: float) -> bool:
    """Whether three points are far from one line: their pose is known then."""
    centred = points - points.mean(axis=0)
    return bool(np.linalg.svd(centred, compute_uv=False)[1] > 2 * tolerance)


def _images(
    triple: tuple[int, ...], between_a: Floats, between_b: Floats, slack: float
) -> list[tuple[int, int, int]]:
    """Ordered triples of the second body with the same sides."""
    a, b, c = triple
    images = []
    for i, j in np.argwhere(np.abs(between_b - between_a[a, b]) <= slack):
        if i == j:
            continue
        fits = np.abs(between_b[i] - between_a[a, c]) <= slack
        fits &= np.abs(between_b[j] - between_a[b, c]) <= slack
        fits[[i, j]] = False
        images += [(int(i), int(j), int(k)) for k in np.flatnonzero(fits)]
    return images


def _extended(
    A: Floats, B: Floats, source: list[int], target: list[int], tolerance: float
) -> tuple[tuple[tuple[int, int], ...], float] | None:
    """All pairs that a motion by three of them brings together, after one more fit to all."""
    for _ in range(2):
        moved = _aligned(A, A[source], B[target])
        away = np.linalg.norm(moved[:, None] - B, axis=-1)
        rows, columns = linear_sum_assignment(np.minimum(away, 2 * tolerance))
        near = away[rows, columns] <= tolerance
        if near.sum() < FEWEST:
            return None
        source, target = rows[near].tolist(), columns[near].tolist()
    moved = _aligned(A, A[source], B[target])
    misfit = float(np.linalg.norm(moved[source] - B[target], axis=1).max())
    return tuple(zip(source, target, strict=True)), misfit


def _aligned(points: Floats, source: Floats, target: Floats) -> Floats:
    """Points moved as fits the source onto the target best; no mirror image."""
    at, to = source.mean(axis=0), target.mean(axis=0)
    U, _, Vt = np.linalg.svd((target - to).T @ (source - at))
    R = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
    return np.asarray((points - at) @ R.T + to)
