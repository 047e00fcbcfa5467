"""Motions that map a body onto itself, wholly or but for its rim.

Poses that differ by a rotation which maps the body onto itself can't be told apart by any sensor;
a grid shifted by a step still meets most of itself.

A rotation of the body is fixed by where it sends three features that are not on a line.  All
images of such a triple with the same distances are tried, and those that map every feature onto
a feature within the tolerance are kept.
"""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from mixpose.rigid import from_parts, transform

Floats: TypeAlias = NDArray[np.float64]

_SAME_NORMAL = 0.99  # cosine
_NEIGHBOURS = 24  # of a point, among which the steps of a grid are found


def symmetries(points: Floats, tolerance: float) -> Floats:
    """Find the proper rigid motions that map a point set onto itself.

    Parameters
    ----------
    points : (N, 3) array
        Feature means.
    tolerance : float
        Largest distance, in length units, between an image and its feature.

    Returns
    -------
    (G, 4, 4) array
        T_object_object, the identity first.  Points on one line (a continuous symmetry) give
        only the identity and the half-turn, if any.
    """
    points = np.asarray(points, dtype=np.float64)
    distinct = np.unique(points, axis=0)
    points = points if len(distinct) == len(points) else distinct  # seen as one
    centre = points.mean(axis=0)
    centred = points - centre
    if np.linalg.svd(centred, compute_uv=False)[1] <= tolerance:
        return from_parts(*_line_symmetries(centred, centre, tolerance))
    base = _widest_triple(centred)
    tree = cKDTree(centred)
    found = [np.eye(3)]
    for image in _congruent_triples(centred, base, tolerance):
        R = _aligning_rotation(centred[list(base)], centred[list(image)])
        _, mapped = tree.query(centred @ R.T)
        if len(set(mapped.tolist())) == len(points):
            R = _aligning_rotation(centred, centred[mapped])
        distance, index = tree.query(centred @ R.T)
        one_to_one = len(set(index.tolist())) == len(points)
        if one_to_one and distance.max() <= tolerance and not _known(R, found):
            found.append(R)
    rotations = np.array(found)
    return from_parts(rotations, centre - rotations @ centre)


def keeps_normals(T: Floats, points: Floats, normals: Floats) -> bool:
    """Whether a symmetry of points (N, 3) maps their normals (N, 3) onto each other, within 8°."""
    _, image = cKDTree(points).query(transform(T, points))
    normals = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    return bool(((normals @ T[:3, :3].T) * normals[image]).sum(axis=1).min() > _SAME_NORMAL)


def grid_steps(points: Floats, tolerance: float, share: float) -> Floats:
    """Shifts (S, 3) from one point to a neighbour that map a share of points (N, 3) onto points.

    There are none for points at random, for which that share is 1/N; for a grid it is near 1.
    """
    if len(points) < 2:
        return np.zeros((0, 3))
    _, near = cKDTree(points).query(points, k=min(len(points), 1 + _NEIGHBOURS))
    steps = (points[near[:, 1:]] - points[:, None]).reshape(-1, 3)
    steps = steps[np.linalg.norm(steps, axis=1) > tolerance]  # of points at one place
    if not len(steps):
        return np.zeros((0, 3))
    # their numbers only: where points repeat, each step is alike to most others
    alike = cKDTree(steps).query_ball_point(steps, tolerance, return_length=True)
    found: list[Floats] = []
    for step in steps[alike >= share * len(points)]:
        if all(np.linalg.norm(step - other) > 2 * tolerance for other in found):
            found.append(step)
    return np.array(found).reshape(-1, 3)


def default_tolerance(points: Floats) -> float:
    """A hundredth of the mean distance from the centre: below it a body is called symmetric."""
    centred = points - points.mean(axis=0)
    return float(0.01 * np.linalg.norm(centred, axis=1).mean())


def _line_symmetries(centred: Floats, centre: Floats, tolerance: float) -> tuple[Floats, Floats]:
    """Rotations and translations of points on a line: identity and, if any, the half-turn."""
    axis = np.linalg.svd(centred)[2][0]
    places = np.sort(centred @ axis)
    rotations = np.eye(3)[None]
    if np.abs(places + places[::-1]).max() <= tolerance:
        across = np.linalg.svd(centred)[2][1]
        rotations = np.concatenate([rotations, 2 * np.outer(across, across)[None] - np.eye(3)])
    return rotations, np.asarray(centre - rotations @ centre)


def _widest_triple(centred: Floats) -> tuple[int, int, int]:
    """Three features that span the largest triangle with the first of them farthest out."""
    first = int(np.linalg.norm(centred, axis=1).argmax())
    second = int(np.linalg.norm(centred - centred[first], axis=1).argmax())
    edge = centred[second] - centred[first]
    area = np.linalg.norm(np.cross(centred - centred[first], edge), axis=1)
    area[[first, second]] = -1.0
    return first, second, int(area.argmax())


def _congruent_triples(
    centred: Floats, base: tuple[int, int, int], tolerance: float
) -> list[tuple[int, int, int]]:
    """Ordered triples with the side lengths and radii of the base triple."""
    radius = np.linalg.norm(centred, axis=1)
    distance = np.linalg.norm(centred[:, None] - centred[None], axis=-1)
    a, b, c = base
    slack = 2 * tolerance
    alike = [np.flatnonzero(np.abs(radius - radius[i]) <= slack).tolist() for i in base]
    triples = []
    for i in alike[0]:
        for j in alike[1]:
            if i == j or abs(distance[i, j] - distance[a, b]) > slack:
                continue
            for k in alike[2]:
                if k in (i, j) or abs(distance[i, k] - distance[a, c]) > slack:
                    continue
                if abs(distance[j, k] - distance[b, c]) <= slack:
                    triples.append((i, j, k))
    return triples


def _aligning_rotation(source: Floats, target: Floats) -> Floats:
    """Least-squares rotation (3, 3) from vectors (n, 3) to vectors (n, 3)."""
    U, _, Vt = np.linalg.svd(target.T @ source)
    return np.asarray(U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt)


def _known(R: Floats, found: list[Floats]) -> bool:
    angles = [np.arccos(np.clip((np.trace(R.T @ S) - 1) / 2, -1, 1)) for S in found]
    return bool(min(angles) < np.radians(1.0))
