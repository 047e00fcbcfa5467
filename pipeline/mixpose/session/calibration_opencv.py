"""Calibrations in OpenCV's FileStorage format: YAML, XML or JSON."""

from __future__ import annotations

import math
from typing import Any

import cv2

from mixpose.session.calibration_yaml import model_of_distortion
from mixpose.session.intrinsics import CameraModel, Intrinsics, camera_matrix, distortion
from mixpose.session.messages import BadKeyError, nearest, under
from mixpose.session.schema_sensors import CalibrationTable

# What OpenCV's samples and common calibration programs call their nodes, tried in order.
MATRIX_NODES = ("camera_matrix", "Camera_Matrix", "K", "M", "cameraMatrix", "mtx")
DISTORTION_NODES = (
    "distortion_coefficients",
    "Distortion_Coefficients",
    "D",
    "dist_coeffs",
    "distCoeffs",
    "dist",
)
_SIZE_NODES = (("image_width", "image_height"), ("image_Width", "image_Height"))


def is_file_storage(text: str) -> bool:
    """Whether a text is in OpenCV's own dialect of YAML, XML or JSON."""
    head = text.lstrip()
    return head.startswith(("%YAML:", "<?xml", "<opencv_storage")) or "opencv-matrix" in text


def read_file_storage(text: str, wanted: CalibrationTable, model: CameraModel) -> Intrinsics:
    """Read a camera from the text of an OpenCV calibration.

    Raises
    ------
    BadKeyError
        If the text cannot be parsed, or a node is missing or is no camera matrix or distortion.
    """
    try:
        storage = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
    except (cv2.error, SystemError) as error:  # the binding raises SystemError from cv2.error
        raise BadKeyError("OpenCV cannot parse this file as its FileStorage format") from error
    if not storage.isOpened() or not storage.root().isMap():
        raise BadKeyError("OpenCV finds no named nodes in this file")
    try:
        return _camera(storage, wanted, model)
    finally:
        storage.release()


def _camera(storage: cv2.FileStorage, wanted: CalibrationTable, model: CameraModel) -> Intrinsics:
    matrix_node = _choose(storage, "camera_matrix", wanted.camera_matrix, MATRIX_NODES)
    distortion_node = _choose(storage, "distortion", wanted.distortion, DISTORTION_NODES)
    stated = _stated_model(storage)
    with under(matrix_node):
        K = camera_matrix(_values(storage.getNode(matrix_node)))
    with under(distortion_node):
        D = distortion(_values(storage.getNode(distortion_node)), stated or model)
    return Intrinsics(K, D, _resolution(storage), stated)


def _choose(storage: cv2.FileStorage, key: str, named: str | None, usual: tuple[str, ...]) -> str:
    """The node that the user names, else the first of the usual names that is there."""
    present = list(storage.root().keys())
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


def _stated_model(storage: cv2.FileStorage) -> CameraModel | None:
    """The camera model, where the file states one (OpenCV's calibration sample does)."""
    flag = storage.getNode("fisheye_model")
    if flag.isInt():
        return "fisheye" if flag.real() else "pinhole"
    name = storage.getNode("distortion_model")
    if name.isString():
        with under("distortion_model"):
            return model_of_distortion(name.string())
    return None


def _resolution(storage: cv2.FileStorage) -> tuple[int, int] | None:
    for names in _SIZE_NODES:
        nodes = [storage.getNode(name) for name in names]
        if all(node.isInt() and node.real() > 0 for node in nodes):
            width, height = (int(node.real()) for node in nodes)
            return width, height
    return None
