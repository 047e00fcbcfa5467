"""Rigid motions: the conventions of mixpose, stated once.

* `T_a_b` is a 4x4 float64 matrix that maps coordinates in frame b to frame a:
  ``x_a = T_a_b @ x_b``.  A pose is ``T_world_object``.  (The paper writes R(z + w): t = R w.)
* Quaternions are ``(x, y, z, w)``, unit length, with w >= 0.
* A small motion (twist) is ``(x, y, z, rx, ry, rz)`` in *world axes*, lengths then radians,
  as in ROS PoseWithCovariance: ``t <- t + (x, y, z)``, ``R <- exp([rx, ry, rz]) R``.  The turn
  is about the object's origin.  Covariances, gradients and curvatures use this order.
* Everything broadcasts over leading axes.

Rotations themselves are `scipy.spatial.transform.Rotation`.
"""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from mixpose.records import Floats

TWIST_NAMES = ("x", "y", "z", "rx", "ry", "rz")

_NEXT = np.array([1, 2, 0])  # the axis that follows each axis
CHI2_95 = {1: 3.841, 2: 5.991, 3: 7.815}  # 95 % quantiles of χ² by degrees of freedom
_HALF_TURN = 0.1  # twice the sine of 177°: nearer to half a turn axes by sines lose two digits


def transform(T_a_b: Floats, points_b: Floats) -> Floats:
    """Map points b (..., n, 3) to frame a by motions (..., 4, 4), broadcast over leading axes."""
    return points_b @ np.swapaxes(T_a_b[..., :3, :3], -1, -2) + T_a_b[..., None, :3, 3]


def from_parts(rotation: ArrayLike, translation: ArrayLike) -> Floats:
    """Assemble 4x4 motions from rotation matrices (..., 3, 3) and translations (..., 3)."""
    rotation = np.asarray(rotation, dtype=np.float64)
    translation = np.asarray(translation, dtype=np.float64)
    shape = np.broadcast_shapes(rotation.shape[:-2], translation.shape[:-1])
    T = np.zeros((*shape, 4, 4))
    T[..., :3, :3] = rotation
    T[..., :3, 3] = translation
    T[..., 3, 3] = 1.0
    return T


def from_rotation_vector(rotation_vector: ArrayLike, translation: ArrayLike) -> Floats:
    """Assemble 4x4 motions from rotation vectors (..., 3) in radians and translations (..., 3)."""
    return from_parts(rotation_matrix(rotation_vector), translation)


def from_orthonormal(V: ArrayLike, w: ArrayLike) -> Floats:
    """Return the paper's transformation x = Vᵀ(z + w), of V (3, 3) and w (3,), as a 4x4 motion.

    Raises `ValueError` if V is not orthonormal and right-handed within 1e-6.
    """
    R = np.asarray(V, dtype=np.float64).T
    T = from_parts(R, R @ np.asarray(w, dtype=np.float64))
    if not is_rigid(T, tolerance=1e-6):
        raise ValueError("V is not a right-handed orthonormal base, so that Vᵀ is no rotation")
    return T


def rotation_matrix(rotation_vector: ArrayLike) -> Floats:
    """Return rotation matrices (..., 3, 3) of rotation vectors (..., 3) in radians."""
    vectors = np.asarray(rotation_vector, dtype=np.float64)
    matrices = Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix()
    return np.asarray(matrices, dtype=np.float64).reshape(*vectors.shape[:-1], 3, 3)


def inverse(T_a_b: Floats) -> Floats:
    """Return the inverse motions T_b_a (..., 4, 4)."""
    R_b_a = np.swapaxes(T_a_b[..., :3, :3], -1, -2)
    return from_parts(R_b_a, -np.einsum("...ij,...j->...i", R_b_a, T_a_b[..., :3, 3]))


def perturb(T_world_object: Floats, twist: Floats) -> Floats:
    """Move poses (..., 4, 4) by twists (..., 6) in world axes, lengths and radians."""
    if twist.size == 6 and T_world_object.size == 16:
        # optimisers call this for one pose at a time: broadcasting would be slow
        T = T_world_object.copy()
        single, six = T.reshape(4, 4), twist.reshape(6)
        single[:3, :3] = cv2.Rodrigues(six[3:])[0] @ single[:3, :3]
        single[:3, 3] += six[:3]
        return T if T_world_object.ndim > twist.ndim else T.reshape(*twist.shape[:-1], 4, 4)
    rotation = rotation_matrix(twist[..., 3:]) @ T_world_object[..., :3, :3]
    return from_parts(rotation, T_world_object[..., :3, 3] + twist[..., :3])


