"""``mixpose import``: make a session file from files of other programs, with warnings."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from mixpose.checking import key_warnings, with_image_sizes
from mixpose.cli.app import ImportRequest
from mixpose.cli.notices import counted, say, warn
from mixpose.cli.output import is_stdout, shown, write_text
from mixpose.errors import SessionError
from mixpose.naming import distinct
from mixpose.rigid import from_parts
from mixpose.session import Session, load_session
from mixpose.session.calibration import CalibratedCamera, Rig, read_rigs
from mixpose.session.marker_files import READERS, read_marker_file
from mixpose.session.messages import BadKeyError, one_line
from mixpose.units import Unit, length_ratio

_TABLES = (".csv", *READERS)
_EXAMPLE_MM = [[0, 0, 0], [60, 0, 0], [0, 100, 0], [20, 30, 80]]


@dataclass(frozen=True)
class Imported:
    """The contents of imported files, in the unit of the session."""

    unit: Unit
    cameras: tuple[CalibratedCamera, ...]  # names are unique; translations are in `unit`
    bodies: tuple[Path, ...]  # files of markers
    files: tuple[Path, ...]  # all imported files
    remarks: tuple[str, ...]  # on units, for the head of the session file
    warnings: tuple[str, ...]  # what the user should check


def import_files(request: ImportRequest) -> None:
    """Write a session file, which must be new, and print a summary on standard error."""
    output, unit = request.output, request.unit
    if output.exists() and not is_stdout(output):
        raise SessionError(f"-o {output}: is there already; name a new file")
    if not output.parent.is_dir():
        raise SessionError(f"-o {output}: there is no folder {output.parent}")
    imported = gather(request.files, unit, request.lengths)
    session = _written(imported, output)
    for warning in (*imported.warnings, *key_warnings(with_image_sizes(session, {}))):
        warn(warning)
    if not imported.bodies:
        warn("no file of a body is among them: [object] is an example, put in your markers")
    cameras = counted(len(imported.cameras), "camera")
    names = ", ".join(camera.name for camera in imported.cameras)
    say(
        f"{cameras} ({names}), lengths in {unit} -> {shown(output)}; now "
        "add the source of each sensor"
    )


def _written(imported: Imported, output: Path) -> Session:
    """Write the session and load it; a file that cannot be loaded is removed."""
    if is_stdout(output):
        with TemporaryDirectory() as folder:
            copy = Path(folder) / "session.toml"
            copy.write_text(session_text(imported, copy), encoding="utf-8")
            session = load_session(copy)
        write_text(output, session_text(imported, output), "-o")
        return session
    with output.open("x", encoding="utf-8", newline="\n") as stream:
        stream.write(session_text(imported, output))
    try:
        return load_session(output)
    except SessionError:
        output.unlink()  # or the next attempt would be refused
        raise


def gather(paths: Sequence[Path], unit: Unit, lengths: Unit | None) -> Imported:
    """Read calibrations and bodies in `unit`; `lengths` is that of translations of unknown unit."""
    bodies = [path for path in paths if path.suffix.lower() in _TABLES]
    try:
        for body in bodies:
            read_marker_file(body, unit)
        calibrations = [path for path in paths if path not in bodies]
        rigs = read_rigs(calibrations, also=f"; or a body: {', '.join(_TABLES)}")
    except BadKeyError as problem:
        raise SessionError(one_line("import", problem.key, problem.text)) from problem
    if not rigs:
        raise SessionError(
            "import: found no calibration file among the files; allowed: at least one, beside "
            f"bodies ({', '.join(_TABLES)})"
        )
    placed = [rig for rig in rigs if any(c.T_camera_rig is not None for c in rig.cameras)]
    if len(placed) > 1:
        raise SessionError(
            f"{placed[1].files[0]}: its cameras stand in another world than those of "
            f"{placed[0].files[0]}; import them one by one"
        )
    cameras: list[CalibratedCamera] = []
    remarks, warnings = _notes_on_tables(bodies, unit, lengths)
    for rig in rigs:
        stated, remark, warning = _stated_unit(rig, unit, lengths)
        remarks.append(remark)
        warnings.append(warning)
        factor = length_ratio(stated, unit)
        for camera in rig.cameras:
            T = camera.T_camera_rig
            scaled = None if T is None else from_parts(T[:3, :3], factor * T[:3, 3])
            cameras.append(replace(camera, T_camera_rig=scaled))
    names = distinct([camera.name for camera in cameras], _plain)
    cameras = [replace(camera, name=name) for camera, name in zip(cameras, names, strict=True)]
    return Imported(
        unit,
        tuple(cameras),
        tuple(bodies),
        files=tuple(paths),
        remarks=tuple(filter(None, remarks)),
        warnings=(*filter(None, warnings), *_camera_warnings(cameras)),
    )


def _notes_on_tables(
    bodies: Sequence[Path], unit: Unit, lengths: Unit | None
) -> tuple[list[str], list[str]]:
    """Return remarks and warnings about lengths of marker tables, which are not converted."""
    tables = [path.name for path in bodies if path.suffix.lower() not in READERS]
    if not tables:
        return [], []
    remark = f"lengths of {', '.join(tables)} are taken to be in {unit}, the session's unit"
    if lengths in (None, unit):
        return [remark], []
    hint = f"write tables in {unit}, or add --unit {lengths}"
    return [remark], [f"--lengths {lengths}: is of calibrations; {remark}: {hint}"]


def _stated_unit(rig: Rig, unit: Unit, lengths: Unit | None) -> tuple[Unit, str, str]:
    """Return the unit of a rig's translations, with a remark and a warning, perhaps empty."""
    name = " and ".join(Path(file).name for file in rig.files)
    poses = [camera.T_camera_rig for camera in rig.cameras]
    if not any(T is not None and T[:3, 3].any() for T in poses):
        return unit, "", ""
    (fixed,) = {camera.unit for camera in rig.cameras}
    notes = "; ".join(dict.fromkeys(camera.note for camera in rig.cameras if camera.note))
    if fixed is not None:
        remark = f"translations of {name} are in {fixed}, by its format"
        return fixed, remark, f"--lengths {lengths}: is not used, as {remark}" if lengths else ""
    if lengths is not None:
        return lengths, f"translations of {name} are in {lengths}, as --lengths said", ""
    guess = f"translations of {name} are taken to be in {unit}, which the file does not say"
    hint = f"{guess}{f' ({notes})' if notes else ''}; if not, add --lengths m, cm, mm or um"
    return unit, guess, hint


