"""Read Kalibr's camchain: pinhole cameras with radtan or equidistant distortion, in metres.

Each camera has ``T_cn_cnm1``, from the coordinates of the camera before it.  Files of
visual-inertial programs (OpenVINS) have ``T_cam_imu`` or its inverse ``T_imu_cam`` instead.
"""

from __future__ import annotations

import re
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np

from mixpose.records import Floats
from mixpose.rigid import inverse
from mixpose.session import geometry as pieces
from mixpose.session.calibration.camera import CalibratedCamera, Format, Group, Reader
from mixpose.session.geometry import CameraModel, Intrinsics, rigid
from mixpose.session.messages import BadKeyError, mismatch, under
from mixpose.session.values import numbers

_MATRIX = "a 4x4 matrix, four rows of four numbers"


def _cameras(group: Group) -> dict[str, Reader]:
    chain = group[0].mapping
    named = [
        name
        for name, camera in chain.items()
        if isinstance(name, str) and isinstance(camera, dict) and "intrinsics" in camera
    ]
    # YAML writers put cam10 before cam2, but the camera before cam10 is cam9
    names = sorted(named, key=lambda name: int(re.sub("[^0-9]", "", name)[-9:] or 0))
    return {name: partial(_read, chain, names, name) for name in names}


def _read(
    chain: dict[str, Any], names: list[str], name: str, model: CameraModel
) -> CalibratedCamera:
    camera = chain[name]
    with under(name):
        if camera.get("camera_model", "pinhole") != "pinhole":
            raise BadKeyError(mismatch(camera["camera_model"], '"pinhole"'), "camera_model")
        with under("distortion_model"):
            stated = pieces.required(camera, "distortion_model")
            model = pieces.model_of_distortion(stated) or "pinhole"
        with under("intrinsics"):
            intrinsics = pieces.with_numbers(camera["intrinsics"])
            if not isinstance(intrinsics, list) or len(intrinsics) != 4:
                raise BadKeyError(mismatch(intrinsics, "[fu, fv, pu, pv]"))
            fu, fv, pu, pv = intrinsics
            K = pieces.read_camera_matrix([[fu, 0.0, pu], [0.0, fv, pv], [0.0, 0.0, 1.0]])
        with under("distortion_coeffs"):
            coefficients = [] if stated == "none" else pieces.required(camera, "distortion_coeffs")
            D = pieces.read_distortion(pieces.with_numbers(coefficients), model)
        with under("resolution"):
            size = pieces.size_of(camera.get("resolution"))
    return CalibratedCamera(name, Intrinsics(K, D, size, model), _pose(chain, names, name), "m")


def _pose(chain: dict[str, Any], names: list[str], wanted: str) -> Floats | None:
    """Return the motion from the first camera's frame to another's; None if a link is missing."""
    T = np.eye(4)
    for before, name in pairwise(names[: names.index(wanted) + 1]):
        step = _step(chain, before, name)
        if step is None:
            return None
        T = step @ T
    # a single camera has no rig
    return T if len(names) > 1 else None


def _step(chain: dict[str, Any], before: str, name: str) -> Floats | None:
    T_camera_before = _motion(chain, name, "T_cn_cnm1")
    if T_camera_before is not None:
        return T_camera_before
    first, second = _from_imu(chain, before), _from_imu(chain, name)
    return None if first is None or second is None else second @ inverse(first)


def _from_imu(chain: dict[str, Any], name: str) -> Floats | None:
    T_cam_imu = _motion(chain, name, "T_cam_imu")
    if T_cam_imu is not None:
        return T_cam_imu
    T_imu_cam = _motion(chain, name, "T_imu_cam")
    return None if T_imu_cam is None else inverse(T_imu_cam)


def _motion(chain: dict[str, Any], name: str, key: str) -> Floats | None:
    if key not in chain[name]:
        return None
    with under(name):
        with under(key):
            matrix = numbers(pieces.with_numbers(chain[name][key]), (4, 4), _MATRIX)
        return rigid(matrix, key)


KALIBR = Format(
    "a Kalibr file",
    "Kalibr camchain (cam0: intrinsics ...)",
    recognises=lambda content: bool(_cameras([content])),
    cameras=_cameras,
)
