"""What several formats of calibration files have in them: motions, names of models, sizes."""

from __future__ import annotations

from contextlib import suppress
from typing import Any

from mixpose.records import Floats
from mixpose.rigid import from_parts
from mixpose.session.intrinsics import CameraModel, column_as_list
from mixpose.session.messages import BadKeyError, found, one_of, under
from mixpose.session.motion import rigid, rotation_of_vector
from mixpose.session.values import numbers, resolution

# Kalibr calls them radtan and equidistant, ROS the others; all are OpenCV's coefficients.
MODELS: dict[str, CameraModel] = {
    "radtan": "pinhole",
    "plumb_bob": "pinhole",
    "rational_polynomial": "pinhole",
    "none": "pinhole",
    "equidistant": "fisheye",
    "fisheye": "fisheye",
}


def motion_of(rotation: Any, translation: Any, *, key: str = "rotation") -> Floats:
    """A rigid motion (4, 4) of a rotation matrix or vector and a translation, as lists."""
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
    """The camera model that a distortion model of Kalibr or ROS belongs to."""
    if name is None or name == "":  # as ROS writes for a camera without distortion
        return None
    if isinstance(name, str) and name in MODELS:
        return MODELS[name]
    raise BadKeyError(found(name, one_of(MODELS)))


def present(content: dict[str, Any], key: str) -> Any:
    """A key without which a camera would silently count as free of distortion."""
    if key not in content:
        raise BadKeyError(f"missing; keys in the file: {', '.join(map(str, content))[:80]}")
    return content[key]


def plain(value: Any) -> Any:
    """Turn text such as 1e-05, which YAML does not take for a number, into numbers."""
    if isinstance(value, list):
        return [plain(item) for item in value]
    with suppress(ValueError):
        return float(value) if isinstance(value, str) else value
    return value


def size_of(value: Any) -> tuple[int, int] | None:
    """Width and height; None where they are missing or, as some drivers write, zero."""
    return None if value in (None, [0, 0]) else resolution(value)
