"""Calibration files: OpenCV FileStorage, Kalibr camchain, ROS camera_info, told by content."""

from __future__ import annotations

from pathlib import Path

from mixpose.session.calibration_opencv import is_file_storage, read_file_storage
from mixpose.session.calibration_yaml import (
    is_camera_info,
    kalibr_cameras,
    parse_yaml,
    read_camera_info,
    read_kalibr,
)
from mixpose.session.intrinsics import CameraModel, Intrinsics
from mixpose.session.messages import BadKeyError, in_file
from mixpose.session.schema_sensors import CalibrationTable
from mixpose.session.text_files import as_text, read_bytes

# how a NumPy array, an archive of them, and a pickle of Python begin
_NO_TEXT = (b"\x93NUMPY", b"PK\x03\x04", b"\x80")


def read_calibration(wanted: CalibrationTable, folder: Path, model: CameraModel) -> Intrinsics:
    """Read the camera that a session names.

    Parameters
    ----------
    wanted : CalibrationTable
        The file, and the nodes or the camera to read in it.
    folder : Path
        What the file's path is relative to.
    model : {"pinhole", "fisheye"}
        What the session says the camera is.

    Returns
    -------
    Intrinsics
        Of that model.

    Raises
    ------
    BadKeyError
        If the file is missing, is in none of the formats, lacks what was asked for, or holds a
        camera of the other model.
    """
    content = read_bytes(folder / wanted.file)
    with in_file(wanted.file):
        if content.startswith(_NO_TEXT):
            raise BadKeyError(
                "a NumPy or pickle file; write camera matrix and distortion with cv2.FileStorage, "
                "or as numbers into camera_matrix and distortion in place of calibration"
            )
        intrinsics = _read(as_text(content), wanted, model)
        if intrinsics.model not in (None, model):
            raise BadKeyError(
                f'found a {intrinsics.model} camera; change the sensor\'s model from "{model}" '
                f'to "{intrinsics.model}" or give another file'
            )
    return intrinsics


def _read(text: str, wanted: CalibrationTable, model: CameraModel) -> Intrinsics:
    if is_file_storage(text):
        _only_for("a Kalibr file", "an OpenCV file", camera=wanted.camera)
        return read_file_storage(text, wanted, model)
    content = parse_yaml(text)
    nodes = {"camera_matrix": wanted.camera_matrix, "distortion": wanted.distortion}
    if isinstance(content, dict) and kalibr_cameras(content):
        _only_for("an OpenCV file", "a Kalibr file", **nodes)
        return read_kalibr(content, wanted)
    if isinstance(content, dict) and is_camera_info(content):
        _only_for("a Kalibr file", "a ROS file", camera=wanted.camera)
        _only_for("an OpenCV file", "a ROS file", **nodes)
        return read_camera_info(content, model)
    keys = ", ".join(map(str, content)) if isinstance(content, dict) else "no keys"
    raise BadKeyError(
        f"found {keys[:80]}; allowed: OpenCV FileStorage, Kalibr camchain (cam0: intrinsics ...) "
        "or ROS camera_info (camera_matrix ...)"
    )


def _only_for(format_with: str, format_found: str, **keys: str | None) -> None:
    """Refuse a key that the file's format has no use for."""
    for key, value in keys.items():
        if value is not None:
            raise BadKeyError(
                f'{key} = "{value}" is for {format_with}, this is {format_found}; drop the key'
            )
