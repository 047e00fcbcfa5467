"""Poses from three points of the body and their places, or rays that meet in one centre (P3P).

The distances λ along the rays solve three quadratic equations
``λ_i² + λ_j² − 2 λ_i λ_j cos_ij = d_ij²``.  Two combinations without constant term are conics in
the ratios of the λ; a member of their pencil that falls apart into two lines (a root of a cubic)
is cut with another, which leaves two quadratic equations: at most four solutions
(Persson and Nordberg, Lambda Twist, ECCV 2018).

Numbers of one kind lie together (a row per coordinate, a column per problem): the arithmetic then
runs over long rows.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mixpose.records import Floats, Indices
from mixpose.rigid import from_parts

_TINY = np.finfo(np.float64).tiny
_ROUNDING = np.sqrt(np.finfo(np.float64).eps)  # what is left of differences of like numbers

SIDES = ((0, 1), (0, 2), (1, 2))
FIRST, SECOND = np.transpose(SIDES)


def gathered(points: Floats, corners: Indices) -> Floats:
    """Corners (3, 3, K) of triangles, given as indices (3, K) of points (n, 3)."""
    return np.take(points.T, corners, axis=1).swapaxes(0, 1)


def align_triples(body: Floats, world: Floats) -> Floats:
    """Rigid motions that bring triangles onto triangles of about the same shape.

    Parameters
    ----------
    body, world : (3, 3, K) array
        Corners of the triangles: corner, coordinate, triangle.

    Returns
    -------
    (K, 4, 4) array
        T_world_object: centres coincide, planes coincide, and within the plane the turn is the
        least-squares one.
    """
    (x, y, z), side, third = _shape(body)
    axes, side_world, third_world = _shape(world)
    # between the corners as seen from their centres, in the planes
    turn = side * side_world + third.conj() * third_world
    turn -= (side + third).conj() * (side_world + third_world) / 3
    length = np.abs(turn)
    turn = np.where(length < _TINY, 1.0, turn / np.maximum(length, _TINY))
    c, s = turn.real, turn.imag
    R = axes[0][:, None] * (c * x - s * y)
    R += axes[1][:, None] * (s * x + c * y)
    R += axes[2][:, None] * z
    t = world.mean(axis=0) - np.einsum("ijk,jk->ik", R, body.mean(axis=0))
    return from_parts(R.transpose(2, 0, 1), t.T)


def _shape(triangles: Floats) -> tuple[tuple[Floats, ...], Floats, NDArray[np.complex128]]:
    """Axes (3, K each), the first side's length (K,), and the third corner in the plane, x + iy."""
    side, second = triangles[1] - triangles[0], triangles[2] - triangles[0]
    length = np.sqrt(_dot(side, side))
    x = side / np.maximum(length, _TINY)
    x[0, length == 0] = 1.0  # two at one place: any direction
    across = cross(x, second)
    height = np.sqrt(_dot(across, across))
    third = _dot(x, second) + 1j * height
    flat = height <= _ROUNDING * np.abs(third)
    if flat.any():  # three in a row: any plane through them
        across = np.where(flat, cross(x, np.eye(3)[:, np.abs(x).argmin(axis=0)]), across)
        height = np.sqrt(_dot(across, across))
    z = across / np.maximum(height, _TINY)
    return (x, cross(z, x), z), length, third


