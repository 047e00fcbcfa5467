"""Poses of three points from three rays that meet in one centre (P3P), in bulk.

The distances λ along the rays solve three quadratic equations
``λ_i² + λ_j² − 2 λ_i λ_j cos_ij = d_ij²``.  Two combinations without constant term are conics in
the ratios of the λ; a member of their pencil that falls apart into two lines (a root of a cubic)
is cut with another, which leaves two quadratic equations: at most four solutions
(Persson and Nordberg, Lambda Twist, ECCV 2018).

Numbers of one kind lie together (a row per coordinate, a column per problem): the arithmetic then
runs over long rows.
"""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from mixpose.records import Floats

Mask: TypeAlias = NDArray[np.bool_]
Indices: TypeAlias = NDArray[np.intp]

_POLISHING = 2  # Newton steps on the distances
_ROUNDING = 1e-9  # a discriminant this little below zero is a double root
_INEXACT = 1e-3  # share of the squared distances that a solution may miss them by

# A symmetric 3x3 matrix is its entries (00, 01, 02, 11, 12, 22); sides are (01, 02, 12).
SIDES = ((0, 1), (0, 2), (1, 2))


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
        gamma = _pencil_root(D1, D2)
        found = [
            ratios
            for line in _two_lines(D1 + gamma * D2)
            for ratios in _cut(line, np.where(_larger(D1, D2), D1, D2))
        ]
        scaled = [_scaled(ratios, cosines, squared) for ratios in found]
        good = [(solution > 0).all(axis=0) for solution in scaled]
        which = np.concatenate([np.flatnonzero(each) for each in good])
        solved = np.concatenate([s[:, g] for s, g in zip(scaled, good)], axis=1)
        polished, exact = _polish(solved, cosines[:, which], squared[:, which])
    return polished[:, exact], which[exact]


def _conics(cosines: Floats, squared: Floats) -> tuple[Floats, Floats]:
    """M01 d12² − M12 d01² and M02 d12² − M12 d02² (6, K each), where λᵀ M_ij λ = d_ij²."""
    c01, c02, c12 = cosines
    a01, a02, a12 = squared
    zero = np.zeros_like(c01)
    D1 = np.array([a12, -c01 * a12, zero, a12 - a01, c12 * a01, -a01])
    D2 = np.array([a12, zero, -c02 * a12, -a02, c12 * a02, a12 - a02])
    return D1, D2


def _larger(D1: Floats, D2: Floats) -> Mask:
    return np.asarray(np.abs(D1).sum(axis=0) >= np.abs(D2).sum(axis=0))


def _pencil_root(D1: Floats, D2: Floats) -> Floats:
    """A real γ with det(D1 + γ D2) = 0 (K,)."""
    A1, A2 = _adjugate(D1), _adjugate(D2)
    c3, c0 = _product(A2, D2) / 3, _product(A1, D1) / 3
    c2, c1 = _product(A2, D1), _product(A1, D2)
    c3 = np.where(c3 == 0, np.finfo(np.float64).tiny, c3)
    return _cubic_root(c2 / c3, c1 / c3, c0 / c3)


def _adjugate(A: Floats) -> Floats:
    a, b, c, d, e, f = A
    return np.array(
        [d * f - e * e, c * e - b * f, b * e - c * d, a * f - c * c, b * c - a * e, a * d - b * b]
    )


def _product(A: Floats, B: Floats) -> Floats:
    """Trace of the product of symmetric matrices."""
    off = A[1] * B[1] + A[2] * B[2] + A[4] * B[4]
    return np.asarray(A[0] * B[0] + A[3] * B[3] + A[5] * B[5] + 2 * off)


def _cubic_root(b: Floats, c: Floats, d: Floats) -> Floats:
    """A real root of x³ + b x² + c x + d, of three the one farthest from the others."""
    p = c - b * b / 3
    q = (2 * b * b / 27 - c / 3) * b + d
    discriminant = q * q / 4 + p * p * p / 27
    # the larger of Cardano's two cube roots, without cancellation; the other follows from p
    u = -np.cbrt(np.abs(q) / 2 + np.sqrt(np.maximum(discriminant, 0.0)))
    u = np.where(q < 0, -u, u)
    single = u - p / np.where(u == 0, 1.0, 3 * u)
    amplitude = 2 * np.sqrt(np.maximum(-p, 0.0) / 3)
    angle = np.arccos(np.clip(np.abs(4 * q) / amplitude**3, -1.0, 1.0)) / 3
    # of three roots the one on the side of −q stands alone
    triple = np.where(q <= 0, 1.0, -1.0) * amplitude * np.cos(angle)
    x = np.where(discriminant >= 0, single, triple) - b / 3
    for _ in range(2):
        slope = (3 * x + 2 * b) * x + c
        step = (((x + b) * x + c) * x + d) / slope
        x = x - np.where(np.isfinite(step), step, 0.0)
    return np.asarray(np.where(np.isfinite(x), x, 0.0))


