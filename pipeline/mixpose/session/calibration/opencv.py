"""Calibrations in OpenCV's FileStorage format: YAML, XML or JSON.

A file holds one camera under usual names (``camera_matrix``), several numbered ones (``M1``,
``D1``, ``M2``, ``D2`` with ``R`` and ``T`` from the first to the second, perhaps in a file of their
own), or a map for each (MC-Calib's ``camera_0``).
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
from mixpose.session import intrinsics as pieces
from mixpose.session.calibration.camera import CalibratedCamera, Content, Format, Group, Reader
from mixpose.session.intrinsics import CameraModel, Intrinsics
from mixpose.session.messages import BadKeyError, nearest, under
from mixpose.session.motion import rigid
from mixpose.session.values import numbers

# What OpenCV's samples and common calibration programs call their nodes, tried in order.
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
_DASH = re.compile(r"-(?:\s|$)")
_NUMBERED = re.compile(rf"({'|'.join(MATRIX_NODES)})_?(\d+|left|right)")


@dataclass
class _Nodes:
    """Named nodes of files that belong together; of a camera's own map, that of it."""

    nodes: dict[str, cv2.FileNode]
    # nodes point into what was read: it must live as long as they
    storages: list[cv2.FileStorage] = field(default_factory=list)


def _recognises(content: Content) -> bool:
    starts = ("%YAML:", "%YAML ", "<?xml", "<opencv_storage")
    return content.text.lstrip().startswith(starts) or "opencv-matrix" in content.text


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
    """Refuse lists within lists without end, which would end the process."""
    brackets = sum(map(content.text.count, "[{<"))
    dashes = max((len(_DASH.findall(line)) for line in content.lines), default=0)
    opened = max(brackets, dashes)
    if opened > MOST_OPENED:
        raise BadKeyError(
            f"found {opened} opening brackets, tags or dashes; allowed: {MOST_OPENED}"
        )


def _groups(contents: Group) -> list[Group]:
    """Files with cameras; one without belongs to the only other."""
    with_cameras = [content for content in contents if _places(_open([content]), content.stem)]
    others = [content for content in contents if content not in with_cameras]
    if len(with_cameras) == 1:
        return [[*with_cameras, *others]]
    return [[content] for content in contents]


def _places(opened: _Nodes, stem: str) -> dict[str, str | tuple[str, str]]:
    """By name: the map of a camera, or its nodes of matrix and distortion."""
    nested: dict[str, str | tuple[str, str]] = {
        name: name
        for name, node in opened.nodes.items()
        if node.isMap() and set(MATRIX_NODES) & set(node.keys())
    }
    if nested:
        return nested
    matrix = _usual(opened, MATRIX_NODES)
    if matrix:
        return {stem: (matrix, _usual(opened, DISTORTION_NODES) or "")}
    numbered: dict[str, str | tuple[str, str]] = {}
    for name, node in opened.nodes.items():
        match = _NUMBERED.fullmatch(name)
        if match and (node.isMap() or node.isSeq()):
            suffix = name[len(match[1]) :]
            pairs = [f"{usual}{suffix}" for usual in DISTORTION_NODES]
            label = match[2] if match[2].isalpha() else f"camera{match[2]}"
            numbered[label] = (name, next((each for each in pairs if each in opened.nodes), ""))
    # R and T lead from the first, which need not come first
    return dict(sorted(numbered.items(), key=lambda each: (len(each[0]), each[0])))


def _usual(opened: _Nodes, names: tuple[str, ...]) -> str | None:
    return next((name for name in names if name in opened.nodes), None)


def _cameras(group: Group) -> dict[str, Reader]:
    opened = _open(group)
    places = _places(opened, group[0].stem)
    if not places and {"R", "T"} <= set(opened.nodes):
        raise BadKeyError(
            "holds R and T, where one camera stands to another, and no camera matrix; allowed: "
            "beside it the file that has the matrices of the two"
        )
    if not places:  # which says what is there and how to name it
        choose_node(opened, "camera_matrix", None)
    names = list(places)
    return {name: partial(_read, opened, names, name, place) for name, place in places.items()}


