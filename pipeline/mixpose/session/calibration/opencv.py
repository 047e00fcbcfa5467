"""Read calibrations in OpenCV's FileStorage format: YAML, XML or JSON.

A file holds one camera under common names (``camera_matrix``), several numbered ones (``M1``,
``D1``, ``M2``, ``D2`` with ``R`` and ``T`` from the first to the second, perhaps in a separate
file), or a map per camera (MC-Calib's ``camera_0``).
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import cv2
import numpy as np

from mixpose.limits import MOST_OPENED
from mixpose.records import Floats
from mixpose.rigid import inverse
from mixpose.session import geometry as pieces
from mixpose.session.calibration.camera import CalibratedCamera, Content, Format, Group, Reader
from mixpose.session.geometry import CameraModel, Intrinsics, rigid
from mixpose.session.messages import BadKeyError, did_you_mean, under
from mixpose.session.values import numbers

# Names of nodes in files of OpenCV's samples and common calibration programs, tried in order.
MATRIX_NODES = ("camera_matrix", "Camera_Matrix", "K", "M", "cameraMatrix", "mtx")
DISTORTION_NODES = (
    "distortion_coefficients",
    "Distortion_Coefficients",
    "distortion_vector",
    "D",
    "dist_coeffs",
    "distCoeffs",
    "dist",
)
_SIZE_NODES = (
    ("image_width", "image_height"),
    ("image_Width", "image_Height"),
    ("img_width", "img_height"),
)
_STARTS = ("%YAML:", "%YAML ", "<?xml", "<opencv_storage")
_DASH = re.compile(r"-(?:\s|$)")
_NUMBERED = re.compile(rf"({'|'.join(MATRIX_NODES)})_?(\d+|left|right)")


@dataclass
class _Nodes:
    """Named nodes of files that belong together, or of the map of a single camera."""

    nodes: dict[str, cv2.FileNode]
    # nodes point into their storages, which must live as long as they
    storages: list[cv2.FileStorage] = field(default_factory=list)


def _open(group: Iterable[Content]) -> _Nodes:
    opened = _Nodes({})
    for content in group:
        _require_shallow(content)
        try:
            storage = cv2.FileStorage(content.text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
        except (cv2.error, SystemError) as error:  # the binding raises SystemError from cv2.error
            raise BadKeyError("OpenCV cannot parse this file as its FileStorage format") from error
        if not storage.isOpened() or not storage.root().isMap():
            raise BadKeyError("OpenCV finds no named nodes in this file")
        opened.storages.append(storage)
        for name in list(storage.root().keys()):
            opened.nodes.setdefault(name, storage.getNode(name))
    return opened


def _require_shallow(content: Content) -> None:
    """Refuse deeply nested lists, on which OpenCV would crash the process."""
    brackets = sum(map(content.text.count, "[{<"))
    dashes = max((len(_DASH.findall(line)) for line in content.lines), default=0)
    opened = max(brackets, dashes)
    if opened > MOST_OPENED:
        raise BadKeyError(
            f"found {opened} opening brackets, tags or dashes; allowed: {MOST_OPENED}"
        )


def _groups(contents: Group) -> list[Group]:
    """Return groups of files; those without cameras belong to the file with cameras, if single."""
    with_cameras = [content for content in contents if _entries(_open([content]), content.stem)]
    others = [content for content in contents if content not in with_cameras]
    if len(with_cameras) == 1:
        return [[*with_cameras, *others]]
    return [[content] for content in contents]


def _entries(opened: _Nodes, stem: str) -> dict[str, str | tuple[str, str]]:
    """Return the map of each camera, or its nodes of matrix and distortion, by name."""
    nested: dict[str, str | tuple[str, str]] = {
        name: name
        for name, node in opened.nodes.items()
        if node.isMap() and set(MATRIX_NODES) & set(node.keys())
    }
    if nested:
        return nested
    matrix = _first_present(opened, MATRIX_NODES)
    if matrix:
        return {stem: (matrix, _first_present(opened, DISTORTION_NODES))}
    numbered: dict[str, str | tuple[str, str]] = {}
    for name, node in opened.nodes.items():
        match = _NUMBERED.fullmatch(name)
        if match and (node.isMap() or node.isSeq()):
            suffix = name[len(match[1]) :]
            distortions = [f"{common}{suffix}" for common in DISTORTION_NODES]
            label = match[2] if match[2].isalpha() else f"camera{match[2]}"
            numbered[label] = (name, _first_present(opened, distortions))
    # R and T lead from the first camera by number, which need not be the first in the file
    return dict(sorted(numbered.items(), key=lambda item: (len(item[0]), item[0])))


def _first_present(opened: _Nodes, names: Iterable[str]) -> str:
    return next((name for name in names if name in opened.nodes), "")


def _cameras(group: Group) -> dict[str, Reader]:
    opened = _open(group)
    entries = _entries(opened, group[0].stem)
    if not entries and {"R", "T"} <= set(opened.nodes):
        raise BadKeyError(
            "holds R and T, where one camera stands to another, and no camera matrix; allowed: "
            "beside it the file that has the matrices of the two"
        )
    if not entries:  # raises a BadKeyError that lists the nodes of the file
        choose_node(opened, "camera_matrix", None)
    names = list(entries)
    return {name: partial(_read, opened, names, name, entry) for name, entry in entries.items()}


def _read(
    opened: _Nodes, names: list[str], name: str, entry: str | tuple[str, str], model: CameraModel
) -> CalibratedCamera:
    if not isinstance(entry, str):
        intrinsics = _intrinsics(opened, model, entry[0], entry[1] or None)
        return CalibratedCamera(name, intrinsics, _stereo_pose(opened, names, name))
    node = opened.nodes[entry]
    camera = _Nodes({key: node.getNode(key) for key in list(node.keys())}, opened.storages)
    with under(entry):
        return CalibratedCamera(name, _intrinsics(camera, model), _mc_calib_pose(camera))


def read_nodes(
    content: Content, model: CameraModel, matrix: str | None, distortion_name: str | None
) -> CalibratedCamera:
    """Read the camera whose nodes the user names; raise BadKeyError if they are not valid."""
    intrinsics = _intrinsics(_open([content]), model, matrix, distortion_name)
    return CalibratedCamera(content.stem, intrinsics)


def _intrinsics(
    opened: _Nodes, model: CameraModel, matrix: str | None = None, coefficients: str | None = None
) -> Intrinsics:
    matrix_node = choose_node(opened, "camera_matrix", matrix)
    distortion_node = choose_node(opened, "distortion", coefficients)
    stated = _stated_model(opened)
    with under(matrix_node):
        K = pieces.read_camera_matrix(_values(opened.nodes[matrix_node]))
    with under(distortion_node):
        D = pieces.read_distortion(_values(opened.nodes[distortion_node]), stated or model)
    return Intrinsics(K, D, _resolution(opened), stated)


def choose_node(opened: _Nodes, key: str, named: str | None) -> str:
    """Return the node that the user names, else the first of the common names in the file."""
    common = MATRIX_NODES if key == "camera_matrix" else DISTORTION_NODES
    present = list(opened.nodes)
    for name in common if named is None else (named,):
        if name in present:
            return name
    nodes = f"nodes in the file: {', '.join(present) or 'none'}"
    if named is None:
        raise BadKeyError(
            f"found none of the nodes {', '.join(common)}; name it as "
            f'calibration = {{ file = "...", {key} = "..." }}; {nodes}'
        )
    hint = did_you_mean(named, present) or ";"
    raise BadKeyError(f'found no node "{named}" for {key}{hint} {nodes}')


def _stereo_pose(opened: _Nodes, names: list[str], name: str) -> Floats | None:
    """Return T_camera_rig by R and T of cv2.stereoCalibrate, from the first to the second."""
    if len(names) != 2 or not {"R", "T"} <= set(opened.nodes):
        return None
    if name == names[0]:
        return np.eye(4)
    return pieces.motion_of(_values(opened.nodes["R"]), _values(opened.nodes["T"]), key="R")


def _mc_calib_pose(camera: _Nodes) -> Floats | None:
    """Return T_camera_rig from MC-Calib's pose of a camera in the frame of the first."""
    node = camera.nodes.get("camera_pose_matrix")
    if node is None:
        return None
    with under("camera_pose_matrix"):
        values = numbers(_values(node), (16,), "a 4x4 matrix")
    return inverse(rigid(values.reshape(4, 4), "camera_pose_matrix"))


