"""Orientations spread evenly, and where the body must be for each to agree with all sensors."""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

Floats: TypeAlias = NDArray[np.float64]

_PHI = np.sqrt(2.0)
_PSI = 1.533751168755204288118041


def spread_rotations(count: int) -> Floats:
    """Rotation matrices (count, 3, 3), a super-Fibonacci spiral over all orientations.

    M. Alexa, Super-Fibonacci Spirals: Fast, Low-Discrepancy Sampling of SO(3), CVPR 2022.
    """
    s = np.arange(count) + 0.5
    r, R = np.sqrt(s / count), np.sqrt(1 - s / count)
    alpha, beta = 2 * np.pi * s / _PHI, 2 * np.pi * s / _PSI
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
