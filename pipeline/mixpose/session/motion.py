"""Read rigid motions of a session file: a matrix, or a rotation and a translation."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from mixpose.records import Floats
from mixpose.rigid import from_parts, is_rigid, nearest_rigid
from mixpose.session.messages import BadKeyError, one_of
from mixpose.session.schema_sensors import Placement

ROUNDING = 2e-4  # a rotation of four decimals misses R Rᵀ = 1 by up to 2·√3·0.5e-4
_QUATERNION_LENGTH = 2e-3  # three decimals suffice, as the length does not change the rotation
_ROTATIONS = ("rotation_vector", "quaternion_xyzw", "euler_xyz_deg")


def read_motion(table: Placement, matrix_key: str) -> Floats | None:
    """Read the rigid motion (4, 4) in a table, made exactly rigid; None if there is none.

    `matrix_key` is the key of the 4x4 form: "T_world_object" or "T_sensor_world". Raises
    BadKeyError for two forms, an incomplete form, and a matrix that is no rigid motion.
    """
    possible = [key for key in _ROTATIONS if key in type(table).model_fields]
    rotations = [key for key in possible if getattr(table, key) is not None]
    matrix = getattr(table, matrix_key)
    forms = [matrix_key] * (matrix is not None) + rotations
    if len(forms) > 1:
        raise BadKeyError(f"stands beside {forms[0]}; allowed: one of the two", forms[1])
    if matrix is not None:
        if table.translation is not None:
            raise BadKeyError(f"stands beside {matrix_key}, which holds one too", "translation")
        return rigid(matrix, matrix_key)
    if not rotations:
        if table.translation is not None:
            raise BadKeyError(
                f"stands without a rotation; add one of {one_of(possible)}", "translation"
            )
        return None
    if table.translation is None:
        raise BadKeyError("missing; a rotation needs translation = [x, y, z]", "translation")
    rotation = _rotation(rotations[0], getattr(table, rotations[0]))
    return from_parts(rotation.as_matrix(), table.translation)


def rigid(matrix: Floats, key: str) -> Floats:
    """Return a matrix (4, 4) without rounding errors; raise BadKeyError if it is not rigid."""
    if is_rigid(matrix, ROUNDING):
        return nearest_rigid(matrix)
    R = matrix[:3, :3]
    if not np.allclose(matrix[3], [0, 0, 0, 1], atol=ROUNDING):
        reason = "its last row is not [0, 0, 0, 1]"
        if np.allclose(matrix[:, 3], [0, 0, 0, 1], atol=ROUNDING):
            reason += " but its last column is: transpose it"
    elif not np.allclose(R @ R.T, np.eye(3), atol=ROUNDING):
        error = np.abs(R @ R.T - np.eye(3)).max()
        reason = f"its rows are not orthonormal, R Rᵀ misses the identity by {error:.2g}"
    else:
        reason = "it mirrors, its determinant is -1"
    raise BadKeyError(
        f"found no rigid motion: {reason}; allowed: a rotation and a translation", key
    )


def rotation_of_vector(values: Floats, key: str) -> Rotation:
    """Return the rotation of a vector (3,); refuse one that is so long that it is in degrees."""
    angle = float(np.linalg.norm(values))
    if angle > 2 * np.pi:
        raise BadKeyError(
            f"found an angle of {angle:.6g} radians; allowed: axis times angle in radians, at most "
            "a full turn, 6.283",
            key,
        )
    return Rotation.from_rotvec(values)


def _rotation(key: str, values: Floats) -> Rotation:
    if key == "rotation_vector":
        return rotation_of_vector(values, key)
    if key == "euler_xyz_deg":
        # turns about the fixed axes, x first: the paper's R3 R2 R1
        return Rotation.from_euler("xyz", values, degrees=True)
    length = float(np.linalg.norm(values))
    if abs(length - 1) > _QUATERNION_LENGTH:
        raise BadKeyError(f"found a quaternion of length {length:.6g}; allowed: length 1", key)
    return Rotation.from_quat(values)
