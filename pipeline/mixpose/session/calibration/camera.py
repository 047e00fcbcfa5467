"""What a calibration file says of a camera, and how a format of such files is registered."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from scipy.spatial.transform import Rotation

from mixpose.records import Floats
from mixpose.rigid import from_parts
from mixpose.session.arrays import numbers
from mixpose.session.calibration.content import Content
from mixpose.session.intrinsics import CameraModel, Intrinsics
from mixpose.session.messages import BadKeyError, under
from mixpose.session.motion import rigid
from mixpose.session.setup import Unit

Group: TypeAlias = Sequence[Content]


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
        t = numbers(_flat(translation), (3,), "[x, y, z]")
    if isinstance(rotation, list) and rotation and isinstance(rotation[0], list | tuple):
        rotation = _flat(rotation) if len(rotation[0]) == 1 else rotation
    allowed = "a rotation, three rows of three numbers or [x, y, z], axis times angle in radians"
    if isinstance(rotation, list) and len(rotation) == 9:
        rotation = [rotation[k : k + 3] for k in (0, 3, 6)]
    if isinstance(rotation, list) and rotation and isinstance(rotation[0], list):
        with under(key):
            R = numbers(rotation, (3, 3), allowed)
        return rigid(from_parts(R, t), key)
    with under(key):
        vector = numbers(rotation, (3,), allowed)
    return from_parts(Rotation.from_rotvec(vector).as_matrix(), t)


def motion_of_quaternion(wxyz: Sequence[float], translation: Sequence[float]) -> Floats:
    """A rigid motion (4, 4) of a quaternion, real part first, and a translation.

    Raises BadKeyError if the quaternion has no length.
    """
    w, x, y, z = wxyz
    if not 0.5 < np.linalg.norm(wxyz) < 2:
        raise BadKeyError(f"found a quaternion of length {np.linalg.norm(wxyz):.3g}; allowed: 1")
    return from_parts(Rotation.from_quat([x, y, z, w]).as_matrix(), np.asarray(translation))


def _flat(value: Any) -> Any:
    """A column of numbers as a list."""
    if isinstance(value, list) and all(isinstance(v, list) and len(v) == 1 for v in value):
        return [item[0] for item in value]
    return value
