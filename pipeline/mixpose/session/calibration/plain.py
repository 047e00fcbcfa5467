"""Values of calibration files, as YAML, JSON and TOML give them."""

from __future__ import annotations

from typing import Any

from mixpose.session.arrays import resolution
from mixpose.session.intrinsics import CameraModel
from mixpose.session.messages import BadKeyError, found, one_of

# Kalibr calls them radtan and equidistant, ROS the others; all are OpenCV's coefficients.
MODELS: dict[str, CameraModel] = {
    "radtan": "pinhole",
    "plumb_bob": "pinhole",
    "rational_polynomial": "pinhole",
    "none": "pinhole",
    "equidistant": "fisheye",
    "fisheye": "fisheye",
}


def model_of_distortion(name: object) -> CameraModel | None:
    """The camera model that a distortion model of Kalibr or ROS belongs to.

    None for the empty name, which ROS writes for a camera without distortion.
    """
    if name is None or name == "":
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
    if isinstance(value, str):
        try:
            return float(value)
        except ValueError:
            return value
    return value


def size_of(value: Any) -> tuple[int, int] | None:
    """Width and height; None where they are missing or, as some drivers write, zero."""
    return None if value in (None, [0, 0]) else resolution(value)
