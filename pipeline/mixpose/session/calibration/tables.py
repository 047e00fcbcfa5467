"""Read plain tables: TOML with a table per camera, and JSON with lists of an entry per camera.

caliscope writes ``[cameras.0]`` and works in metres; aniposelib (Anipose, sleap-anipose, DANNCE)
writes ``[cam_0]``, in the unit of whoever measured the board.  In both, rotation and translation
map the world to the camera.  pycalib's JSON has the lists K, d, R and t.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, TypeAlias

from mixpose.session import geometry as pieces
from mixpose.session.calibration.camera import CalibratedCamera, Content, Format, Group, Reader
from mixpose.session.geometry import CameraModel, Intrinsics
from mixpose.session.messages import BadKeyError, Key, mismatch, under
from mixpose.units import Unit

Cameras: TypeAlias = dict[str, tuple[Key, dict[str, Any]]]
"""Key and content of the table of each camera, by the camera's name."""


def _aniposelib(content: Content) -> Cameras:
    cameras = [(key, table) for key, table in content.toml.items() if _is_camera(table)]
    names = [str(table.get("name") or key) for key, table in cameras]
    # cameras of the same name keep their key, as one would hide the other
    unique = [name if names.count(name) == 1 else key for name, (key, _) in zip(names, cameras)]
    return {name: ((key,), table) for name, (key, table) in zip(unique, cameras)}


def _caliscope(content: Content) -> Cameras:
    cameras = content.toml.get("cameras")
    return {
        f"cam{number}": (("cameras", number), table)
        for number, table in (cameras.items() if isinstance(cameras, dict) else ())
        if _is_camera(table) and table.get("ignore") is not True
    }


def _is_camera(table: Any) -> bool:
    return isinstance(table, dict) and "matrix" in table and "distortions" in table


def _read(table: dict[str, Any], name: str, unit: Unit | None, _: CameraModel) -> CalibratedCamera:
    fisheye = table.get("fisheye", False)
    if not isinstance(fisheye, bool):
        raise BadKeyError(mismatch(fisheye, "true or false"), "fisheye")
    model: CameraModel = "fisheye" if fisheye else "pinhole"
    with under("matrix"):
        K = pieces.read_camera_matrix(table["matrix"])
    with under("distortions"):
        D = pieces.read_distortion(table["distortions"], model)
    with under("size"):
        size = pieces.size_of(pieces.required(table, "size"))
    pose = None
    if table.get("rotation") is not None and table.get("translation") is not None:
        pose = pieces.motion_of(table["rotation"], table["translation"])
    return CalibratedCamera(name, Intrinsics(K, D, size, model), pose, unit)


def _format(
    name: str, shown: str, cameras_of: Callable[[Content], Cameras], unit: Unit | None
) -> Format:
    """Return a format whose files have the tables that `cameras_of` finds, with its unit."""

    def cameras(group: Group) -> dict[str, Reader]:
        tables = cameras_of(group[0]).items()
        return {n: partial(under(*key)(_read), table, n, unit) for n, (key, table) in tables}

    return Format(name, shown, lambda content: bool(cameras_of(content)), cameras)


ANIPOSELIB = _format("an aniposelib file", "aniposelib ([cam_0])", _aniposelib, None)
CALISCOPE = _format("a caliscope file", "caliscope ([cameras.0])", _caliscope, "m")

_DEEP = 3  # nesting of a list of matrices; a single matrix is a camera of another format


def _depth(value: Any) -> int:
    depth = 0
    while isinstance(value, list) and value:
        value, depth = value[0], depth + 1
    return depth


def _pycalib_cameras(group: Group) -> dict[str, Reader]:
    content = group[0].mapping
    count = len(content["K"])
    names = [f"cam{k + 1:0{len(str(count))}}" for k in range(count)]
    return {name: partial(_read_entry, content, k, name) for k, name in enumerate(names)}


def _read_entry(content: dict[str, Any], k: int, name: str, model: CameraModel) -> CalibratedCamera:
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
    cameras=_pycalib_cameras,
)
