"""The calibrated session file: the user's own, with the values that were found."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from mixpose.body import Body
from mixpose.calibration.result import Calibration
from mixpose.calibration.rig import Block
from mixpose.records import Floats
from mixpose.session import Session, rewriting

MARK = "# Calibrated by mixpose"
_LENS = {"focal", "principal_point", "distortion"}


def calibrated_text(session: Session, found: Calibration, target: Path, version: str) -> str:
    """The text of the calibrated session, as it will stand at a target.

    Comments and keys that were not calibrated stay; paths lead to the same files as before.
    """
    document = rewriting.document_of(session, target)
    scale = found.after.scale
    for index, table in enumerate(document["sensor"]):
        _put_sensor(table, found, session, index)
        for key in ("position", "range_bias") if scale != 1 else ():
            if key in (errors := table.get("calibration_error", {})):
                rewriting.put(errors, key, rewriting.rounded(scale * float(errors[key])))
    first, *others = zip(rewriting.objects_of(document), session.objects, strict=True)
    if scale != 1 or any(block.kind == "body" for block in found.blocks):
        _put_body(first[0], first[1].body, found.after.points, scale)
    if scale != 1:
        for table, one in others:
            _put_body(table, one.body, scale * one.body.means, scale)
    T_new_old = np.eye(4) if found.T_new_old is None else found.T_new_old
    if scale != 1 or found.T_new_old is not None:
        rewriting.put_starts(document, session, T_new_old, scale)
    if found.T_new_old is not None:
        rewriting.put_gravity(document, session, T_new_old)
    origin = f"{session.path.name}, {len(found.used)} frames"
    return rewriting.text_of(document, session, f"{MARK} {version} from {origin}.\n")


def _put_sensor(table: Any, found: Calibration, session: Session, index: int) -> None:
    before: Any = session.sensors[index].sensor
    sensor: Any = found.after.sensors[index]
    said = {block.kind: _said(found, block) for block in found.blocks if block.sensor == index}

    def has_moved(key: str) -> bool:
        there = hasattr(sensor, key)
        return there and not np.array_equal(getattr(sensor, key), getattr(before, key))

    is_lens = hasattr(sensor, "camera_matrix") and bool(_LENS & said.keys())
    # a file of a calibration also says where its camera stands
    was_filed = is_lens and table.pop("calibration", None) is not None
    if was_filed or has_moved("T_sensor_world"):
        pose = _deviation(said.get("pose"))
        rewriting.put_motion(table, "T_sensor_world", sensor.T_sensor_world, pose)
    if is_lens:
        if was_filed and sensor.resolution is not None:
            table["resolution"] = list(sensor.resolution)
        lens = [said[k] for k in ("focal", "principal_point") if k in said]
        _put(table, "camera_matrix", sensor.camera_matrix, ", ".join(lens) or None)
        if len(sensor.distortion):
            _put(table, "distortion", sensor.distortion, said.get("distortion"))
    elif "principal_point" in said:
        _put(table, "principal_point", sensor.principal_point, said["principal_point"])
    if has_moved("position"):
        _put(table, "position", sensor.position, said.get("position"))
    if "range_bias" in said:
        _put(table, "range_bias", sensor.range_bias, said["range_bias"])
    if "delay" in said:
        _put(table, "delay", found.after.delays[index], said["delay"])


def _put(table: Any, key: str, value: Floats | float, said: str | None) -> None:
    rewriting.put(table, key, rewriting.rounded(value), _deviation(said))


def _deviation(said: str | None) -> str | None:
    return f"one standard deviation: {said}" if said else None


def _said(found: Calibration, block: Block) -> str:
    parts = []
    rows = zip(block.names, found.deviations[block.place], block.units, strict=True)
    for name, deviation, unit in rows:
        value, word = (np.degrees(deviation), " deg") if unit == "rad" else (deviation, "")
        said = f"{value:.2g}{word}" if np.isfinite(value) else "not determined"
        parts.append(f"{name} {said}")
    return ", ".join(parts)


def _put_body(table: Any, body: Body, points: Floats, scale: float) -> None:
    """Features as points, which replace a file of them; other lengths of the body are scaled."""
    had_file = table.pop("file", None) is not None
    if had_file and body.normals is not None:
        table["normals"] = rewriting.rounded(body.normals)
    if (had_file or scale != 1) and body.covariances.any():
        table["sigma"] = [rewriting.rounded(scale**2 * C) for C in body.covariances]
    count = len(body) - len(table.get("segments", ()))
    if count:  # segments come after the points
        table["points"] = rewriting.rounded(points[:count])
    if had_file and body.names:
        table["names"] = list(body.names)
    if scale == 1:
        return
    for key in ("segments", "radius", "tip"):
        if key in table:
            rewriting.put(table, key, rewriting.rounded(scale * np.array(table[key], float)))
    if body.gravity is not None:
        rewriting.put(table["gravity"], "sigma", rewriting.rounded(scale * body.gravity.sigma))
