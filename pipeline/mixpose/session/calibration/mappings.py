"""Read calibrations that are plain mappings of YAML, JSON, TOML or INI.

Kalibr: pinhole cameras with radtan or equidistant distortion, in metres.  Each has ``T_cn_cnm1``,
from the coordinates of the camera before it, or in files of visual-inertial programs (OpenVINS)
``T_cam_imu`` or its inverse ``T_imu_cam``.
ROS: camera_info as YAML of camera_calibration, as a printed message, or as the older INI, which has
headings of words, with numbers in the lines below them.
caliscope writes ``[cameras.0]`` and works in metres; aniposelib (Anipose, sleap-anipose, DANNCE)
writes ``[cam_0]``, in the unit of whoever measured the board.  In both, rotation and translation
map the world to the camera.
pycalib: the lists K, d, R and t with an entry per camera.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from functools import partial
from itertools import pairwise
from typing import Any, TypeAlias

import numpy as np

from mixpose.records import Floats
from mixpose.rigid import inverse
from mixpose.session import geometry as pieces
from mixpose.session.calibration.camera import CalibratedCamera, Content, Format, Group, Reader
from mixpose.session.geometry import CameraModel, Intrinsics, rigid
from mixpose.session.messages import BadKeyError, Key, mismatch, one_of, under
from mixpose.session.values import numbers
from mixpose.units import Unit

_MATRIX = "a 4x4 matrix, four rows of four numbers"
_INI_WORDS = ("camera matrix", "distortion", "rectification", "projection", "width", "height")

Cameras: TypeAlias = dict[str, tuple[Key, dict[str, Any]]]
"""Key and content of the table of each camera, by the camera's name."""


def _chain_cameras(group: Group) -> dict[str, Reader]:
    chain = group[0].mapping
    named = [
        name
        for name, camera in chain.items()
        if isinstance(name, str) and isinstance(camera, dict) and "intrinsics" in camera
    ]
    # YAML writers put cam10 before cam2, but the camera before cam10 is cam9
    names = sorted(named, key=lambda name: int(re.sub("[^0-9]", "", name)[-9:] or 0))
    return {name: partial(_read_link, chain, names, name) for name in names}


def _read_link(
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
    return CalibratedCamera(
        name, Intrinsics(K, D, size, model), _chain_pose(chain, names, name), "m"
    )


def _chain_pose(chain: dict[str, Any], names: list[str], wanted: str) -> Floats | None:
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
    recognises=lambda content: bool(_chain_cameras([content])),
    cameras=_chain_cameras,
)


def _ros_camera(group: Group) -> dict[str, Reader]:
    content = group[0].mapping
    name = content.get("camera_name")
    name = name if isinstance(name, str) and name.strip() else group[0].stem
    return {name: partial(_read_info, content, name)}


def _read_info(content: dict[str, Any], name: str, model: CameraModel) -> CalibratedCamera:
    _refuse_partial_image(content)
    with under("distortion_model"):
        stated = pieces.model_of_distortion(content.get("distortion_model"))
    matrix_key = _first(content, ("camera_matrix", "K", "k"))
    with under(matrix_key):
        K = pieces.read_camera_matrix(_matrix_data(content[matrix_key]))
    distortion_key = _first(content, ("distortion_coefficients", "D", "d"))
    with under(distortion_key):
        coefficients = _matrix_data(pieces.required(content, distortion_key))
        D = pieces.read_distortion(coefficients, stated or model)
        if D.size and stated is None:
            raise BadKeyError(
                f"found {D.size} coefficients without a distortion_model; "
                f"allowed: one of {one_of(pieces.MODELS)}"
            )
    width = content.get(_first(content, ("image_width", "width")))
    height = content.get(_first(content, ("image_height", "height")))
    with under("image_width"):
        size = None if width is None and height is None else pieces.size_of([width, height])
    return CalibratedCamera(name, Intrinsics(K, D, size, stated))


def _refuse_partial_image(content: dict[str, Any]) -> None:
    roi = content.get("roi")
    roi = roi if isinstance(roi, dict) else {}
    for table, *where, key, whole, kind in (
        (content, "binning_x", (0, 1), "binned"),
        (content, "binning_y", (0, 1), "binned"),
        (roi, "roi", "x_offset", (0,), "cropped"),
        (roi, "roi", "y_offset", (0,), "cropped"),
    ):
        if table.get(key, 0) not in whole:
            allowed = " or ".join(map(str, whole))
            raise BadKeyError(
                f"{mismatch(table[key], allowed)}; for {kind} images give camera_matrix and "
                "resolution in the session file",
                *where,
                key,
            )


def _first(content: dict[str, Any], keys: tuple[str, ...]) -> str:
    return next((key for key in keys if key in content), keys[0])


def _matrix_data(value: Any) -> Any:
    """Return the numbers of a matrix, written as rows, cols and data or as a list."""
    return pieces.with_numbers(value.get("data") if isinstance(value, dict) else value)


def _ini_camera(group: Group) -> dict[str, Reader]:
    headings = [line[1:-1] for line in group[0].lines if line.startswith("[") and line[-1] == "]"]
    name = next((name for name in headings if name and name != "image"), group[0].stem)
    return {name: partial(_read_ini, group[0], name)}


def _read_ini(content: Content, name: str, _: CameraModel) -> CalibratedCamera:
    values = _ini_values(content)
    with under("camera matrix"):
        K = pieces.read_camera_matrix(values.get("camera matrix"))
    with under("distortion"):
        # five coefficients (plumb_bob) or eight (rational_polynomial), in OpenCV's order
        D = pieces.read_distortion(values.get("distortion", []), "pinhole")
    with under("[image]"):
        size = pieces.size_of([_integer(values, word) for word in ("width", "height")])
    return CalibratedCamera(name, Intrinsics(K, D, size, "pinhole"))


