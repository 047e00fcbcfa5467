"""The session file of an import, as TOML that a person goes on with."""

from __future__ import annotations

import json
import os
from collections.abc import Iterable
from pathlib import Path

from mixpose.importing.gather import Imported
from mixpose.rigid import Floats
from mixpose.session.calibration import CalibratedCamera

_EXAMPLE_MM = [[0, 0, 0], [60, 0, 0], [0, 100, 0], [20, 30, 80]]
_METRES = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6}


def session_text(imported: Imported, output: Path) -> str:
    """The text of a session file.

    Parameters
    ----------
    imported : Imported
    output : Path
        Where the text will be: the path of the body is relative to it.
    """
    names = ", ".join(path.name for path in imported.files)
    head = [f"# made by mixpose import from {names}"]
    head += [f"# {remark}" for remark in imported.remarks]
    parts = ["\n".join([*head, f'unit = "{imported.unit}"']), _object(imported, output)]
    parts += [_sensor(camera) for camera in imported.cameras]
    return "\n\n".join(parts) + "\n"


def _object(imported: Imported, output: Path) -> str:
    if imported.body is not None:
        try:
            relative = os.path.relpath(imported.body.resolve(), output.resolve().parent)
        except ValueError:  # on another drive
            relative = str(imported.body.resolve())
        name = imported.body.stem
        path = Path(relative).as_posix()
        return f"[object]\nname = {json.dumps(name)}\nfile = {json.dumps(path)}"
    scale = 1e-3 / _METRES[imported.unit]
    points = [[float(f"{value * scale:g}") for value in point] for point in _EXAMPLE_MM]
    return (
        '# an example: put in the places of your markers, or file = "markers.csv"\n'
        f'[object]\nname = "example"\npoints = {points}'
    )


def _sensor(camera: CalibratedCamera) -> str:
    given = camera.intrinsics
    lines = [
        "[[sensor]]",
        f"name = {json.dumps(camera.name, ensure_ascii=False)}",
        f'model = "{given.model or "pinhole"}"',
        f"# source = {json.dumps(f'{camera.name}/*.png', ensure_ascii=False)}",
        f"camera_matrix = {_rows(given.camera_matrix)}",
    ]
    if given.distortion.size:
        lines.append(f"distortion = {_numbers(given.distortion)}")
    if given.resolution is not None:
        lines.append(f"resolution = {list(given.resolution)}")
    if camera.T_camera_rig is not None:
        rows = ",\n    ".join(_numbers(row) for row in camera.T_camera_rig)
        lines.append(f"T_sensor_world = [\n    {rows},\n]")
    return "\n".join(lines)


def _rows(matrix: Floats) -> str:
    return f"[{', '.join(_numbers(row) for row in matrix)}]"


def _numbers(values: Iterable[float]) -> str:
    """Numbers as they are, to the last bit."""
    return f"[{', '.join(repr(float(value)) for value in values)}]"