def cross(a: Floats, b: Floats) -> Floats:
    """Cross products of vectors (3, ...)."""
    return np.array(
        [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
    )


def _dot(a: Floats, b: Floats) -> Floats:
    return np.asarray(a[0] * b[0] + a[1] * b[1] + a[2] * b[2])


def depths(cosines: Floats, squared: Floats) -> tuple[Floats, Indices]:
    """Distances from the centre to three points of a triangle.

    Parameters
    ----------
    cosines : (3, K) array
        Of the angles between rays 0 and 1, 0 and 2, 1 and 2.
    squared : (3, K) array
        Squared distances between points 0 and 1, 0 and 2, 1 and 2.

    Returns
    -------
    (3, S) array
        Positive distances of every solution.
    (S,) int array
        The problem that it solves.
    """
    with np.errstate(all="ignore"):
        D1, D2 = _conics(cosines, squared)
        larger = np.where(np.abs(D1).sum(axis=(0, 1)) >= np.abs(D2).sum(axis=(0, 1)), D1, D2)
        found = []
        for line in _two_lines(D1 + _pencil_root(D1, D2) * D2):
            for ratios in _cut(line, larger):
                # made distances by the sum of the three cosine laws
                sides, _ = _sides_squared(ratios, cosines)
                scale = np.sqrt(squared.sum(axis=0) / sides.sum(axis=0))
                found.append(ratios * (np.sign(ratios[0]) * scale))
        x = np.concatenate(found, axis=1)
        which = np.flatnonzero((x > 0).all(axis=0))
        x, which = x[:, which], which % cosines.shape[1]
        return _polished(x, which, cosines[:, which], squared[:, which])


def _conics(cosines: Floats, squared: Floats) -> tuple[Floats, Floats]:
    """M01 d12² − M12 d01² and M02 d12² − M12 d02² (3, 3, K), where λᵀ M_ij λ = d_ij²."""
    (c01, c02, c12), (a01, a02, a12) = -cosines, squared
    o = np.zeros_like(a01)
    D1 = [[a12, c01 * a12, o], [c01 * a12, a12 - a01, -c12 * a01], [o, -c12 * a01, -a01]]
    D2 = [[a12, o, c02 * a12], [o, -a02, -c12 * a02], [c02 * a12, -c12 * a02, a12 - a02]]
    return np.array(D1), np.array(D2)


def _cofactors(A: Floats) -> Floats:
    return np.array([cross(A[1], A[2]), cross(A[2], A[0]), cross(A[0], A[1])])


def _pencil_root(D1: Floats, D2: Floats) -> Floats:
    """A real γ with det(D1 + γ D2) = 0 (K,), of three the one farthest from the others."""
    A1, A2 = _cofactors(D1), _cofactors(D2)
    d, c, b, a = (
        np.einsum("ijk,ijk->k", A, D) for A, D in ((A1, D1), (A1, D2), (A2, D1), (A2, D2))
    )
    a = np.where(a == 0, _TINY, a / 3)
    b, c, d = b / a, c / a, d / (3 * a)
    p, q = c - b * b / 3, (2 * b * b / 27 - c / 3) * b + d
    # from beyond the root on the side of −q, which stands alone, Newton steps fall short of it
    x = np.where(q <= 0, 1.0, -1.0) * (np.sqrt(np.maximum(-p, 0.0) * 4 / 3) + np.cbrt(np.abs(q)))
    x -= b / 3
    for _ in range(7):
        step = (((x + b) * x + c) * x + d) / ((3 * x + 2 * b) * x + c)
        x -= np.where(np.isfinite(step), step, 0.0)
    return np.where(np.isfinite(x), x, 0.0)


def _two_lines(C: Floats) -> tuple[Floats, Floats]:
    """The lines (3, K) that degenerate conics (3, 3, K) consist of; NaN where they are not real."""
    B, every = -_cofactors(C), np.arange(C.shape[2])
    diagonal = np.einsum("iik->ik", B)
    k = diagonal.argmax(axis=0)
    N = C + _crossed(B[:, k, every] / np.sqrt(diagonal[k, every]))
    row, column = np.divmod(np.abs(N).reshape(9, -1).argmax(axis=0), 3)
    return N[row, [[0], [1], [2]], every], N[:, column, every]


def _crossed(v: Floats) -> Floats:
    """Matrices (3, 3, K) by which cross products with vectors (3, K) are taken."""
    (x, y, z), o = v, np.zeros_like(v[0])
    return np.array([[o, -z, y], [z, o, -x], [-y, x, o]])


def _cut(line: Floats, C: Floats) -> tuple[Floats, Floats]:
    """Where lines (3, K) meet conics (3, 3, K): two times ratios (3, K), NaN where not real."""
    # two points that span the line: its cross products with the axes that it is least along
    by, most = _crossed(line), np.abs(line).argmax(axis=0)
    P = np.where(most == 0, by[:, 1], by[:, 0])
    Q = np.where(most == 2, by[:, 1], by[:, 2])
    CP, CQ = (np.einsum("ijk,jk->ik", C, each) for each in (P, Q))
    a, b, c = (Q * CQ).sum(axis=0), (P * CQ).sum(axis=0), (P * CP).sum(axis=0)
    square = b * b - a * c
    square = np.where(square < -_ROUNDING * b * b, np.nan, np.maximum(square, 0.0))
    w = -(b + np.copysign(np.sqrt(square), b))
    # w/a and c/w, as homogeneous pairs so that neither division can fail
    return a * P + w * Q, w * P + c * Q


def _polished(
    x: Floats, which: Indices, cosines: Floats, squared: Floats
) -> tuple[Floats, Indices]:
    """Newton steps on the three cosine laws, and the solutions that satisfy them in the end."""
    o = np.zeros_like(x[0])
    for _ in range(2):  # Newton's method doubles the digits each time
        sides, (a, b, c, d, e, f) = _sides_squared(x, cosines)
        J = np.array([[a, b, o], [c, o, d], [o, e, f]])
        cofactors = _cofactors(J)
        step = np.einsum("ijk,ik->jk", cofactors, sides - squared)
        step /= 2 * (J[0] * cofactors[0]).sum(axis=0)
        x = x - np.where(np.isfinite(step), np.clip(step, -0.1 * x, 0.1 * x), 0.0)
    off = np.abs(_sides_squared(x, cosines)[0] - squared)
    # steps from double roots end a thousandth off
    exact = ((off <= 1e-3 * squared.max(axis=0)) & (x > 0)).all(axis=0)
    return x[:, exact], which[exact]


def _sides_squared(x: Floats, cosines: Floats) -> tuple[Floats, list[Floats]]:
    """Sides squared (3, K) by the cosine laws, and half their slopes by either distance."""
    sides, slopes = np.empty_like(x), []
    for k, (i, j) in enumerate(SIDES):
        slopes += [x[i] - x[j] * cosines[k], x[j] - x[i] * cosines[k]]
        sides[k] = x[i] * slopes[-2] + x[j] * slopes[-1]
    return sides, slopes
