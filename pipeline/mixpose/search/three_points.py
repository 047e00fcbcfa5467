"""Make guesses from three features: at three points in space, or on three rays of one camera.

For rays that meet in one centre (P3P) the distances λ along the rays solve three equations
``λ_i² + λ_j² − 2 λ_i λ_j cos_ij = d_ij²``.  Two combinations without constant term are conics in
the ratios of the λ; a member of their pencil that falls apart into two lines (a root of a cubic)
is cut with another, which leaves two quadratic equations: at most four solutions
(Persson and Nordberg, Lambda Twist, ECCV 2018).

Arrays have a row per coordinate and a column per problem, so that arithmetic runs over long rows.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from itertools import product
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from mixpose.body import Body
from mixpose.records import Floats, Indices
from mixpose.rigid import cross, from_parts
from mixpose.search.problem import SearchProblem
from mixpose.search.triples import ray_triples
from mixpose.sensors import Rays

# batches of poses (K, 4, 4), computed when they are called, so that skipped ones cost nothing
Guesses: TypeAlias = Iterator[Callable[[], Floats]]

_TINY = np.finfo(np.float64).tiny

SIDES = [(0, 1), (0, 2), (1, 2)]
_EACH, (FIRST, SECOND) = np.arange(len(SIDES)), np.transpose(SIDES)


def corners_of(points: Floats, corners: Indices) -> Floats:
    """Return the corners (3, 3, K) of triangles, given as indices (3, K) of points (n, 3)."""
    return np.take(points.T, corners, axis=1).swapaxes(0, 1)


def align_triples(body: Floats, world: Floats) -> Floats:
    """Return T_world_object (K, 4, 4) that bring triangles onto others of about the same shape.

    Corners are (3, 3, K): corner, coordinate, triangle.  Centres and planes coincide; within the
    plane the turn is the least-squares one.
    """
    (x, y, z), side, third = _shape(body)
    axes, side_world, third_world = _shape(world)
    # turn in the plane that brings corners, as seen from their centres, closest together
    turn = side * side_world + third.conj() * third_world
    turn -= (side + third).conj() * (side_world + third_world) / 3
    turn = np.where(turn == 0, 1.0, turn)
    turn /= np.abs(turn)
    c, s = turn.real, turn.imag
    R = axes[0][:, None] * (c * x - s * y)
    R += axes[1][:, None] * (s * x + c * y)
    R += axes[2][:, None] * z
    t = world.mean(axis=0) - np.einsum("ijk,jk->ik", R, body.mean(axis=0))
    return from_parts(R.transpose(2, 0, 1), t.T)


def _shape(triangles: Floats) -> tuple[tuple[Floats, ...], Floats, NDArray[np.complex128]]:
    """Return axes (3, K) each, the first side's length (K,), and the third corner as x + iy."""
    side, second = triangles[1:] - triangles[0]
    length = np.sqrt(_dot(side, side))
    x = side / np.maximum(length, _TINY)
    x[0, length == 0] = 1.0  # two corners coincide: any direction
    across = cross(x, second)
    third = _dot(x, second) + 1j * np.sqrt(_dot(across, across))
    # corners on a line, to half of the digits: any plane through them
    flat = third.imag <= 2**-26 * np.abs(third)
    across[:, flat] = cross(x[:, flat], np.eye(3)[:, np.abs(x[:, flat]).argmin(axis=0)])
    z = across / np.sqrt(_dot(across, across))
    return (x, cross(z, x), z), length, third


def _dot(a: Floats, b: Floats) -> Floats:
    return np.asarray(a[0] * b[0] + a[1] * b[1] + a[2] * b[2])


def depths(cosines: Floats, squared: Floats) -> tuple[Floats, Indices]:
    """Return distances (3, S) from the centre to three points, and the problem (S,) they solve.

    Each of K problems has the cosines (3, K) of the angles between its rays, and the squared
    distances (3, K) between its points: 0 and 1, 0 and 2, 1 and 2.  Solutions are positive.
    """
    with np.errstate(all="ignore"):
        laws = np.zeros((3, 3, 3, cosines.shape[1]))  # λᵀ M λ = d²
        laws[_EACH, FIRST, FIRST] = laws[_EACH, SECOND, SECOND] = 1.0
        laws[_EACH, FIRST, SECOND] = laws[_EACH, SECOND, FIRST] = -cosines
        D1, D2 = (squared[2] * laws[k] - squared[k] * laws[2] for k in (0, 1))
        larger = np.where(np.abs(D1).sum(axis=(0, 1)) >= np.abs(D2).sum(axis=(0, 1)), D1, D2)
        lines = [line[:, None] for line in _halves(D1 + _pencil_root(D1, D2) * D2)]
        # the two points in which a line cuts the conic
        pairs = [cross(line, cross(line, larger).swapaxes(0, 1)) for line in lines]
        x = np.concatenate([ratios for pair in pairs for ratios in _halves(pair)], axis=1)
        x *= np.sign(x[0])
        which = np.flatnonzero((x > 0).all(axis=0))
        x, which = x[:, which], which % cosines.shape[1]
        cosines, squared = cosines[:, which], squared[:, which]
        # ratios become distances by the sum of the three cosine laws
        x *= np.sqrt(squared.sum(axis=0) / _sides_squared(x, cosines)[0].sum(axis=0))
        for _ in range(2):  # Newton's method doubles the digits each time
            sides, J = _sides_squared(x, cosines)
            cofactors = _cofactors(J)
            step = np.einsum("ijk,ik->jk", cofactors, sides - squared)
            step /= 2 * _dot(J[0], cofactors[0])
            x = x - np.where(np.isfinite(step), np.clip(step, -0.1 * x, 0.1 * x), 0.0)
        errors = np.abs(_sides_squared(x, cosines)[0] - squared)
        # steps from double roots end a thousandth off
        is_exact = ((errors <= 1e-3 * squared.max(axis=0)) & (x > 0)).all(axis=0)
        return x[:, is_exact], which[is_exact]


