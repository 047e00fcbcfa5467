"""The calibrated session file: the user's own, with the values that were found."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import tomlkit

from mixpose.calibration.result import Calibration
from mixpose.calibration.rig import Block, Kind
from mixpose.records import Floats
from mixpose.session import Session

MARK = "# Calibrated by mixpose"
_ROTATIONS = ("rotation_vector", "quaternion_xyzw", "euler_xyz_deg", "translation")
_DIGITS = 10


def calibrated_text(session: Session, found: Calibration, target: Path, version: str) -> str:
    """The text of the calibrated session.

    Comments and keys that were not calibrated stay; paths lead to the same files as before.

    Parameters
    ----------
    session : Session
    found : Calibration
    target : Path
        Where it will stand.
    version : str
        Of mixpose.
    """
    document = tomlkit.parse(session.path.read_text(encoding="utf-8-sig"))
    _lead_back(document, session.folder, target.parent)
    for index, table in enumerate(document["sensor"]):
        kinds = [block.kind for block in found.blocks if block.sensor == index]
        _put_sensor(table, found, index, kinds)
    if any(block.kind == "body" for block in found.blocks):
        _put_body(document["object"], found, session)
    text = str(tomlkit.dumps(document))
    return f"{MARK} {version} from {session.path.name}, {len(found.used)} frames.\n{text}"


def _put_sensor(table: Any, found: Calibration, index: int, kinds: Sequence[Kind]) -> None:
    sensor: Any = found.after.sensors[index]
    said = {block.kind: _said(found, block) for block in found.blocks if block.sensor == index}
    before: Any = found.before.sensors[index]
    if hasattr(sensor, "T_sensor_world") and not np.array_equal(
        sensor.T_sensor_world, before.T_sensor_world
    ):
        for key in _ROTATIONS:
            table.pop(key, None)
        _put(table, "T_sensor_world", _plain(sensor.T_sensor_world), said.get("pose"))
    if {"focal", "principal_point", "distortion"} & set(kinds) and hasattr(sensor, "camera_matrix"):
        if table.pop("calibration", None) is not None and sensor.resolution is not None:
            table["resolution"] = list(sensor.resolution)
        lens = [said[k] for k in ("focal", "principal_point") if k in said]
        _put(table, "camera_matrix", _plain(sensor.camera_matrix), ", ".join(lens) or None)
        if len(sensor.distortion):
            _put(table, "distortion", _plain(sensor.distortion), said.get("distortion"))
    elif "principal_point" in kinds:
        _put(table, "principal_point", _plain(sensor.principal_point), said["principal_point"])
    if hasattr(sensor, "position") and not np.array_equal(sensor.position, before.position):
        _put(table, "position", _plain(sensor.position), said.get("position"))
    if "range_bias" in kinds:
        _put(table, "range_bias", _rounded(sensor.range_bias), said["range_bias"])
    if "delay" in kinds:
        _put(table, "delay", _rounded(found.after.delays[index]), said["delay"])


def _put(table: Any, key: str, value: Any, said: str | None) -> None:
    item = tomlkit.item(value)
    if said:
        item.comment(f"one standard deviation: {said}")
    table[key] = item


def _said(found: Calibration, block: Block) -> str:
    parts = []
    for name, deviation, unit in zip(
        block.names, found.deviations[block.place], block.units, strict=True
    ):
        value, word = (np.degrees(deviation), " deg") if unit == "rad" else (deviation, "")
        said = f"{value:.2g}{word}" if np.isfinite(value) else "not determined"
        parts.append(f"{name} {said}")
    return ", ".join(parts)


def _put_body(table: Any, found: Calibration, session: Session) -> None:
    """Features as points, which replace a file of them."""
    if table.pop("file", None) is not None:
        if session.body.normals is not None:
            table["normals"] = _plain(session.body.normals)
        if session.body.covariances.any():
            table["sigma"] = [_plain(covariance) for covariance in session.body.covariances]
    table["points"] = _plain(found.after.points)


def _lead_back(document: Any, old: Path, new: Path) -> None:
    """Let relative paths lead from a new folder to where they led from the old one."""
    if old.resolve() == new.resolve():
        return

    def path(value: str) -> str:
        if Path(value).is_absolute() or "://" in value or value.startswith("camera:"):
            return value
        return Path(os.path.relpath(old.resolve() / value, new.resolve())).as_posix()

    def put(table: Any, key: str) -> None:
        value = table.get(key)
        if isinstance(value, str):
            table[key] = path(value)
        elif isinstance(value, list):
            table[key] = [path(each) for each in value]

    put(document["object"], "file")
    for table in document["sensor"]:
        put(table, "source")
        put(table, "times")
        put(table, "calibration")
        if isinstance(table.get("calibration"), dict):
            put(table["calibration"], "file")


def _rounded(value: float) -> float:
    return float(f"{float(value):.{_DIGITS}g}") + 0.0


def _plain(values: Floats) -> Any:
    """Nested lists with ten digits."""
    array = np.asarray(values, dtype=np.float64)
    if array.ndim == 0:
        return _rounded(float(array))
    return [_plain(each) for each in array]
