"""Read COLMAP's text models: cameras.txt, with poses of cameras in images.txt or rigs.txt.

COLMAP measures pixels from the corner of the first one, mixpose from its centre: half a pixel is
subtracted from principal points.  Lengths have no unit, as structure from motion has no scale.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import PurePosixPath
from typing import TypeAlias

import numpy as np
from scipy.spatial.transform import Rotation

from mixpose.records import Floats
from mixpose.rigid import from_parts
from mixpose.session.calibration.camera import CalibratedCamera, Content, Format, Group, Reader
from mixpose.session.geometry import CameraModel, Intrinsics, read_camera_matrix, size_of
from mixpose.session.messages import BadKeyError, mismatch, one_of, under
from mixpose.session.values import LARGEST, as_number

_MOST_IMAGES = 100
_LONGEST = 18  # digits of an integer
_CENTRE = 0.5  # px from the corner of a pixel to its centre

_Placed: TypeAlias = dict[str, tuple[str, Floats | None]]
"""Number and pose of each camera, by name."""


# model, number of focal lengths, number of coefficients, number of OpenCV's coefficients: COLMAP's
# are the first of these, and the others are zero
_LENSES: dict[str, tuple[CameraModel, int, int, int]] = {
    "SIMPLE_PINHOLE": ("pinhole", 1, 0, 0),
    "PINHOLE": ("pinhole", 2, 0, 0),
    "SIMPLE_RADIAL": ("pinhole", 1, 1, 4),
    "RADIAL": ("pinhole", 1, 2, 4),
    "OPENCV": ("pinhole", 2, 4, 4),
    "FULL_OPENCV": ("pinhole", 2, 8, 8),
    "SIMPLE_RADIAL_FISHEYE": ("fisheye", 1, 1, 4),
    "RADIAL_FISHEYE": ("fisheye", 1, 2, 4),
    "OPENCV_FISHEYE": ("fisheye", 2, 4, 4),
}


def _is_integer(text: str) -> bool:
    return text.isascii() and text.removeprefix("-").isdigit()


def _rows(content: Content) -> list[list[str]]:
    return [line.split() for line in content.lines if line and not line.startswith("#")]


def _kind(content: Content) -> str:
    """Return which of COLMAP's files this is; empty if it is none."""
    row = next(iter(_rows(content)), [])
    match row:
        case [number, model, width, height, *_] if model.isupper() and model.isascii():
            if all(map(_is_integer, (number, width, height))):
                return "cameras"
        case [number, count, "CAMERA" | "IMU", *_] if _is_integer(number) and _is_integer(count):
            return "rigs"
        case [number, _, _, _, _, _, _, _, camera, name, *_] if _is_integer(number):
            if _is_integer(camera) and not _is_integer(name):  # names may have blanks
                return "images"
    return ""


def _of_kind(group: Group, kind: str) -> Content | None:
    files = [content for content in group if _kind(content) == kind]
    if len(files) > 1:
        raise BadKeyError(f"found {len(files)} files of COLMAP {kind}; allowed: those of one model")
    return files[0] if files else None


def _placed(group: Group) -> _Placed:
    cameras, images, rigs = (_of_kind(group, kind) for kind in ("cameras", "images", "rigs"))
    if cameras is None:
        raise BadKeyError("COLMAP's cameras.txt is missing; give it beside this file")
    placed = _from_rigs(rigs) if rigs is not None else {}
    if len(placed) > 1:
        return placed
    if images is not None:
        return _from_images(images)
    numbers = [row[0] for row in _rows(cameras)]
    return {f"camera{number}": (number, None) for number in numbers}


def _from_images(content: Content) -> _Placed:
    """Return the camera and pose of each image: a camera that was moved has several poses."""
    lines = [line for line in content.lines if not line.startswith("#")]
    while lines and not lines[0]:
        lines.pop(0)
    poses = [line.split(maxsplit=9) for line in lines[::2] if line]
    if len(poses) > _MOST_IMAGES:
        raise BadKeyError(
            f"found {len(poses)} images; allowed: at most {_MOST_IMAGES}, one of each camera: "
            "mixpose's cameras stand still"
        )
    placed: _Placed = {}
    for row in poses:
        if len(row) != 10:
            raise BadKeyError(
                f"found {' '.join(row)[:60]!r}; allowed: IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID "
                "NAME, and a line of points after each"
            )
        name = str(PurePosixPath(row[9]).with_suffix("")).replace("/", "_")
        with under("image", row[0]):
            placed[name] = (row[8], _motion(row[1:8]))
    return placed


