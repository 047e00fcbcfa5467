"""TOML with a table per camera: size, matrix, distortions, rotation and translation.

caliscope writes ``[cameras.0]`` and works in metres; aniposelib (Anipose, sleap-anipose, DANNCE)
writes ``[cam_0]``, in the unit of whoever measured the board.  In both, rotation and translation
map the world to the camera.
"""

from __future__ import annotations

from typing import Any

from mixpose.session.calibration.camera import CalibratedCamera, Group, motion_of
from mixpose.session.calibration.plain import present, size_of
from mixpose.session.intrinsics import CameraModel, Intrinsics, camera_matrix, distortion
from mixpose.session.messages import BadKeyError, found, under
from mixpose.session.setup import Unit


def is_camera(table: Any) -> bool:
    """Whether a table is one of a camera."""
    return isinstance(table, dict) and "matrix" in table and "distortions" in table


def read_table(
    table: dict[str, Any], name: str, group: Group, unit: Unit | None
) -> CalibratedCamera:
    """Read the table of a camera."""
    fisheye = table.get("fisheye", False)
    if not isinstance(fisheye, bool):
        raise BadKeyError(found(fisheye, "true or false"), "fisheye")
    model: CameraModel = "fisheye" if fisheye else "pinhole"
    with under("matrix"):
        K = camera_matrix(table["matrix"])
    with under("distortions"):
        D = distortion(table["distortions"], model)
    with under("size"):
        size = size_of(present(table, "size"))
    pose = None
    if table.get("rotation") is not None and table.get("translation") is not None:
        pose = motion_of(table["rotation"], table["translation"])
    return CalibratedCamera(name, Intrinsics(K, D, size, model), pose, unit)
