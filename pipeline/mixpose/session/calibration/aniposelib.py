"""aniposelib's calibration.toml: a table ``[cam_N]`` for each camera."""

from __future__ import annotations

from typing import Any

from mixpose.session.calibration.camera import CalibratedCamera, Format, Group
from mixpose.session.calibration.content import Content
from mixpose.session.calibration.tables import is_camera, read_table
from mixpose.session.intrinsics import CameraModel
from mixpose.session.messages import under


def _tables(content: Content) -> dict[str, tuple[str, dict[str, Any]]]:
    """By the camera's name: the key of its table, and the table."""
    cameras = [(key, table) for key, table in content.toml.items() if is_camera(table)]
    names = [str(table.get("name") or key) for key, table in cameras]
    # names that are there twice would hide a camera
    chosen = [name if names.count(name) == 1 else key for name, (key, _) in zip(names, cameras)]
    return dict(zip(chosen, cameras))


def _recognises(content: Content) -> bool:
    return bool(_tables(content))


def _names(group: Group) -> list[str]:
    return list(_tables(group[0]))


def _read(group: Group, name: str, model: CameraModel) -> CalibratedCamera:
    key, table = _tables(group[0])[name]
    with under(key):
        return read_table(table, name, group, None)


ANIPOSELIB = Format("an aniposelib file", "aniposelib ([cam_0])", _recognises, _names, _read)