def _plain(name: str) -> str:
    """Return a name that is valid in NAME=PATH."""
    characters = ("_" if c in '=/\\"' or not c.isprintable() else c for c in name)
    return "".join(characters).strip() or "camera"


def _camera_warnings(cameras: list[CalibratedCamera]) -> list[str]:
    lenses = {camera.name: camera.intrinsics for camera in cameras}
    unplaced = [camera.name for camera in cameras if camera.T_camera_rig is None]
    doubts = {
        "the files do not say where they stand; add T_sensor_world": (
            unplaced if len(cameras) > 1 else []
        ),
        "the files do not say how large images are; see that recordings have the size that was "
        "calibrated": [name for name, lens in lenses.items() if lens.resolution is None],
        "four coefficients of distortion are a pinhole's or a fisheye's, and the file does not say "
        'which; where it is a fisheye\'s, change model to "fisheye"': [
            name for name, k in lenses.items() if k.model is None and k.distortion.size == 4
        ],
    }
    warnings = [f"{', '.join(names)}: {text}" for text, names in doubts.items() if names]
    for camera in cameras:
        (cx, cy), size = camera.intrinsics.camera_matrix[:2, 2], camera.intrinsics.resolution
        if size and not (0 <= cx <= size[0] - 1 and 0 <= cy <= size[1] - 1):
            warnings.append(
                f"{camera.name}: the principal point cx = {cx:g}, cy = {cy:g} is outside of its "
                f"images of {size[0]}x{size[1]} px: was it calibrated at another size?"
            )
    for a, b in combinations(cameras, 2):
        if _are_same(a, b):
            warnings.append(
                f"{a.name} and {b.name} are the same camera at the same place: one of them is a "
                "copy by mistake; drop it or calibrate it again"
            )
    return warnings


def _are_same(a: CalibratedCamera, b: CalibratedCamera) -> bool:
    if a.T_camera_rig is None or b.T_camera_rig is None:
        return False
    are_equal = np.array_equal(a.intrinsics.camera_matrix, b.intrinsics.camera_matrix)
    return bool(are_equal and np.allclose(a.T_camera_rig, b.T_camera_rig, rtol=1e-9, atol=1e-12))


def session_text(imported: Imported, output: Path) -> str:
    """Return the text of a session file at `output`, to which paths of bodies are relative."""
    names = ", ".join(path.name for path in imported.files)
    head = [f"# made by mixpose import from {names}"]
    head += [f"# {remark}" for remark in imported.remarks]
    parts = ["\n".join([*head, f'unit = "{imported.unit}"']), *_objects(imported, output)]
    parts += [_sensor(camera) for camera in imported.cameras]
    return "\n\n".join(parts) + "\n"


def _objects(imported: Imported, output: Path) -> list[str]:
    if not imported.bodies:
        scale = length_ratio("mm", imported.unit)
        points = [[float(f"{value * scale:g}") for value in point] for point in _EXAMPLE_MM]
        return [
            '# an example: put in the places of your markers, or file = "markers.csv"\n'
            f'[object]\nname = "example"\npoints = {points}'
        ]
    heading = "[object]" if len(imported.bodies) == 1 else "[[object]]"
    names = distinct([path.stem for path in imported.bodies], str)
    return [
        f"{heading}\nname = {_quoted(name)}\nfile = {_quoted(_relative(path, output))}"
        for path, name in zip(imported.bodies, names, strict=True)
    ]


def _quoted(text: str) -> str:
    return json.dumps(text, ensure_ascii=False)


def _relative(path: Path, output: Path) -> str:
    try:
        return Path(os.path.relpath(path.resolve(), output.resolve().parent)).as_posix()
    except ValueError:  # on another drive
        return path.resolve().as_posix()


def _sensor(camera: CalibratedCamera) -> str:
    intrinsics = camera.intrinsics
    lines = [
        "[[sensor]]",
        f"name = {_quoted(camera.name)}",
        f'model = "{intrinsics.model or "pinhole"}"',
        f"# source = {_quoted(f'{camera.name}/*.png')}",
        f"camera_matrix = {intrinsics.camera_matrix.tolist()}",
    ]
    if intrinsics.distortion.size:
        lines.append(f"distortion = {intrinsics.distortion.tolist()}")
    if intrinsics.resolution is not None:
        lines.append(f"resolution = {list(intrinsics.resolution)}")
    if camera.T_camera_rig is not None:
        rows = ",\n    ".join(str(row) for row in camera.T_camera_rig.tolist())
        lines.append(f"T_sensor_world = [\n    {rows},\n]")
    return "\n".join(lines)
