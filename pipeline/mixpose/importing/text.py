"""The session file of an import, as TOML that a person goes on with."""

from __future__ import annotations

import json
import os
from collections.abc import Iterable
from pathlib import Path

from mixpose.importing.gather import Imported
from mixpose.records import Floats
from mixpose.session.calibration import CalibratedCamera

_EXAMPLE_MM = [[0, 0, 0], [60, 0, 0], [0, 100, 0], [20, 30, 80]]
_METRES = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6}


def session_text(imported: Imported, output: Path) -> str:
    """The text of a session file.

    Parameters
    ----------
    output : Path
        Where the text will be: paths of bodies are relative to it.
    """
    names = ", ".join(path.name for path in imported.files)
    head = [f"# made by mixpose import from {names}"]
    head += [f"# {remark}" for remark in imported.remarks]
    parts = ["\n".join([*head, f'unit = "{imported.unit}"']), *_objects(imported, output)]
    parts += [_sensor(camera) for camera in imported.cameras]
    return "\n\n".join(parts) + "\n"


def _objects(imported: Imported, output: Path) -> list[str]:
    if not imported.bodies:
        scale = 1e-3 / _METRES[imported.unit]
        points = [[float(f"{value * scale:g}") for value in point] for point in _EXAMPLE_MM]
        return [
            '# an example: put in the places of your markers, or file = "markers.csv"\n'
            f'[object]\nname = "example"\npoints = {points}'
        ]
    heading = "[object]" if len(imported.bodies) == 1 else "[[object]]"
    stems = [path.stem for path in imported.bodies]
    texts = []
    for k, path in enumerate(imported.bodies):
        name = stems[k] if stems.count(stems[k]) == 1 else f"{stems[k]}_{k + 1}"
        file = json.dumps(_relative(path, output), ensure_ascii=False)
        texts.append(f"{heading}\nname = {json.dumps(name, ensure_ascii=False)}\nfile = {file}")
    return texts


def _relative(path: Path, output: Path) -> str:
    """A path as the session file is to name it."""
    try:
        return Path(os.path.relpath(path.resolve(), output.resolve().parent)).as_posix()
    except ValueError:  # on another drive
        return path.resolve().as_posix()


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