def _ini_values(content: Content) -> dict[str, list[float]]:
    values: dict[str, list[float]] = {}
    word = ""
    for line in content.lines:
        if line in _INI_WORDS:
            word = line
            values[word] = []
        elif word and line and line[0] not in "#;[":
            try:
                values[word] += [float(cell) for cell in line.split()]
            except ValueError as error:
                raise BadKeyError(mismatch(line, "numbers"), word) from error
    return values


def _integer(values: dict[str, list[float]], word: str) -> int | float | None:
    number = next(iter(values.get(word, ())), None)
    return int(number) if number is not None and float(number).is_integer() else number


ROS = Format(
    "a ROS file",
    "ROS camera_info (camera_matrix ...)",
    recognises=lambda content: bool({"camera_matrix", "K", "k"} & set(map(str, content.mapping))),
    cameras=_ros_camera,
    holds_several=False,
)

ROS_INI = Format(
    "a ROS INI file",
    "the same as INI ([image] ... camera matrix)",
    recognises=lambda content: {"[image]", "camera matrix"} <= set(content.lines),
    cameras=_ini_camera,
    holds_several=False,
)


def _aniposelib(content: Content) -> Cameras:
    cameras = [(key, table) for key, table in content.toml.items() if _is_camera(table)]
    names = [str(table.get("name") or key) for key, table in cameras]
    # cameras of the same name keep their key, as one would hide the other
    unique = [name if names.count(name) == 1 else key for name, (key, _) in zip(names, cameras)]
    return {name: ((key,), table) for name, (key, table) in zip(unique, cameras)}


def _caliscope(content: Content) -> Cameras:
    cameras = content.toml.get("cameras")
    return {
        f"cam{number}": (("cameras", number), table)
        for number, table in (cameras.items() if isinstance(cameras, dict) else ())
        if _is_camera(table) and table.get("ignore") is not True
    }


def _is_camera(table: Any) -> bool:
    return isinstance(table, dict) and "matrix" in table and "distortions" in table


def _read_table(
    table: dict[str, Any], name: str, unit: Unit | None, _: CameraModel
) -> CalibratedCamera:
    fisheye = table.get("fisheye", False)
    if not isinstance(fisheye, bool):
        raise BadKeyError(mismatch(fisheye, "true or false"), "fisheye")
    model: CameraModel = "fisheye" if fisheye else "pinhole"
    with under("matrix"):
        K = pieces.read_camera_matrix(table["matrix"])
    with under("distortions"):
        D = pieces.read_distortion(table["distortions"], model)
    with under("size"):
        size = pieces.size_of(pieces.required(table, "size"))
    pose = None
    if table.get("rotation") is not None and table.get("translation") is not None:
        pose = pieces.motion_of(table["rotation"], table["translation"])
    return CalibratedCamera(name, Intrinsics(K, D, size, model), pose, unit)


def _format(
    name: str, shown: str, cameras_of: Callable[[Content], Cameras], unit: Unit | None
) -> Format:
    """Return a format whose files have the tables that `cameras_of` finds, with its unit."""

    def cameras(group: Group) -> dict[str, Reader]:
        tables = cameras_of(group[0]).items()
        return {n: partial(under(*key)(_read_table), table, n, unit) for n, (key, table) in tables}

    return Format(name, shown, lambda content: bool(cameras_of(content)), cameras)


ANIPOSELIB = _format("an aniposelib file", "aniposelib ([cam_0])", _aniposelib, None)
CALISCOPE = _format("a caliscope file", "caliscope ([cameras.0])", _caliscope, "m")

_DEEP = 3  # nesting of a list of matrices; a single matrix is a camera of another format


def _depth(value: Any) -> int:
    depth = 0
    while isinstance(value, list) and value:
        value, depth = value[0], depth + 1
    return depth


def _pycalib_cameras(group: Group) -> dict[str, Reader]:
    content = group[0].mapping
    count = len(content["K"])
    names = [f"cam{k + 1:0{len(str(count))}}" for k in range(count)]
    return {name: partial(_read_entry, content, k, name) for k, name in enumerate(names)}


def _read_entry(content: dict[str, Any], k: int, name: str, model: CameraModel) -> CalibratedCamera:
    with under("K", k):
        K = pieces.read_camera_matrix(content["K"][k])
    coefficients = _entry(content, "d", k)
    with under("d", k):
        D = pieces.read_distortion(coefficients, model)
    pose = None
    if "R" in content or "t" in content:
        rotation, translation = _entry(content, "R", k), _entry(content, "t", k)
        with under(name):
            pose = pieces.motion_of(rotation, translation, key="R")
    return CalibratedCamera(name, Intrinsics(K, D), pose)


def _entry(content: dict[str, Any], key: str, k: int) -> Any:
    values = content.get(key)
    count = len(content["K"])
    if not isinstance(values, list) or len(values) != count:
        raise BadKeyError(
            f"not {count} entries; allowed: one for each camera matrix of K"
            if values is not None
            else "missing; allowed: a list with an entry for each camera",
            key,
        )
    return values[k]


PYCALIB = Format(
    "a pycalib file",
    "pycalib (K, d, R, t, lists)",
    recognises=lambda content: _depth(content.mapping.get("K")) == _DEEP,
    cameras=_pycalib_cameras,
)
