"""Read the parts of a calibration in any format, and rigid motions in any of their forms."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias

import numpy as np
from scipy.spatial.transform import Rotation

from mixpose.records import Floats
from mixpose.rigid import from_parts, is_rigid, nearest_rigid
from mixpose.session.messages import BadKeyError, mismatch, one_of, under
from mixpose.session.schema_sensors import Placement
from mixpose.session.values import MATRIX_FORM, numbers, read_resolution

CameraModel: TypeAlias = Literal["pinhole", "fisheye"]

DISTORTION_COUNTS: dict[str, tuple[int, ...]] = {"pinhole": (4, 5, 8, 12, 14), "fisheye": (4,)}

# Names of Kalibr (radtan, equidistant) and ROS (the others); all have OpenCV's coefficients.
MODELS: dict[str, CameraModel] = {
    "radtan": "pinhole",
    "plumb_bob": "pinhole",
    "rational_polynomial": "pinhole",
    "none": "pinhole",
    "equidistant": "fisheye",
    "fisheye": "fisheye",
}

# No real camera is near these limits; beyond them squares of directions overflow.
SHORTEST_FOCAL_PX, LONGEST_FOCAL_PX = 1e-3, 1e9

ROUNDING = 2e-4  # a rotation of four decimals misses R Rᵀ = 1 by up to 2·√3·0.5e-4
_QUATERNION_LENGTH = 2e-3  # three decimals suffice, as the length does not change the rotation
_ROTATIONS = ("rotation_vector", "quaternion_xyzw", "euler_xyz_deg")


@dataclass(frozen=True)
class Intrinsics:
    """The intrinsic parameters of a camera in a calibration."""

    camera_matrix: Floats  # (3, 3)
    distortion: Floats  # (k,), OpenCV's order; empty for none
    resolution: tuple[int, int] | None = None  # width and height, px; None: not stated
    model: CameraModel | None = None  # the kind of camera; None: not stated


def read_camera_matrix(value: Any) -> Floats:
    """Read a camera matrix, three rows or nine numbers; raise BadKeyError if it cannot be one."""
    if isinstance(value, list) and len(value) == 9:
        K = numbers(value, (9,), f"nine numbers, {MATRIX_FORM} row by row").reshape(3, 3)
    else:
        K = numbers(value, (3, 3), MATRIX_FORM)
    if not np.allclose(K[2], [0, 0, 1], rtol=0, atol=1e-9) or K[1, 0] != 0:
        is_transposed = np.allclose(K[:, 2], [0, 0, 1], rtol=0, atol=1e-9)
        hint = "; transpose it" if is_transposed and not np.allclose(K[2, :2], 0) else ""
        raise BadKeyError(mismatch(K.tolist(), MATRIX_FORM) + hint)
    if K[0, 1] != 0 and K[0, 2] == 0:
        raise BadKeyError(mismatch(K.tolist(), MATRIX_FORM) + "; cx comes third")
    for axis, focal in (("fx", K[0, 0]), ("fy", K[1, 1])):
        if not SHORTEST_FOCAL_PX <= focal <= LONGEST_FOCAL_PX:
            raise BadKeyError(
                f"found the focal length {axis} = {focal:g}; allowed: greater than 0, in px, "
                f"from {SHORTEST_FOCAL_PX:g} to {LONGEST_FOCAL_PX:g}"
            )
    return K


def read_distortion(value: Any, model: str) -> Floats:
    """Read distortion coefficients of a model: a list, or a matrix of one row or column."""
    is_row = isinstance(value, list) and len(value) == 1 and isinstance(value[0], list)
    flat = value[0] if is_row else column_as_list(value)
    if flat is None or flat == []:
        return np.zeros(0)
    counts = DISTORTION_COUNTS[model]
    allowed = f"{' or '.join(map(str, counts))} numbers for model {model}, or none at all"
    coefficients = numbers(flat, (None,), allowed)
    if coefficients.size not in counts:
        raise BadKeyError(f"found {coefficients.size} coefficients; allowed: {allowed}")
    return coefficients


def column_as_list(value: Any) -> Any:
    """Return the numbers of a matrix of one column as a list; other values unchanged."""
    if isinstance(value, list) and all(isinstance(row, list) and len(row) == 1 for row in value):
        return [row[0] for row in value]
    return value


def motion_of(rotation: Any, translation: Any, *, key: str = "rotation") -> Floats:
    """Return the rigid motion (4, 4) of lists: a rotation matrix or vector, and a translation."""
    with under("translation"):
        t = numbers(column_as_list(translation), (3,), "[x, y, z]")
    rotation = column_as_list(rotation)
    allowed = "a rotation, three rows of three numbers or [x, y, z], axis times angle in radians"
    if isinstance(rotation, list) and len(rotation) == 9:
        rotation = [rotation[k : k + 3] for k in (0, 3, 6)]
    is_matrix = isinstance(rotation, list) and bool(rotation) and isinstance(rotation[0], list)
    with under(key):
        values = numbers(rotation, (3, 3) if is_matrix else (3,), allowed)
    if is_matrix:
        return rigid(from_parts(values, t), key)
    return from_parts(rotation_of_vector(values, key).as_matrix(), t)


def model_of_distortion(name: object) -> CameraModel | None:
    """Return the camera model of a distortion model of Kalibr or ROS; None if it is not stated."""
    if name is None or name == "":  # ROS writes "" for a camera without distortion
        return None
    if isinstance(name, str) and name in MODELS:
        return MODELS[name]
    raise BadKeyError(mismatch(name, one_of(MODELS)))


def required(content: dict[str, Any], key: str) -> Any:
    """Return the value of a key; raise BadKeyError if it is missing, never assume no distortion."""
    if key not in content:
        raise BadKeyError(f"missing; keys in the file: {', '.join(map(str, content))[:80]}")
    return content[key]


def with_numbers(value: Any) -> Any:
    """Return a value with text such as 1e-05, which YAML reads as text, converted to numbers."""
    if isinstance(value, list):
        return [with_numbers(item) for item in value]
    with suppress(ValueError):
        return float(value) if isinstance(value, str) else value
    return value


def size_of(value: Any) -> tuple[int, int] | None:
    """Return width and height; None if they are missing or, as some drivers write, zero."""
    return None if value in (None, [0, 0]) else read_resolution(value)


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
