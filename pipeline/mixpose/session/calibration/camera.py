"""A calibration file, what it says of a camera, and how a format of such files is registered."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from scipy.spatial.transform import Rotation

from mixpose.records import Floats
from mixpose.rigid import from_parts
from mixpose.session.intrinsics import CameraModel, Intrinsics, column_as_list
from mixpose.session.messages import BadKeyError, found, in_file, one_of, under
from mixpose.session.motion import rigid
from mixpose.session.setup import Unit
from mixpose.session.text_files import as_text, parse_toml, parse_yaml, read_bytes
from mixpose.session.values import numbers, resolution

Group: TypeAlias = "Sequence[Content]"

# Kalibr calls them radtan and equidistant, ROS the others; all are OpenCV's coefficients.
MODELS: dict[str, CameraModel] = {
    "radtan": "pinhole",
    "plumb_bob": "pinhole",
    "rational_polynomial": "pinhole",
    "none": "pinhole",
    "equidistant": "fisheye",
    "fisheye": "fisheye",
}

# how a NumPy array, an archive of them, and a pickle of Python begin
_NO_TEXT = (b"\x93NUMPY", b"PK\x03\x04", b"\x80")


@dataclass(frozen=True)
class CalibratedCamera:
    """A camera of a calibration file."""

    name: str
    intrinsics: Intrinsics
    # (4, 4), maps coordinates that all cameras of the file share to those of the camera; None where
    # the file does not say
    T_camera_rig: Floats | None = None
    # of the translation; None where the format leaves that to whoever wrote the file
    unit: Unit | None = None
    note: str = ""  # what a person should know of it; mostly empty


@dataclass(frozen=True)
class Rig:
    """Cameras of files that belong together, and so of one world."""

    files: tuple[str, ...]
    cameras: tuple[CalibratedCamera, ...]

    @property
    def is_placed(self) -> bool:
        """Whether the files say where cameras stand."""
        return any(camera.T_camera_rig is not None for camera in self.cameras)


@dataclass(frozen=True)
class Format:
    """A format of calibration files."""

    name: str  # with its article, as in "this is a Kalibr file"
    shown: str  # for the list of what is allowed
    recognises: Callable[[Content], bool]  # whether a file is in this format
    names: Callable[[Group], list[str]]  # names of the cameras in files that belong together
    # One of them.  The session's model helps where the files do not state one.
    read: Callable[[Group, str, CameraModel], CalibratedCamera]
    # files that belong together; None for formats whose files stand alone
    groups: Callable[[Group], list[Group]] | None = None
    holds_several: bool = True  # whether one file can hold several cameras


def motion_of(rotation: Any, translation: Any, *, key: str = "rotation") -> Floats:
    """A rigid motion (4, 4) of a rotation matrix or vector and a translation, as lists."""
    with under("translation"):
        t = numbers(column_as_list(translation), (3,), "[x, y, z]")
    rotation = column_as_list(rotation)
    allowed = "a rotation, three rows of three numbers or [x, y, z], axis times angle in radians"
    if isinstance(rotation, list) and len(rotation) == 9:
        rotation = [rotation[k : k + 3] for k in (0, 3, 6)]
    is_matrix = isinstance(rotation, list) and bool(rotation) and isinstance(rotation[0], list)
    with under(key):
        values = numbers(rotation, (3, 3) if is_matrix else (3,), allowed)
    if is_matrix:
        return rigid(from_parts(values, t), key)
    return from_parts(Rotation.from_rotvec(values).as_matrix(), t)


def motion_of_quaternion(wxyz: Sequence[float], translation: Sequence[float]) -> Floats:
    """A rigid motion (4, 4) of a quaternion, real part first, and a translation.

    Raises BadKeyError if the quaternion has no length.
    """
    w, x, y, z = wxyz
    if not 0.5 < np.linalg.norm(wxyz) < 2:
        raise BadKeyError(f"found a quaternion of length {np.linalg.norm(wxyz):.3g}; allowed: 1")
    return from_parts(Rotation.from_quat([x, y, z, w]).as_matrix(), np.asarray(translation))


def model_of_distortion(name: object) -> CameraModel | None:
    """The camera model that a distortion model of Kalibr or ROS belongs to.

    None for the empty name, which ROS writes for a camera without distortion.
    """
    if name is None or name == "":
        return None
    if isinstance(name, str) and name in MODELS:
        return MODELS[name]
    raise BadKeyError(found(name, one_of(MODELS)))


def present(content: dict[str, Any], key: str) -> Any:
    """A key without which a camera would silently count as free of distortion."""
    if key not in content:
        raise BadKeyError(f"missing; keys in the file: {', '.join(map(str, content))[:80]}")
    return content[key]


def plain(value: Any) -> Any:
    """Turn text such as 1e-05, which YAML does not take for a number, into numbers."""
    if isinstance(value, list):
        return [plain(item) for item in value]
    with suppress(ValueError):
        return float(value) if isinstance(value, str) else value
    return value


def size_of(value: Any) -> tuple[int, int] | None:
    """Width and height; None where they are missing or, as some drivers write, zero."""
    return None if value in (None, [0, 0]) else resolution(value)


@dataclass(frozen=True)
class Content:
    """A calibration file."""

    name: str  # as the user wrote it
    text: str

    @property
    def stem(self) -> str:
        """The file's name without folder and ending."""
        return Path(self.name).stem

    @cached_property
    def lines(self) -> list[str]:
        """Lines of the text without blanks around them."""
        return [line.strip() for line in self.text.splitlines()]

    def parsed(self) -> Any:
        """What the text says as JSON or YAML.

        Raises BadKeyError if it is neither; by its name's ending, why it is no TOML or JSON.
        """
        no_json = ""
        if self.text.lstrip().startswith("{"):
            try:
                return json.loads(self.text)
            except (ValueError, RecursionError) as error:
                no_json = f"not JSON: {error}"  # YAML allows braces too
        try:
            return parse_yaml(self.text)
        except BadKeyError:
            ending = Path(self.name).suffix.lower()
            if ending == ".toml":
                parse_toml(self.text)
            if ending == ".json" and no_json:
                raise BadKeyError(no_json) from None
            raise

    @cached_property
    def mapping(self) -> dict[Any, Any]:
        """Keys and values of JSON or YAML; empty where it is neither, or OpenCV's own dialect."""
        if "opencv-matrix" in self.text or self.text.lstrip().startswith("<"):
            return {}
        try:
            content = self.parsed()
        except BadKeyError:
            return {}
        return content if isinstance(content, dict) else {}

    @cached_property
    def toml(self) -> dict[str, Any]:
        """Tables of TOML; empty where it is none."""
        try:
            return tomllib.loads(self.text)
        except (ValueError, RecursionError):
            return {}


def read_content(path: Path, name: str) -> Content:
    """Read a calibration file. Raises BadKeyError if it is missing or no text."""
    content = read_bytes(path)
    with in_file(name):
        if content.startswith(_NO_TEXT):
            raise BadKeyError(
                "a NumPy or pickle file; write camera matrix and distortion with cv2.FileStorage, "
                "or as numbers into camera_matrix and distortion in place of calibration"
            )
        return Content(name, as_text(content))
