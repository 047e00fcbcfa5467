"""Read pycalib's JSON: lists K, d, R and t with an entry per camera."""

from __future__ import annotations

from functools import partial
from typing import Any

from mixpose.session import intrinsics as pieces
from mixpose.session.calibration.camera import CalibratedCamera, Format, Group, Reader
from mixpose.session.intrinsics import CameraModel, Intrinsics
from mixpose.session.messages import BadKeyError, under

_DEEP = 3  # nesting of a list of matrices; a single matrix is a camera of another format


def _depth(value: Any) -> int:
    depth = 0
    while isinstance(value, list) and value:
        value, depth = value[0], depth + 1
    return depth


def _cameras(group: Group) -> dict[str, Reader]:
    content = group[0].mapping
    count = len(content["K"])
    names = [f"cam{k + 1:0{len(str(count))}}" for k in range(count)]
    return {name: partial(_read, content, k, name) for k, name in enumerate(names)}


def _read(content: dict[str, Any], k: int, name: str, model: CameraModel) -> CalibratedCamera:
    with under("K", k):
        K = pieces.read_camera_matrix(content["K"][k])
    coefficients = _entry(content, "d", k)
    with under("d", k):
        D = pieces.read_distortion(coefficients, model)
    pose = None
    if "R" in content or "t" in content:
        rotation, translation = _entry(content, "R", k), _entry(content, "t", k)
        with under(name):
            pose = pieces.motion_of(rotation, translation, key="R")
    return CalibratedCamera(name, Intrinsics(K, D), pose)


def _entry(content: dict[str, Any], key: str, k: int) -> Any:
    values = content.get(key)
    count = len(content["K"])
    if not isinstance(values, list) or len(values) != count:
        raise BadKeyError(
            f"not {count} entries; allowed: one for each camera matrix of K"
            if values is not None
            else "missing; allowed: a list with an entry for each camera",
            key,
        )
    return values[k]


PYCALIB = Format(
    "a pycalib file",
    "pycalib (K, d, R, t, lists)",
    recognises=lambda content: _depth(content.mapping.get("K")) == _DEEP,
    cameras=_cameras,
)
