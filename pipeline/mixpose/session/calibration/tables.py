"""Read TOML with a table per camera: size, matrix, distortions, rotation and translation.

caliscope writes ``[cameras.0]`` and works in metres; aniposelib (Anipose, sleap-anipose, DANNCE)
writes ``[cam_0]``, in the unit of whoever measured the board.  In both, rotation and translation
map the world to the camera.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, TypeAlias

from mixpose.session import intrinsics as pieces
from mixpose.session.calibration.camera import CalibratedCamera, Content, Format, Group, Reader
from mixpose.session.intrinsics import CameraModel, Intrinsics
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
