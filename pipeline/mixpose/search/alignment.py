"""Poses from three points of the body and where they are in the world, in bulk."""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from mixpose.records import Floats
from mixpose.rigid import from_parts

Complex: TypeAlias = NDArray[np.complex128]

_TINY = np.finfo(np.float64).tiny
_FLAT = 1e-9  # sine of the angle at a corner, below which a triangle has no plane


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


def _shape(triangles: Floats) -> tuple[tuple[Floats, Floats, Floats], Floats, Complex]:
    """Axes (3, K each), the first along the first side, the second in the plane.

    With them, the first side's length (K,) and the third corner in the plane, as x + iy.
    """
    side, second = triangles[1] - triangles[0], triangles[2] - triangles[0]
    length = np.sqrt(_dot(side, side))
    x = side / np.maximum(length, _TINY)
    x[0, length == 0] = 1.0  # two at one place: any direction
    across = cross(x, second)
    height = np.sqrt(_dot(across, across))
    third = _dot(x, second) + 1j * height
    flat = height <= _FLAT * np.abs(third)
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
