"""The calibrated session file: the user's file with calibrated values."""

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


def calibrated_text(session: Session, calibration: Calibration, target: Path, version: str) -> str:
    """Return the text of the calibrated session, as it will stand at a target.

    Comments and keys that were not calibrated stay; paths lead to the same files as before.
    """
    document = rewriting.document_of(session, target)
    scale, T_new_old = calibration.after.scale, calibration.T_new_old
    for index, table in enumerate(document["sensor"]):
        _put_sensor(table, calibration, session, index)
        for key in ("position", "range_bias") if scale != 1 else ():
            if key in (errors := table.get("calibration_error", {})):
                rewriting.put(errors, key, rewriting.rounded(scale * float(errors[key])))
    first, *others = zip(rewriting.objects_of(document), session.objects, strict=True)
    if scale != 1 or any(block.kind == "body" for block in calibration.blocks):
        _put_body(first[0], first[1].body, calibration.after.points, scale)
    if scale != 1:
        for table, settings in others:
            _put_body(table, settings.body, scale * settings.body.means, scale)
    if scale != 1 or T_new_old is not None:
        T_start = np.eye(4) if T_new_old is None else T_new_old
        rewriting.put_starts(document, session, T_start, scale)
    if T_new_old is not None:
        rewriting.put_gravity(document, session, T_new_old)
    origin = f"{session.path.name}, {len(calibration.used)} frames"
    return rewriting.text_of(document, session, f"{MARK} {version} from {origin}.\n")


def _put_sensor(table: Any, calibration: Calibration, session: Session, index: int) -> None:
    before: Any = session.sensors[index].sensor
    sensor: Any = calibration.after.sensors[index]
    blocks = [block for block in calibration.blocks if block.sensor == index]
    deviations = {block.kind: _deviations_text(calibration, block) for block in blocks}

    def has_moved(key: str) -> bool:
        has_key = hasattr(sensor, key)
        return has_key and not np.array_equal(getattr(sensor, key), getattr(before, key))

    is_lens = hasattr(sensor, "camera_matrix") and bool(_LENS & deviations.keys())
    # a calibration file also has the camera's pose, which would be lost
    was_filed = is_lens and table.pop("calibration", None) is not None
    if was_filed or has_moved("T_sensor_world"):
        pose = _comment(deviations.get("pose"))
        rewriting.put_motion(table, "T_sensor_world", sensor.T_sensor_world, pose)
    if is_lens:
        if was_filed and sensor.resolution is not None:
            table["resolution"] = list(sensor.resolution)
        lens = [deviations[k] for k in ("focal", "principal_point") if k in deviations]
        _put(table, "camera_matrix", sensor.camera_matrix, ", ".join(lens) or None)
        if len(sensor.distortion):
            _put(table, "distortion", sensor.distortion, deviations.get("distortion"))
    elif "principal_point" in deviations:
        _put(table, "principal_point", sensor.principal_point, deviations["principal_point"])
    if has_moved("position"):
        _put(table, "position", sensor.position, deviations.get("position"))
    if "range_bias" in deviations:
        _put(table, "range_bias", sensor.range_bias, deviations["range_bias"])
    if "delay" in deviations:
        _put(table, "delay", calibration.after.delays[index], deviations["delay"])


def _put(table: Any, key: str, value: Floats | float, deviations: str | None) -> None:
    rewriting.put(table, key, rewriting.rounded(value), _comment(deviations))


def _comment(deviations: str | None) -> str | None:
    return f"one standard deviation: {deviations}" if deviations else None


def _deviations_text(calibration: Calibration, block: Block) -> str:
    parts = []
    rows = zip(block.names, calibration.deviations[block.place], block.units, strict=True)
    for name, deviation, unit in rows:
        value, suffix = (np.degrees(deviation), " deg") if unit == "rad" else (deviation, "")
        text = f"{value:.2g}{suffix}" if np.isfinite(value) else "not determined"
        parts.append(f"{name} {text}")
    return ", ".join(parts)


def _put_body(table: Any, body: Body, points: Floats, scale: float) -> None:
    """Write features as points in place of a file of them, and scale other lengths of the body."""
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
