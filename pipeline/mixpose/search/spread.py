"""Which few stand for many: features far from one another, orientations spread evenly."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from mixpose.body import Body
from mixpose.records import Floats


@lru_cache(maxsize=32)
def sparse(body: Body, count: int) -> Body:
    """A body with `count` of its features, far from one another; itself where it has no more."""
    if len(body) <= count or len(body.nodes.points) != len(body):
        return body
    few = far_apart(body.means, count)
    normals = None if body.normals is None else body.normals[few]
    return Body(body.name, tuple(body.features[k] for k in few), normals, body.gravity)


def far_apart(points: Floats, count: int) -> NDArray[np.intp]:
    """Indices of points that are far from one another, starting at the outermost."""
    count = min(count, len(points))
    chosen = [int(np.linalg.norm(points - points.mean(axis=0), axis=1).argmax())]
    distance = np.linalg.norm(points - points[chosen[0]], axis=1)
    while len(chosen) < count:
        chosen.append(int(distance.argmax()))
        distance = np.minimum(distance, np.linalg.norm(points - points[chosen[-1]], axis=1))
    return np.array(chosen, dtype=np.intp)


def spread_rotations(count: int) -> Floats:
    """Rotation matrices (count, 3, 3), a super-Fibonacci spiral over all orientations.

    M. Alexa, Super-Fibonacci Spirals: Fast, Low-Discrepancy Sampling of SO(3), CVPR 2022.
    """
    s = np.arange(count) + 0.5
    r, R = np.sqrt(s / count), np.sqrt(1 - s / count)
    alpha, beta = 2 * np.pi * s / np.sqrt(2.0), 2 * np.pi * s / 1.533751168756204288118041
    quaternions = np.stack(
        [r * np.sin(alpha), r * np.cos(alpha), R * np.sin(beta), R * np.cos(beta)], axis=1
    )
    return np.asarray(Rotation.from_quat(quaternions).as_matrix(), dtype=np.float64)


def spread_turns(free: NDArray[np.bool_], step: float) -> Floats:
    """Turns (count, 3, 3) about the free world axes (3,), about `step` radians apart."""
    around = int(free.sum())
    if around == 3:
        return spread_rotations(int(np.ceil(np.pi**2 * 1.5 / step**3)))
    if around == 0:
        return np.eye(3)[None]
    steps = int(np.ceil(2 * np.pi / step))
    angles = -np.pi + 2 * np.pi * np.arange(steps) / steps
    grid = np.stack(np.meshgrid(*([angles] * around), indexing="ij"), axis=-1).reshape(-1, around)
    vectors = np.zeros((len(grid), 3))
    vectors[:, free] = grid
    vectors = vectors[np.linalg.norm(vectors, axis=1) <= np.pi + 1e-9]
    return np.asarray(Rotation.from_rotvec(vectors).as_matrix(), dtype=np.float64)
