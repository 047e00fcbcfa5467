"""Calibration files, told apart by content: a module per format, and the list of them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from mixpose.session.calibration.camera import CalibratedCamera, Content, Format, Rig, read_content
from mixpose.session.calibration.colmap import COLMAP
from mixpose.session.calibration.kalibr import KALIBR
from mixpose.session.calibration.opencv import OPENCV, read_nodes
from mixpose.session.calibration.pycalib import PYCALIB
from mixpose.session.calibration.ros import ROS, ROS_INI
from mixpose.session.calibration.tables import ANIPOSELIB, CALISCOPE
from mixpose.session.intrinsics import CameraModel
from mixpose.session.messages import BadKeyError, in_file
from mixpose.session.schema_sensors import CalibrationTable

__all__ = ["FORMATS", "CalibratedCamera", "Rig", "read_calibration", "read_rigs"]

FORMATS = (KALIBR, OPENCV, PYCALIB, ROS, ROS_INI, CALISCOPE, ANIPOSELIB, COLMAP)
"""In the order in which they are tried: Kalibr's files may begin like OpenCV's."""


def read_calibration(
    wanted: CalibrationTable, folder: Path, model: CameraModel
) -> CalibratedCamera:
    """Read the camera that a session names: its file, relative to `folder`, and what to read in it.

    Raises BadKeyError if it is in none of the formats, lacks that, or is of another model.
    """
    content = read_content(folder / wanted.file, wanted.file)
    with in_file(wanted.file):
        camera = _read(content, wanted, model)
        stated = camera.intrinsics.model
        if stated not in (None, model):
            raise BadKeyError(
                f'found a {stated} camera; change the sensor\'s model from "{model}" '
                f'to "{stated}" or give another file'
            )
    return camera


def read_rigs(paths: Sequence[Path], *, also: str = "") -> list[Rig]:
    """Read all cameras of several files, among which may be some that belong together.

    `also` says what may be given besides, for the message about a file in no known format.
    """
    formats: dict[str, tuple[Format, list[Content]]] = {}
    for path in paths:
        content = read_content(path, str(path))
        with in_file(content.name):
            format_found = format_of(content, also)
        formats.setdefault(format_found.name, (format_found, []))[1].append(content)
    rigs: list[Rig] = []
    for each, contents in formats.values():
        with in_file(_names_of(contents)):
            groups = each.groups(contents) if each.groups else [[one] for one in contents]
        for group in groups:
            with in_file(_names_of(group)):
                cameras = tuple(read("pinhole") for read in each.cameras(group).values())
            rigs.append(Rig(tuple(content.name for content in group), cameras))
    return rigs


def _names_of(contents: Sequence[Content]) -> str:
    return " and ".join(content.name for content in contents)


def format_of(content: Content, also: str = "") -> Format:
    """The format that a file is in. Raises BadKeyError if it is in none."""
    for each in FORMATS:
        if each.recognises(content):
            return each
    known = ", ".join(each.shown for each in FORMATS)
    keys = content.toml or content.parsed()
    shown = ", ".join(map(str, keys)) if isinstance(keys, dict) and keys else "no keys"
    raise BadKeyError(f"found {shown[:80]}; allowed: {known}{also}")


def _read(content: Content, wanted: CalibrationTable, model: CameraModel) -> CalibratedCamera:
    each = format_of(content)
    nodes = {"camera_matrix": wanted.camera_matrix, "distortion": wanted.distortion}
    if each is OPENCV and any(value is not None for value in nodes.values()):
        return read_nodes(content, model, wanted.camera_matrix, wanted.distortion)
    _only_for("an OpenCV file", each.name, **nodes)
    if not each.holds_several:
        _only_for("a file of several cameras", each.name, camera=wanted.camera)
    cameras = each.cameras([content])
    first, names = next(iter(cameras), ""), ", ".join(cameras)
    if wanted.camera is None and len(cameras) > 1:
        raise BadKeyError(
            f"holds the cameras {names}; choose one as "
            f'calibration = {{ file = "...", camera = "{first}" }}'
        )
    name = first if wanted.camera is None else wanted.camera
    if name not in cameras:
        raise BadKeyError(
            f'found no camera "{name}"; cameras in the file: {names}; this is {each.name}'
        )
    return cameras[name](model)


def _only_for(format_with: str, format_found: str, **keys: str | None) -> None:
    """Refuse a key that the file's format has no use for."""
    for key, value in keys.items():
        if value is not None:
            raise BadKeyError(
                f'{key} = "{value}" is for {format_with}, this is {format_found}; drop the key'
            )
