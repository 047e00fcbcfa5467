"""Reading the files that a session is to be made from, and what is odd about them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path

import numpy as np

from mixpose.errors import SessionError
from mixpose.records import Floats
from mixpose.session.calibration import CalibratedCamera, Rig, read_rigs
from mixpose.session.marker_files import READERS, read_marker_file
from mixpose.session.messages import BadKeyError, one_line
from mixpose.session.setup import Unit, scale_between

_TABLES = (".csv", *READERS)


@dataclass(frozen=True)
class Imported:
    """What was read, in the unit of the session."""

    unit: Unit  # {"m", "cm", "mm", "um"}
    cameras: tuple[CalibratedCamera, ...]  # names are unique; translations are in `unit`
    bodies: tuple[Path, ...]  # files of markers
    files: tuple[Path, ...]  # all that was read
    remarks: tuple[str, ...]  # what is known of units and worlds, for the head of the session file
    warnings: tuple[str, ...]  # what a person should look at


def gather(paths: Sequence[Path], unit: Unit, lengths: Unit | None) -> Imported:
    """Read calibration files and files of bodies.

    Parameters
    ----------
    paths : sequence of Path
        A body is told by its ending: .csv, .rom, .vsk or .obj.
    unit : {"m", "cm", "mm", "um"}
        Wanted.
    lengths : {"m", "cm", "mm", "um"} or None
        Unit of translations in files whose format does not fix it; None where nobody says.

    Raises
    ------
    SessionError
        In one line, if a file cannot be read or files contradict each other.
    """
    bodies = [path for path in paths if path.suffix.lower() in _TABLES]
    try:
        for body in bodies:
            read_marker_file(body, unit)
        others = [path for path in paths if path not in bodies]
        rigs = read_rigs(others, also=f"; or a body: {', '.join(_TABLES)}")
    except BadKeyError as problem:
        raise SessionError(one_line("import", problem.key, problem.text)) from problem
    if not rigs:
        raise SessionError(
            "import: found no calibration file among the files; allowed: at least one, beside "
            f"bodies ({', '.join(_TABLES)})"
        )
    placed = [rig for rig in rigs if rig.is_placed]
    if len(placed) > 1:
        raise SessionError(
            f"{placed[1].files[0]}: its cameras stand in another world than those of "
            f"{placed[0].files[0]}; import them one by one"
        )
    cameras = _renamed([camera for rig in rigs for camera in rig.cameras])
    stated = [_stated_unit(rig, unit, lengths) for rig in rigs]
    remarks = [remark for _, remark, _ in stated if remark]
    warnings = [warning for _, _, warning in stated if warning]
    units = [each for (each, _, _), rig in zip(stated, rigs, strict=True) for _ in rig.cameras]
    cameras = [
        replace(camera, T_camera_rig=_scaled(camera.T_camera_rig, scale_between(own, unit)))
        for camera, own in zip(cameras, units, strict=True)
    ]
    warnings += _odd(cameras)
    return Imported(
        unit=unit,
        cameras=tuple(cameras),
        bodies=tuple(bodies),
        files=tuple(paths),
        remarks=tuple(remarks),
        warnings=tuple(warnings),
    )


def _stated_unit(rig: Rig, unit: Unit, lengths: Unit | None) -> tuple[Unit, str, str]:
    """The unit of a rig's translations, with a remark and perhaps a warning about it."""
    name = " and ".join(Path(file).name for file in rig.files)
    if not any(
        camera.T_camera_rig is not None and camera.T_camera_rig[:3, 3].any()
        for camera in rig.cameras
    ):
        return unit, "", ""
    (fixed,) = {camera.unit for camera in rig.cameras}
    notes = "; ".join(dict.fromkeys(camera.note for camera in rig.cameras if camera.note))
    if fixed is not None:
        return fixed, f"translations of {name} are in {fixed}, by its format", ""
    if lengths is not None:
        return lengths, f"translations of {name} are in {lengths}, as --lengths said", ""
    guess = f"translations of {name} are taken to be in {unit}, which the file does not say"
    hint = f"{guess}{f' ({notes})' if notes else ''}; if not, add --lengths m, cm, mm or um"
    return unit, guess, hint


def _renamed(cameras: list[CalibratedCamera]) -> list[CalibratedCamera]:
    """Cameras whose names are unique and can stand in NAME=PATH."""
    taken: set[str] = set()
    renamed = []
    for camera in cameras:
        name = "".join("_" if c in '=/\\"' or not c.isprintable() else c for c in camera.name)
        name = base = name.strip() or "camera"
        number = 2
        while name in taken:
            name, number = f"{base}_{number}", number + 1
        taken.add(name)
        renamed.append(replace(camera, name=name))
    return renamed


def _scaled(T: Floats | None, factor: float) -> Floats | None:
    if T is None:
        return None
    scaled = T.copy()
    scaled[:3, 3] *= factor
    return scaled


def _odd(cameras: list[CalibratedCamera]) -> list[str]:
    """Cameras without a place, without a size, or that are there twice."""
    warnings = []
    unplaced = [camera.name for camera in cameras if camera.T_camera_rig is None]
    if unplaced and len(cameras) > 1:
        warnings.append(
            f"{', '.join(unplaced)}: the files do not say where they stand; add T_sensor_world"
        )
    unsized = [camera.name for camera in cameras if camera.intrinsics.resolution is None]
    if unsized:
        warnings.append(
            f"{', '.join(unsized)}: the files do not say how large images are; see that recordings "
            "have the size that was calibrated"
        )
    for camera in cameras:
        warnings += _outside(camera)
    for a, b in combinations(cameras, 2):
        if _same(a, b):
            warnings.append(
                f"{a.name} and {b.name} are the same camera at the same place: one of them is a "
                "copy by mistake; drop it or calibrate it again"
            )
    return warnings


def _outside(camera: CalibratedCamera) -> list[str]:
    size = camera.intrinsics.resolution
    if size is None:
        return []
    cx, cy = camera.intrinsics.camera_matrix[:2, 2]
    if 0 <= cx <= size[0] - 1 and 0 <= cy <= size[1] - 1:
        return []
    return [
        f"{camera.name}: the principal point cx = {cx:g}, cy = {cy:g} is outside of its images of "
        f"{size[0]}x{size[1]} px: was it calibrated at another size?"
    ]


def _same(a: CalibratedCamera, b: CalibratedCamera) -> bool:
    if a.T_camera_rig is None or b.T_camera_rig is None:
        return False
    alike = np.array_equal(a.intrinsics.camera_matrix, b.intrinsics.camera_matrix)
    return bool(alike and np.allclose(a.T_camera_rig, b.T_camera_rig, rtol=1e-9, atol=1e-12))
