"""Read calibration files, whose format is recognised by content."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from mixpose.session.calibration.camera import CalibratedCamera, Content, Format, Rig, read_content
from mixpose.session.calibration.colmap import COLMAP
from mixpose.session.calibration.mappings import (
    ANIPOSELIB,
    CALISCOPE,
    KALIBR,
    PYCALIB,
    ROS,
    ROS_INI,
)
from mixpose.session.calibration.opencv import OPENCV, read_nodes
from mixpose.session.geometry import CameraModel
from mixpose.session.messages import BadKeyError, in_file
from mixpose.session.schema_sensors import CalibrationTable

__all__ = ["FORMATS", "CalibratedCamera", "Rig", "read_calibration", "read_rigs"]

FORMATS = (KALIBR, OPENCV, PYCALIB, ROS, ROS_INI, CALISCOPE, ANIPOSELIB, COLMAP)
"""Formats in the order in which they are tried: Kalibr's files may begin like OpenCV's."""


def read_calibration(
    wanted: CalibrationTable, folder: Path, model: CameraModel
) -> CalibratedCamera:
    """Read the camera that a session names, in a file relative to `folder`; else BadKeyError."""
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
    """Read all cameras of files, grouped into rigs; `also` ends the list of allowed formats."""
    by_format: dict[str, tuple[Format, list[Content]]] = {}
    for path in paths:
        content = read_content(path, str(path))
        with in_file(content.name):
            form = format_of(content, also)
        by_format.setdefault(form.name, (form, []))[1].append(content)
    rigs: list[Rig] = []
    for form, contents in by_format.values():
        with in_file(_names_of(contents)):
            groups = form.groups(contents) if form.groups else [[content] for content in contents]
        for group in groups:
            with in_file(_names_of(group)):
                cameras = tuple(read("pinhole") for read in form.cameras(group).values())
            rigs.append(Rig(tuple(content.name for content in group), cameras))
    return rigs


def _names_of(contents: Sequence[Content]) -> str:
    return " and ".join(content.name for content in contents)


def format_of(content: Content, also: str = "") -> Format:
    """Return the format of a file; raise BadKeyError if it is unknown."""
    for form in FORMATS:
        if form.recognises(content):
            return form
    known = ", ".join(form.shown for form in FORMATS)
    keys = content.toml or content.parsed()
    shown = ", ".join(map(str, keys)) if isinstance(keys, dict) and keys else "no keys"
    raise BadKeyError(f"found {shown[:80]}; allowed: {known}{also}")


def _read(content: Content, wanted: CalibrationTable, model: CameraModel) -> CalibratedCamera:
    form = format_of(content)
    nodes = {"camera_matrix": wanted.camera_matrix, "distortion": wanted.distortion}
    if form is OPENCV and any(value is not None for value in nodes.values()):
        return read_nodes(content, model, wanted.camera_matrix, wanted.distortion)
    _only_for("an OpenCV file", form.name, **nodes)
    if not form.holds_several:
        _only_for("a file of several cameras", form.name, camera=wanted.camera)
    cameras = form.cameras([content])
    first, names = next(iter(cameras), ""), ", ".join(cameras)
    if wanted.camera is None and len(cameras) > 1:
        raise BadKeyError(
            f"holds the cameras {names}; choose one as "
            f'calibration = {{ file = "...", camera = "{first}" }}'
        )
    name = first if wanted.camera is None else wanted.camera
    if name not in cameras:
        raise BadKeyError(
            f'found no camera "{name}"; cameras in the file: {names}; this is {form.name}'
        )
    return cameras[name](model)


def _only_for(other_format: str, format_name: str, **keys: str | None) -> None:
    """Refuse keys that only another format than the file's uses."""
    for key, value in keys.items():
        if value is not None:
            raise BadKeyError(
                f'{key} = "{value}" is for {other_format}, this is {format_name}; drop the key'
            )