def _from_rigs(content: Content) -> _Placed:
    """Return poses in the only rig, whose reference sensor is at the origin."""
    rigs = [row for row in _rows(content) if len(row) > 3 and _integer(row[1]) > 1]
    if len(rigs) > 1:
        raise BadKeyError(f"found {len(rigs)} rigs of several sensors; allowed: one")
    placed: _Placed = {}
    for row in rigs:
        kind, number, *cells = row[2:]
        if kind == "CAMERA":
            placed[f"camera{number}"] = (number, np.eye(4))
        while len(cells) >= 3:
            kind, number, has_pose, *cells = cells
            pose, cells = (cells[:7], cells[7:]) if has_pose == "1" else (None, cells)
            if kind == "CAMERA":
                with under("rig", row[0], f"camera{number}"):
                    placed[f"camera{number}"] = (number, _motion(pose) if pose else None)
    return placed


def _motion(cells: Sequence[str]) -> Floats:
    values = _floats(cells)
    if len(values) != 7:
        raise BadKeyError(mismatch(" ".join(cells), "QW QX QY QZ TX TY TZ"))
    length = np.linalg.norm(values[:4])
    if not 0.5 < length < 2:
        raise BadKeyError(f"found a quaternion of length {length:.3g}; allowed: 1")
    R = Rotation.from_quat(values[:4], scalar_first=True).as_matrix()
    return from_parts(R, np.asarray(values[4:]))


def _integer(cell: str) -> int:
    if not _is_integer(cell) or len(cell) > _LONGEST:
        raise BadKeyError(mismatch(cell, "an integer"))
    return int(cell)


def _floats(cells: Sequence[str]) -> list[float]:
    values = [as_number(cell) for cell in cells]
    for cell, value in zip(cells, values, strict=True):
        if not abs(value) < LARGEST:
            raise BadKeyError(mismatch(cell, "a finite number"))
    return values


def _cameras(group: Group) -> dict[str, Reader]:
    placed = _placed(group)
    return {name: partial(_read, group, placed, name) for name in placed}


def _read(group: Group, placed: _Placed, name: str, _: CameraModel) -> CalibratedCamera:
    number, pose = placed[name]
    cameras = _of_kind(group, "cameras")
    assert cameras is not None, "without it there are no names"
    row = next((row for row in _rows(cameras) if row[0] == number), None)
    if row is None:
        raise BadKeyError(f"found no camera {number} in {cameras.name}, which {name} was taken by")
    with under("camera", number):
        intrinsics = _intrinsics(row)
    note = "" if pose is None else "COLMAP's lengths have no unit and no scale"
    places = sum(number == other for other, _ in placed.values())
    if places > 1:
        note += f"; camera {number} was at {places} places, each of which is a sensor here"
    return CalibratedCamera(name, intrinsics, pose, None, note)


def _intrinsics(row: list[str]) -> Intrinsics:
    if len(row) < 5:
        raise BadKeyError(mismatch(" ".join(row), "CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]"))
    if row[1] not in _LENSES:
        raise BadKeyError(mismatch(row[1], one_of(_LENSES)))
    model, focal_lengths, stated, total = _LENSES[row[1]]
    values, count = _floats(row[4:]), focal_lengths + 2 + stated
    if len(values) != count:
        raise BadKeyError(f"found {len(values)} parameters of {row[1]}; allowed: {count} of them")
    fx, fy = values[0], values[focal_lengths - 1]
    cx, cy, *coefficients = values[focal_lengths:]
    K = read_camera_matrix([[fx, 0.0, cx - _CENTRE], [0.0, fy, cy - _CENTRE], [0.0, 0.0, 1.0]])
    D = np.array([*coefficients, *[0.0] * (total - stated)])
    return Intrinsics(K, D, size_of([_integer(cell) for cell in row[2:4]]), model)


COLMAP = Format(
    "a COLMAP file",
    "COLMAP's text (cameras.txt ...)",
    recognises=lambda content: bool(_kind(content)),
    cameras=_cameras,
    groups=lambda contents: [contents],
)
