"""caliscope's camera_array.toml: a table ``[cameras.N]`` for each camera, in metres."""

from __future__ import annotations

from typing import Any

from mixpose.session.calibration.camera import CalibratedCamera, Format, Group
from mixpose.session.calibration.content import Content
from mixpose.session.calibration.tables import is_camera, read_table
from mixpose.session.intrinsics import CameraModel
from mixpose.session.messages import under


def _tables(content: Content) -> dict[str, Any]:
    cameras = content.toml.get("cameras")
    return cameras if isinstance(cameras, dict) else {}


def _recognises(content: Content) -> bool:
    return any(is_camera(table) for table in _tables(content).values())


def _names(group: Group) -> list[str]:
    tables = _tables(group[0])
    return [f"cam{number}" for number, table in tables.items() if _is_used(table)]


def _is_used(table: Any) -> bool:
    return is_camera(table) and table.get("ignore") is not True


def _read(group: Group, name: str, model: CameraModel) -> CalibratedCamera:
    number = name.removeprefix("cam")
    with under("cameras", number):
        return read_table(_tables(group[0])[number], name, group, "m")


CALISCOPE = Format("a caliscope file", "caliscope ([cameras.0])", _recognises, _names, _read)