def _values(node: cv2.FileNode) -> Any:
    """Return a node as lists of numbers: a matrix row by row, a sequence as it is nested."""
    if node.isMap():
        return _matrix(node)
    if node.isSeq():
        return [_values(node.at(i)) for i in range(node.size())]
    if node.isInt() or node.isReal():
        return node.real()
    return node.string() if node.isString() else None


def _matrix(node: cv2.FileNode) -> list[Any]:
    # FileNode.mat trusts rows and cols and overwrites memory where they are missing or wrong
    values: Any = _values(node.getNode("data"))
    sizes = node.getNode("sizes")  # of an array that is no matrix, such as a vector
    if sizes.empty():
        sides = [node.getNode("rows"), node.getNode("cols")]
    else:  # in XML a list of one number is written as a number
        sides = [sizes.at(i) for i in range(sizes.size())] if sizes.isSeq() else [sizes]
    is_valid = all(side.isInt() for side in sides) and isinstance(values, list)
    if not is_valid or len(values) != math.prod(int(side.real()) for side in sides):
        raise BadKeyError("found a matrix whose data is not rows x cols numbers")
    return list(values)


def _stated_model(opened: _Nodes) -> CameraModel | None:
    """Return the camera model if the file states it, as OpenCV's calibration sample does."""
    for key in ("fisheye_model", "distortion_type"):  # the latter is MC-Calib's
        flag = opened.nodes.get(key)
        if flag is not None and flag.isInt():
            return "fisheye" if flag.real() else "pinhole"
    name = opened.nodes.get("distortion_model")
    if name is not None and name.isString():
        with under("distortion_model"):
            return pieces.model_of_distortion(name.string())
    return None


def _resolution(opened: _Nodes) -> tuple[int, int] | None:
    for names in _SIZE_NODES:
        nodes = [opened.nodes[name] for name in names if name in opened.nodes]
        sizes = [int(node.real()) for node in nodes if node.isInt() and node.real() > 0]
        if len(sizes) == 2:
            return sizes[0], sizes[1]
    return None


OPENCV = Format(
    "an OpenCV file",
    "OpenCV FileStorage",
    recognises=lambda content: (
        content.text.lstrip().startswith(_STARTS) or "opencv-matrix" in content.text
    ),
    cameras=_cameras,
    groups=_groups,
)
