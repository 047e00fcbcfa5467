"""One rig of two cameras, written in the format of each program, as its documentation has it."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from mixpose.records import Floats
from mixpose.rigid import from_parts, inverse

K1 = np.array([[810.5, 0, 640.25], [0, 805.0, 512.5], [0, 0, 1]])
K2 = np.array([[795.25, 0, 630.5], [0, 799.5, 498.75], [0, 0, 1]])
D1 = np.array([-0.11, 0.02, 3e-4, -2e-4])
D2 = np.array([-0.09, 0.015, -1e-4, 4e-4])
ROTATION = Rotation.from_rotvec([0.05, -0.4, 0.02])
T_METRES = np.array([0.31, -0.012, 0.09])
SIZE = (1280, 1024)


def T_second_first(scale: float = 1.0) -> Floats:
    """From the first camera's coordinates to the second's, metres times a scale."""
    return from_parts(ROTATION.as_matrix(), T_METRES * scale)


def kalibr(head: str = "", pose_keys: tuple[str, str] = ("", "T_cn_cnm1")) -> str:
    """A camchain; with other keys the poses of both cameras beside an inertial unit."""
    T_cam_imu = from_parts(Rotation.from_rotvec([1.2, -1.1, 0.4]).as_matrix(), [0.02, -0.05, 0.01])
    poses = {
        "": np.eye(4),
        "T_cn_cnm1": T_second_first(),
        "T_cam_imu": T_second_first() @ T_cam_imu,
        "T_imu_cam": inverse(T_second_first() @ T_cam_imu),
    }
    first = {"T_cam_imu": T_cam_imu, "T_imu_cam": inverse(T_cam_imu)}
    text = head
    for n, (K, D, key) in enumerate(zip((K1, K2), (D1, D2), pose_keys, strict=True)):
        text += f"cam{n}:\n"
        if key:
            rows = (first if n == 0 else poses)[key].tolist()
            text += f"  {key}:\n" + "".join(f"    - {row}\n" for row in rows)
        text += (
            f"  camera_model: pinhole\n  distortion_model: radtan\n"
            f"  distortion_coeffs: {D.tolist()}\n"
            f"  intrinsics: [{K[0, 0]}, {K[1, 1]}, {K[0, 2]}, {K[1, 2]}]\n"
            f"  resolution: {list(SIZE)}\n"
        )
    return text


def stereo_storage(folder: Path, suffix: str, *, scale: float = 1000.0) -> list[Path]:
    """OpenCV's sample for stereo: intrinsics and extrinsics in a file each."""
    nodes: list[dict[str, Floats]] = [
        {"M1": K1, "D1": D1[None], "M2": K2, "D2": D2[None]},
        {"R": ROTATION.as_matrix(), "T": T_METRES[:, None] * scale},
    ]
    paths = [folder / f"intrinsics.{suffix}", folder / f"extrinsics.{suffix}"]
    for path, named in zip(paths, nodes, strict=True):
        storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
        for name, matrix in named.items():
            storage.write(name, matrix)
        storage.release()
    return paths


def mc_calib(head: str = "%YAML:1.0\n---\n", *, scale: float = 100.0) -> str:
    """A map for each camera; poses are those of cameras in the coordinates of the first."""
    text = f"{head}nb_camera: 2\n"
    poses = (np.eye(4), inverse(T_second_first(scale)))
    for n, (K, D, pose) in enumerate(zip((K1, K2), (D1, D2), poses, strict=True)):
        text += f"camera_{n}:\n"
        matrices = {"camera_matrix": K, "distortion_vector": D[None], "camera_pose_matrix": pose}
        for name, matrix in matrices.items():
            rows, cols = matrix.shape
            text += (
                f"   {name}: !!opencv-matrix\n      rows: {rows}\n      cols: {cols}\n"
                f"      dt: d\n      data: {matrix.ravel().tolist()}\n"
            )
        text += f"   distortion_type: 0\n   img_width: {SIZE[0]}\n   img_height: {SIZE[1]}\n"
    return text


def pycalib(*, scale: float = 100.0) -> str:
    T = T_second_first(scale)
    return json.dumps(
        {
            "K": [K1.tolist(), K2.tolist()],
            "d": [D1.tolist(), D2.tolist()],
            "R": [np.eye(3).tolist(), T[:3, :3].tolist()],
            "t": [[[0.0], [0.0], [0.0]], T[:3, 3, None].tolist()],
        }
    )


def toml(heading: str, *, as_vector: bool = True, scale: float = 1.0, names: bool = False) -> str:
    """caliscope's tables or aniposelib's."""
    text = ""
    rotations = (Rotation.identity(), ROTATION)
    for n, (K, D, R) in enumerate(zip((K1, K2), (D1, D2), rotations, strict=True)):
        t = T_METRES * scale * n
        rotation = R.as_rotvec() if as_vector else R.as_matrix()
        text += f"[{heading}{n}]\n"
        text += f'name = "view{n}"\n' * names
        text += (
            f"size = {list(SIZE)}\nmatrix = {K.tolist()}\ndistortions = {D.tolist()}\n"
            f"rotation = {rotation.tolist()}\ntranslation = {t.tolist()}\n\n"
        )
    return text + "[metadata]\nerror = 0.5\n" * names


def colmap(folder: Path, *, with_rig: bool, scale: float = 1.0) -> list[Path]:
    """A text model: pixels count from the corner of the image."""
    cameras, images = "# Camera list\n", "# Image list\n"
    rig = "# Rig calib list\n1 2 CAMERA 1"
    rotations = (Rotation.identity(), ROTATION)
    for n, (K, D, R) in enumerate(zip((K1, K2), (D1, D2), rotations, strict=True)):
        parameters = [K[0, 0], K[1, 1], K[0, 2] + 0.5, K[1, 2] + 0.5, *D]
        cells = " ".join(repr(float(value)) for value in parameters)
        cameras += f"{n + 1} OPENCV {SIZE[0]} {SIZE[1]} {cells}\n"
        x, y, z, w = R.as_quat()
        pose = " ".join(repr(float(value)) for value in (w, x, y, z, *(T_METRES * scale * n)))
        images += f"{n + 1} {pose} {n + 1} view/{n}.png\n\n"
        rig += f" CAMERA 2 1 {pose}" * n
    paths = [folder / "cameras.txt", folder / ("rigs.txt" if with_rig else "images.txt")]
    paths[0].write_text(cameras, encoding="utf-8")
    paths[1].write_text(f"{rig}\n" if with_rig else images, encoding="utf-8")
    return paths


ROS_INI = f"""# oST version 5.0 parameters

[image]

width
{SIZE[0]}

height
{SIZE[1]}

[left]

camera matrix
810.500000 0.000000 640.250000
0.000000 805.000000 512.500000
0.000000 0.000000 1.000000

distortion
-0.110000 0.020000 0.000300 -0.000200 0.000000

rectification
1 0 0
0 1 0
0 0 1

projection
262.9 0.0 320.9 0.0
0.0 302.0 188.5 0.0
0.0 0.0 1.0 0.0
"""
