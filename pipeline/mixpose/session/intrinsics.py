"""Read the parts of a calibration, in any format: matrix, distortion, image size and motion."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias

import numpy as np

from mixpose.records import Floats
from mixpose.rigid import from_parts
from mixpose.session.messages import BadKeyError, mismatch, one_of, under
from mixpose.session.motion import rigid, rotation_of_vector
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
