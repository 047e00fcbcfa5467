"""Poses from three points of the body and where they are in the world, in bulk."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mixpose.records import Floats
from mixpose.rigid import from_parts

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
    centre_body, centre_world = body.mean(axis=0), world.mean(axis=0)
    plane_body, normal_body = _axes(body)
    plane_world, normal_world = _axes(world)
    flat_body = (plane_body * (body - centre_body)).sum(axis=1)
    flat_world = (plane_world * (world - centre_world)).sum(axis=1)
    turn = (flat_body.conj() * flat_world).sum(axis=0)
    length = np.abs(turn)
    turn = np.where(length < _TINY, 1.0, turn / np.maximum(length, _TINY))
    R = (plane_world.conj()[:, None] * (turn * plane_body)).real
    R += normal_world[:, None] * normal_body
    t = centre_world - (R * centre_body).sum(axis=1)
    return from_parts(R.transpose(2, 0, 1), t.T)


def _axes(triangles: Floats) -> tuple[NDArray[np.complex128], Floats]:
    """Axes x + iy of the planes (3, K), x along the first side, and their normals (3, K)."""
    x = _unit(triangles[1] - triangles[0])
    x = np.where(x.any(axis=0), x, np.eye(3)[:, :1])  # two at one place: any direction
    second = triangles[2] - triangles[0]
    across = cross(x, second)
    flat = (across**2).sum(axis=0) <= _FLAT**2 * (second**2).sum(axis=0)
    if flat.any():  # three in a row: any plane through them
        across = np.where(flat, cross(x, np.eye(3)[:, np.abs(x).argmin(axis=0)]), across)
    z = _unit(across)
    return x + 1j * cross(z, x), z


def cross(a: Floats, b: Floats) -> Floats:
    """Cross products of vectors (3, ...)."""
    return np.array(
        [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
    )


def _unit(vectors: Floats) -> Floats:
    return np.asarray(vectors / np.maximum(np.sqrt((vectors**2).sum(axis=0)), _TINY))