def _sides_squared(x: Floats, cosines: Floats) -> tuple[Floats, Floats]:
    """Return squared sides (3, K) by the cosine laws, and half their Jacobian (3, 3, K)."""
    J = np.zeros((3, *x.shape))
    J[_EACH, FIRST] = x[FIRST] - x[SECOND] * cosines
    J[_EACH, SECOND] = x[SECOND] - x[FIRST] * cosines
    return (J * x).sum(axis=1), J


def _cofactors(A: Floats) -> Floats:
    return np.array([cross(A[1], A[2]), cross(A[2], A[0]), cross(A[0], A[1])])


def _pencil_root(D1: Floats, D2: Floats) -> Floats:
    """Return a real γ (K,) with det(D1 + γ D2) = 0: of three the one farthest from the others."""
    A1, A2 = _cofactors(D1), _cofactors(D2)
    pairs = (A1, D1), (A1, D2), (A2, D1), (A2, D2)
    d, c, b, a = (np.einsum("ijk,ijk->k", A, D) for A, D in pairs)
    a = np.where(a == 0, _TINY, a / 3)
    b, c, d = b / a, c / a, d / (3 * a)
    p, q = c - b * b / 3, (2 * b * b / 27 - c / 3) * b + d
    # Newton steps that begin beyond the lone root, on the side of −q, approach it from that side
    x = np.where(q <= 0, 1.0, -1.0) * (np.sqrt(np.maximum(-p, 0.0) * 4 / 3) + np.cbrt(np.abs(q)))
    x -= b / 3
    for _ in range(7):
        step = (((x + b) * x + c) * x + d) / ((3 * x + 2 * b) * x + c)
        x -= np.where(np.isfinite(step), step, 0.0)
    return np.where(np.isfinite(x), x, 0.0)


def _halves(C: Floats) -> tuple[Floats, Floats]:
    """Split pairs of lines or points (3, 3, K) into the two (3, K); NaN where they are not real.

    A pair is g hᵀ + h gᵀ, whose cofactors are −p pᵀ with p = g × h; with [p]× it is of rank one.
    """
    B, columns = -_cofactors(C), np.arange(C.shape[2])
    diagonal = np.einsum("iik->ik", B)
    k = diagonal.argmax(axis=0)
    p = B[:, k, columns] / np.sqrt(diagonal[k, columns])
    N = C + cross(p[:, None], np.eye(3)[..., None])
    row, column = np.divmod(np.abs(N).reshape(9, -1).argmax(axis=0), 3)
    return N[row, :, columns].T, N[:, column, columns]


def from_three_rays(problem: SearchProblem, reach: float, rays: Rays) -> Guesses:
    """Yield poses from triples of one camera's rays, whose detections err by `reach` px at most."""
    solve = _perspective if rays.central else _orthographic
    for triples in ray_triples(problem, rays) if min(len(rays), len(problem.body)) > 2 else ():
        yield partial(solve, problem.body, reach, rays, *triples)


def _perspective(
    body: Body, reach: float, rays: Rays, detections: Indices, corners: Indices
) -> Floats:
    """Return the poses that put three features on three rays which meet in one centre."""
    features = body.means
    between = rays.directions @ rays.directions.T
    squared = ((features[corners[FIRST]] - features[corners[SECOND]]) ** 2).sum(axis=-1)
    distances, which = depths(between[detections[FIRST], detections[SECOND]], squared)
    # triangles smaller in the image than its errors fix no pose
    clear = np.sqrt(squared.max(axis=0))[which] > reach * rays.slope * distances.min(axis=0)
    distances, corners, detections = distances[:, clear], corners[:, which], detections[:, which]
    corners, detections = corners[:, clear], detections[:, clear]
    seen = corners_of(rays.directions, detections) * distances[:, None]
    poses = align_triples(corners_of(features, corners), rays.origins[0][:, None] + seen)
    if body.normals is None:
        return poses
    columns = np.ascontiguousarray(poses[:, :3, :3].transpose(2, 1, 0))
    normals = zip(corners_of(body.normals, corners), seen, strict=True)
    facing = [_dot(np.asarray(sum(map(np.multiply, n, columns))), ray) < 0 for n, ray in normals]
    return np.asarray(poses[np.all(facing, axis=0)])


def _orthographic(
    body: Body, reach: float, rays: Rays, detections: Indices, corners: Indices
) -> Floats:
    """Return the poses that put three features on parallel rays, by the depths of their sides.

    The depths must add up.  As the body's depth is not seen, its middle is on the sensor's plane.
    """
    features, seen = corners_of(body.means, corners), corners_of(rays.origins, detections)
    tolerance = 2 * reach * rays.offset
    length, flat = (np.linalg.norm(p[SECOND] - p[FIRST], axis=1) for p in (features, seen))
    rise = np.sqrt(np.maximum(length**2 - flat**2, 0.0))
    rise[flat > length + tolerance] = np.nan
    poses = []
    for sign, mirror in product((1.0, -1.0), repeat=2):
        good = np.abs(np.abs(rise[1] - sign * rise[0]) - rise[2]) <= tolerance
        depth = mirror * np.array([0 * rise[0], sign * rise[0], rise[1]])[:, None, good]
        world = seen[..., good] + (depth - depth.mean(axis=0)) * rays.directions[0][:, None]
        poses.append(align_triples(features[..., good], world))
    return np.concatenate(poses)
