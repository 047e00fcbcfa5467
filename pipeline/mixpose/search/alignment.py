"""Poses from three points of the body and where they are in the world, in bulk."""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

Floats: TypeAlias = NDArray[np.float64]

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
    from_centre_body, from_centre_world = body - centre_body, world - centre_world
    x_body, y_body, z_body = _frames(body)
    x_world, y_world, z_world = _frames(world)
    sine, cosine = np.zeros(body.shape[2]), np.zeros(body.shape[2])
    for a, b in zip(from_centre_body, from_centre_world):
        ax, ay, bx, by = _dot(a, x_body), _dot(a, y_body), _dot(b, x_world), _dot(b, y_world)
        sine += ax * by - ay * bx
        cosine += ax * bx + ay * by
    length = np.hypot(sine, cosine)
    undirected = length < _TINY
    cosine[undirected], length[undirected] = 1.0, 1.0  # all at one place: no turn is better
    c, s = cosine / length, sine / length
    turned_x, turned_y = c * x_body - s * y_body, s * x_body + c * y_body
    T = np.zeros((body.shape[2], 4, 4))
    for i in range(3):
        for j in range(3):
            T[:, i, j] = (
                x_world[i] * turned_x[j] + y_world[i] * turned_y[j] + z_world[i] * z_body[j]
            )
        T[:, i, 3] = centre_world[i] - (T[:, i, :3].T * centre_body).sum(axis=0)
    T[:, 3, 3] = 1.0
    return T


def _frames(triangles: Floats) -> tuple[Floats, Floats, Floats]:
    """Orthonormal axes (3, K each): along the first side, in the plane, across it."""
    x = _unit(triangles[1] - triangles[0])
    empty = ~x.any(axis=0)
    if empty.any():  # two at one place: any direction
        x = np.where(empty, np.array([[1.0], [0.0], [0.0]]), x)
    second = triangles[2] - triangles[0]
    across = cross(x, second)
    flat = _dot(across, across) <= _FLAT**2 * _dot(second, second)
    if flat.any():  # three in a row: any plane through them
        least = np.eye(3)[:, np.abs(x).argmin(axis=0)]
        across = np.where(flat, cross(x, least), across)
    z = _unit(across)
    return x, cross(z, x), z


def cross(a: Floats, b: Floats) -> Floats:
    """Cross products of vectors (3, ...)."""
    return np.array(
        [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
    )


def _dot(a: Floats, b: Floats) -> Floats:
    return np.asarray(a[0] * b[0] + a[1] * b[1] + a[2] * b[2])


def _unit(vectors: Floats) -> Floats:
    return np.asarray(vectors / np.maximum(np.sqrt(_dot(vectors, vectors)), _TINY))