def _two_lines(conic: Floats) -> tuple[Floats, Floats]:
    """The lines (3, K) that degenerate conics (6, K) consist of; NaN where they are not real."""
    B = -_adjugate(conic)
    diagonal = B[[0, 3, 5]]
    column = diagonal.argmax(axis=0)
    full = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])
    which = np.arange(B.shape[1])
    p = B[full[column].T, which] / np.sqrt(diagonal[column, which])
    N = conic[[0, 1, 2, 1, 3, 4, 2, 4, 5]]
    for entry, k, sign in ((1, 2, -1), (2, 1, 1), (3, 2, 1), (5, 0, -1), (6, 1, -1), (7, 0, 1)):
        N[entry] += sign * p[k]
    largest = np.abs(N).argmax(axis=0)
    row, column = largest // 3, largest % 3
    first = N[3 * row + np.arange(3)[:, None], which]
    second = N[3 * np.arange(3)[:, None] + column, which]
    return first, second


def _cut(line: Floats, conic: Floats) -> tuple[Floats, Floats]:
    """Where lines (3, K) meet conics (6, K): two times ratios (3, K), NaN where not real."""
    # two points that span the line: its cross products with the axes that it is least along
    x, y, z = line
    zero = np.zeros_like(x)
    by_x, by_y, by_z = (np.array(p) for p in ([zero, z, -y], [-z, zero, x], [y, -x, zero]))
    most = np.abs(line).argmax(axis=0)
    P = np.where(most == 0, by_y, by_x)
    Q = np.where(most == 2, by_y, by_z)
    a, b, c = _form(Q, conic, Q), _form(P, conic, Q), _form(P, conic, P)
    squared = b * b - a * c
    squared = np.where(squared < -_ROUNDING * b * b, np.nan, np.maximum(squared, 0.0))
    root = np.sqrt(squared)
    w = -(b + np.where(b < 0, -root, root))
    # w/a and c/w, as homogeneous pairs so that neither division can fail
    return a * P + w * Q, w * P + c * Q


def _form(P: Floats, conic: Floats, Q: Floats) -> Floats:
    a, b, c, d, e, f = conic
    x = a * Q[0] + b * Q[1] + c * Q[2]
    y = b * Q[0] + d * Q[1] + e * Q[2]
    z = c * Q[0] + e * Q[1] + f * Q[2]
    return np.asarray(P[0] * x + P[1] * y + P[2] * z)


def _scaled(ratios: Floats, cosines: Floats, squared: Floats) -> Floats:
    """Ratios made distances by the sum of the three cosine laws."""
    x, y, z = ratios
    total = 2 * (x * x + y * y + z * z)
    total -= 2 * (x * y * cosines[0] + x * z * cosines[1] + y * z * cosines[2])
    return np.asarray(ratios * (np.sign(x) * np.sqrt(squared.sum(axis=0) / total)))


def _polish(found: Floats, cosines: Floats, squared: Floats) -> tuple[Floats, Mask]:
    """Newton steps on the three cosine laws, and which solutions satisfy them in the end."""
    x = found
    for _ in range(_POLISHING):
        (a, b, d), J = _law_residuals(x, cosines, squared)
        # rows (J0 J1 0), (J2 0 J3), (0 J4 J5) by Cramer's rule
        determinant = -J[0] * J[3] * J[4] - J[1] * J[2] * J[5]
        step = np.array(
            [
                -J[3] * J[4] * a - J[1] * J[5] * b + J[1] * J[3] * d,
                -J[2] * J[5] * a + J[0] * J[5] * b - J[0] * J[3] * d,
                J[2] * J[4] * a - J[0] * J[4] * b - J[1] * J[2] * d,
            ]
        )
        step = np.clip(step / determinant, -0.1 * x, 0.1 * x)
        x = x - np.where(np.isfinite(step), step, 0.0)
    residual, _ = _law_residuals(x, cosines, squared)
    exact = (np.abs(residual) <= _INEXACT * squared.max(axis=0)).all(axis=0)
    return x, exact & (x > 0).all(axis=0)


def _law_residuals(x: Floats, cosines: Floats, squared: Floats) -> tuple[Floats, list[Floats]]:
    """Residuals (3, K) of the laws of sides 01, 02, 12, and their slopes by either distance."""
    residuals, slopes = [], []
    for k, (i, j) in enumerate(SIDES):
        along_i, along_j = x[i] - x[j] * cosines[k], x[j] - x[i] * cosines[k]
        residuals.append(x[i] * along_i + x[j] * along_j - squared[k])
        slopes += [2 * along_i, 2 * along_j]
    return np.array(residuals), slopes