def twist_between(T_from: Floats, T_to: Floats) -> Floats:
    """Return the twists (..., 6) with ``perturb(T_from, twist) == T_to``."""
    R_difference = T_to[..., :3, :3] @ T_from[..., :3, :3].swapaxes(-1, -2)
    if R_difference.ndim == 2:
        twist = np.empty(6)
        twist[:3] = T_to[:3, 3] - T_from[:3, 3]
        (a, b, c), (d, e, f), (g, h, i) = R_difference.tolist()
        twist[3:] = axis = h - f, c - g, d - b  # its length is twice the sine of the angle
        if (cosine := a + e + i - 1) > 0:  # twice the cosine; the angle is below 90°
            length = math.hypot(*axis)
            twist[3:] *= math.atan2(length, cosine) / length if length else 0.5
        else:
            twist[3:] = cv2.Rodrigues(R_difference)[0][:, 0]
        return twist
    if R_difference.shape == (1, 3, 3):
        return twist_between(T_from.reshape(4, 4), T_to.reshape(4, 4))[None]
    shift = T_to[..., :3, 3] - T_from[..., :3, 3]
    twists = np.empty((*R_difference.shape[:-2], 6))
    twists[..., :3] = shift
    twists[..., 3:] = _rotation_vectors(R_difference.reshape(-1, 3, 3)).reshape(shift.shape)
    return twists


def _rotation_vectors(R: Floats) -> Floats:
    """Return rotation vectors (K, 3) of rotation matrices (K, 3, 3)."""
    axes = (R - R.swapaxes(1, 2)).reshape(-1, 9).take([7, 2, 3], axis=1)  # as in `twist_between`
    lengths, cosines = np.sqrt(np.vecdot(axes, axes)), R.trace(axis1=1, axis2=2) - 1
    turned, angles = lengths > 0, np.arctan2(lengths, cosines)
    vectors = axes * np.divide(angles, lengths, out=np.full(len(R), 0.5), where=turned)[:, None]
    halves = (cosines < 0) & (lengths < _HALF_TURN)
    if np.count_nonzero(halves):
        vectors[halves] = Rotation.from_matrix(R[halves]).as_rotvec()
    return np.asarray(vectors)


def cross(a: Floats, b: Floats, axis: int = 0) -> Floats:
    """Return a × b of vectors with components along an axis; faster than NumPy's for few."""
    return (a * b.take(_NEXT, axis) - a.take(_NEXT, axis) * b).take(_NEXT, axis)


def covariance_at(covariance: Floats, arm: Floats) -> Floats:
    """Move a pose's covariance (..., 6, 6) from its origin by an arm (..., 3) in world axes."""
    J = twists_at(arm)
    return np.asarray(J @ covariance @ J.swapaxes(-1, -2))


def twists_at(arm: Floats) -> Floats:
    """Return matrices (..., 6, 6) to the twists of what is arms (..., 3) from the origin."""
    J = np.zeros((*np.shape(arm)[:-1], 6, 6))
    J.reshape(-1, 36)[:, ::7] = 1.0
    x, y, z = np.asarray(arm).T
    # a turn w moves the point by w × arm
    J[..., 0, 4], J[..., 0, 5], J[..., 1, 5] = z.T, -y.T, x.T
    J[..., 1, 3], J[..., 2, 3], J[..., 2, 4] = -z.T, y.T, -x.T
    return J


def rotation_angle_deg(T_a: Floats, T_b: Floats) -> Floats:
    """Return the angle in degrees (...,) of the rotation from one pose to the other."""
    angle = np.linalg.norm(twist_between(T_a, T_b)[..., 3:], axis=-1)
    return np.asarray(np.degrees(angle), dtype=np.float64)


def mean_motion(T: Floats) -> Floats:
    """Return the motion (4, 4) with the mean rotation and translation of motions (n, 4, 4)."""
    R = Rotation.from_matrix(T[:, :3, :3]).mean().as_matrix()
    return from_parts(R, T[:, :3, 3].mean(axis=0))


def position_ellipsoid_95(covariance: Floats) -> tuple[Floats, Floats]:
    """Return the 95 % ellipsoid of the position, from a pose's covariance (6, 6).

    Half-axes (3,), ascending, and their directions in world axes as columns (3, 3): a rotation.
    """
    variances, axes = np.linalg.eigh(covariance[:3, :3])
    axes[:, 0] *= np.linalg.det(axes)  # right-handed, so that it is a rotation
    return np.sqrt(CHI2_95[3] * np.maximum(variances, 0.0)), np.asarray(axes)


def quaternion_xyzw(T_a_b: Floats) -> Floats:
    """Return the unit quaternion (4,), (x, y, z, w) with w >= 0, of one motion."""
    # not by OpenCV, which rounds turns of less than 1e-5 rad to none
    return np.asarray(Rotation.from_matrix(T_a_b[:3, :3]).as_quat(canonical=True))


def is_rigid(T: Floats, tolerance: float = 1e-4) -> bool:
    """Test whether a 4x4 matrix is a rotation and a translation, within a tolerance per entry."""
    T = np.asarray(T, dtype=np.float64)
    return bool(
        T.shape == (4, 4)
        and np.all(np.isfinite(T))
        and np.allclose(T[3], [0, 0, 0, 1], atol=tolerance)
        and np.allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=tolerance)
        and np.linalg.det(T[:3, :3]) > 0
    )


def nearest_rigid(T: Floats) -> Floats:
    """Return the rigid motion nearest to a 4x4 matrix whose rotation has rounding errors."""
    U, _, Vt = np.linalg.svd(np.asarray(T, dtype=np.float64)[:3, :3])
    R = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
    return from_parts(R, np.asarray(T, dtype=np.float64)[:3, 3])