def _read(
    opened: _Nodes, names: list[str], name: str, place: str | tuple[str, str], model: CameraModel
) -> CalibratedCamera:
    if not isinstance(place, str):
        intrinsics = _intrinsics(opened, model, place[0], place[1] or None)
        return CalibratedCamera(name, intrinsics, _stereo_pose(opened, names, name))
    node = opened.nodes[place]
    own = _Nodes({key: node.getNode(key) for key in list(node.keys())}, opened.storages)
    with under(place):
        return CalibratedCamera(name, _intrinsics(own, model), _own_pose(own))


def read_nodes(
    content: Content, model: CameraModel, matrix: str | None, distortion_name: str | None
) -> CalibratedCamera:
    """Read the camera whose nodes the user names; BadKeyError if they are not there or not such."""
    intrinsics = _intrinsics(_open([content]), model, matrix, distortion_name)
    return CalibratedCamera(content.stem, intrinsics)


def _intrinsics(
    opened: _Nodes, model: CameraModel, matrix: str | None = None, coefficients: str | None = None
) -> Intrinsics:
    matrix_node = choose_node(opened, "camera_matrix", matrix)
    distortion_node = choose_node(opened, "distortion", coefficients)
    stated = _stated_model(opened)
    with under(matrix_node):
        K = pieces.camera_matrix(_values(opened.nodes[matrix_node]))
    with under(distortion_node):
        D = pieces.distortion(_values(opened.nodes[distortion_node]), stated or model)
    return Intrinsics(K, D, _resolution(opened), stated)


def choose_node(opened: _Nodes, key: str, named: str | None) -> str:
    """The node that the user names, else the first of the usual names that is there."""
    usual = MATRIX_NODES if key == "camera_matrix" else DISTORTION_NODES
    present = list(opened.nodes)
    for name in usual if named is None else (named,):
        if name in present:
            return name
    nodes = f"nodes in the file: {', '.join(present) or 'none'}"
    if named is None:
        raise BadKeyError(
            f"found none of the nodes {', '.join(usual)}; name it as "
            f'calibration = {{ file = "...", {key} = "..." }}; {nodes}'
        )
    close = nearest(named, present)
    hint = f' did you mean "{close}"?' if close else ""
    raise BadKeyError(f'found no node "{named}" for {key};{hint} {nodes}')


def _stereo_pose(opened: _Nodes, names: list[str], name: str) -> Floats | None:
    """As cv2.stereoCalibrate has it: R and T map the first camera's coordinates to the second's."""
    if len(names) != 2 or not {"R", "T"} <= set(opened.nodes):
        return None
    if name == names[0]:
        return np.eye(4)
    return pieces.motion_of(_values(opened.nodes["R"]), _values(opened.nodes["T"]), key="R")


def _own_pose(own: _Nodes) -> Floats | None:
    """MC-Calib's pose of a camera in the coordinates of the first."""
    node = own.nodes.get("camera_pose_matrix")
    if node is None:
        return None
    with under("camera_pose_matrix"):
        values = numbers(_values(node), (16,), "a 4x4 matrix")
    return inverse(rigid(values.reshape(4, 4), "camera_pose_matrix"))


def _values(node: cv2.FileNode) -> Any:
    """A node as lists of numbers: a matrix row by row, a sequence as it is nested."""
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
    sizes = node.getNode("sizes")  # of an array that is no matrix, like a vector
    if sizes.empty():
        sides = [node.getNode("rows"), node.getNode("cols")]
    else:  # in XML a list of one number is a plain number
        sides = [sizes.at(i) for i in range(sizes.size())] if sizes.isSeq() else [sizes]
    whole = all(side.isInt() for side in sides) and isinstance(values, list)
    if not whole or len(values) != math.prod(int(side.real()) for side in sides):
        raise BadKeyError("found a matrix whose data is not rows x cols numbers")
    return list(values)


def _stated_model(opened: _Nodes) -> CameraModel | None:
    """The camera model, where the file states one (OpenCV's calibration sample does)."""
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


OPENCV = Format("an OpenCV file", "OpenCV FileStorage", _recognises, _cameras, _groups)
