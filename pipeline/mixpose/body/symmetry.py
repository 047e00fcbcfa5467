"""Find motions that map a body onto itself, or all of a grid but its rim.

No sensor can distinguish poses that differ by a rotation which maps the body onto itself; after a
step, most points of a grid still lie on points of it.

A rotation of the body is fixed by the images of three features that are not on a line.  All
congruent triples are tried as images; rotations that map every feature onto a feature within the
tolerance are kept.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

from mixpose.records import Floats, Indices
from mixpose.rigid import from_parts, transform

SAME_NORMAL = 0.99  # cosine
_SAME_TURN = np.radians(1.0)
_ROUNDING = 1e-6  # of the size of a body: coordinates are rounded to as many digits
_NEIGHBOURS = 24  # nearest points that are tried for steps of a grid


def symmetries(points: Floats, tolerance: float) -> Floats:
    """Find the proper rigid motions (G, 4, 4) that map points (N, 3) onto themselves.

    The tolerance is the largest distance between an image and its feature.  The identity is first;
    points on one line (a continuous symmetry) give only it and the half-turn, if any.
    """
    points = np.asarray(points, dtype=np.float64)
    distinct = np.unique(points, axis=0)
    points = points if len(distinct) == len(points) else distinct  # points at one place count once
    centre = points.mean(axis=0)
    centred = points - centre
    if is_on_a_line(points, tolerance):
        return from_parts(*_line_symmetries(centred, centre, tolerance))
    base = centred[list(widest_triple(centred))]
    tree = cKDTree(centred)
    rotations = [np.eye(3)]
    for turn in motions(base, centred[congruent_triples(base, centred, 2 * tolerance)])[:, :3, :3]:
        _, mapped = tree.query(centred @ turn.T)
        R = turn
        if len(set(mapped.tolist())) == len(points):
            R = motions(centred, centred[mapped][None])[0, :3, :3]
        distance, index = tree.query(centred @ R.T)
        one_to_one = len(set(index.tolist())) == len(points)
        if one_to_one and distance.max() <= tolerance and not _is_known(R, rotations):
            rotations.append(R)
    closed = _closed(np.array(rotations), centred, tree, 2 * tolerance)
    return from_parts(closed, centre - closed @ centre)


def is_on_a_line(points: Floats, tolerance: float) -> bool:
    """Test whether points (N, 3) lie on a line; any rotation about it leaves them in place."""
    return bool(np.linalg.svd(points - points.mean(axis=0), compute_uv=False)[1] <= tolerance)


def _closed(rotations: Floats, centred: Floats, tree: cKDTree, tolerance: float) -> Floats:
    """Add the products of rotations (G, 3, 3), which map the body onto itself, too.

    A product may be off by twice the tolerance, so that the search for rotations misses some.
    """
    for R in (rotations[:, None] @ rotations[None]).reshape(-1, 3, 3):
        if _is_known(R, rotations):
            continue
        _, mapped = tree.query(centred @ R.T)
        if len(set(mapped.tolist())) == len(centred):
            nearest = motions(centred, centred[mapped][None])[0, :3, :3]
            if np.linalg.norm(centred @ nearest.T - centred[mapped], axis=1).max() <= tolerance:
                more = np.concatenate([rotations, nearest[None]])
                return _closed(more, centred, tree, tolerance)
    return rotations


def farthest_apart(motions: Floats, points: Floats) -> float:
    """Return the largest distance of moved points to the nearest of (N, 3); 0 if it is rounding."""
    distance = float(cKDTree(points).query(transform(motions, points).reshape(-1, 3))[0].max())
    return distance if distance > _ROUNDING * float(np.ptp(points, axis=0).max()) else 0.0


def are_normals_kept(T: Floats, points: Floats, normals: Floats) -> bool:
    """Test whether a symmetry of points (N, 3) maps their normals (N, 3) onto each other, to 8°."""
    _, image = cKDTree(points).query(transform(T, points))
    normals = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    return bool(((normals @ T[:3, :3].T) * normals[image]).sum(axis=1).min() > SAME_NORMAL)


def grid_steps(points: Floats, tolerance: float, share: float) -> Floats:
    """Find shifts (S, 3) between neighbours that map a share of points (N, 3) onto points.

    Points at random have none, as their share is 1/N; that of a grid is near 1.
    """
    if len(points) < 2:
        return np.zeros((0, 3))
    _, near = cKDTree(points).query(points, k=min(len(points), 1 + _NEIGHBOURS))
    steps = (points[near[:, 1:]] - points[:, None]).reshape(-1, 3)
    steps = steps[np.linalg.norm(steps, axis=1) > tolerance]  # not between points at one place
    if not len(steps):
        return np.zeros((0, 3))
    # only their numbers: in a grid a step equals many others
    alike = cKDTree(steps).query_ball_point(steps, tolerance, return_length=True)
    selected: list[Floats] = []
    for step in steps[alike >= share * len(points)]:
        if all(np.linalg.norm(step - other) > 2 * tolerance for other in selected):
            selected.append(step)
    return np.array(selected).reshape(-1, 3)


def default_tolerance(points: Floats) -> float:
    """Return a hundredth of the mean distance from the centre: symmetries may be off by as much."""
    centred = points - points.mean(axis=0)
    return float(0.01 * np.linalg.norm(centred, axis=1).mean())


def _line_symmetries(centred: Floats, centre: Floats, tolerance: float) -> tuple[Floats, Floats]:
    """Return rotations and translations of points on a line: the identity and any half-turn."""
    axis = np.linalg.svd(centred)[2][0]
    places = np.sort(centred @ axis)
    rotations = np.eye(3)[None]
    if np.abs(places + places[::-1]).max() <= tolerance:
        across = np.linalg.svd(centred)[2][1]
        rotations = np.concatenate([rotations, 2 * np.outer(across, across)[None] - np.eye(3)])
    return rotations, np.asarray(centre - rotations @ centre)


def widest_triple(points: Floats) -> tuple[int, int, int]:
    """Select three points (N, 3) that span a large triangle, the first farthest from the middle."""
    first = int(np.linalg.norm(points - points.mean(axis=0), axis=1).argmax())
    second = int(np.linalg.norm(points - points[first], axis=1).argmax())
    edge = points[second] - points[first]
    area = np.linalg.norm(np.cross(points - points[first], edge), axis=1)
    area[[first, second]] = -1.0
    return first, second, int(area.argmax())


def congruent_triples(base: Floats, points: Floats, slack: float) -> Indices:
    """Find ordered triples (K, 3) of points (N, 3) with the sides of a base triple (3, 3)."""
    distances = cdist(points, points)
    np.fill_diagonal(distances, np.inf)
    return congruent_triples_of_each(base, distances[None], np.array([slack]))[1]


def congruent_triples_of_each(
    base: Floats, distances: Floats, slack: Floats
) -> tuple[Indices, Indices]:
    """Find such triples by the distances (C, N, N) of clouds; return clouds (K,) and triples.

    Sides may differ by the slack (C,) of the cloud.
    """
    sides = np.linalg.norm(base[[1, 2, 2]] - base[[0, 0, 1]], axis=1)
    cloud, i, j = np.nonzero(np.abs(distances - sides[0]) <= slack[:, None, None])
    allowed = slack[cloud, None]
    fits = np.abs(distances[cloud, i] - sides[1]) <= allowed
    fits &= np.abs(distances[cloud, j] - sides[2]) <= allowed
    pair, k = np.nonzero(fits)
    return cloud[pair], np.column_stack([i[pair], j[pair], k])


def motions(source: Floats, targets: Floats) -> Floats:
    """Fit proper rigid motions (K, 4, 4) of points (n, 3) onto points (K, n, 3) by least squares.

    Kabsch, Acta Cryst. A32 (1976) 922.
    """
    a, b = source.mean(axis=0), targets.mean(axis=1)
    U, _, Vt = np.linalg.svd(np.swapaxes(targets - b[:, None], 1, 2) @ (source - a))
    proper = np.ones((len(targets), 3))
    proper[:, 2] = np.linalg.det(U @ Vt)
    R = (U * proper[:, None]) @ Vt
    return from_parts(R, b - R @ a)


def _is_known(R: Floats, rotations: list[Floats] | Floats) -> bool:
    """Test whether a rotation is within a degree of one of others."""
    return bool(np.einsum("ij,kij->k", R, np.array(rotations)).max() > 1 + 2 * np.cos(_SAME_TURN))
