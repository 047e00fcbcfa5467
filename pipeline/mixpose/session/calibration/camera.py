"""Calibration files, their cameras and rigs, and the record that describes a format."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, TypeAlias

from mixpose.records import Floats
from mixpose.session.geometry import CameraModel, Intrinsics
from mixpose.session.messages import BadKeyError, in_file
from mixpose.session.text_files import as_text, parse_toml, parse_yaml, read_bytes
from mixpose.units import Unit

Group: TypeAlias = "Sequence[Content]"
"""Files that belong together."""

Reader: TypeAlias = "Callable[[CameraModel], CalibratedCamera]"
"""Function that reads a camera; its argument is the model if the file does not state one."""

# first bytes of a NumPy array, an archive of arrays, and a pickle of Python
_BINARY = (b"\x93NUMPY", b"PK\x03\x04", b"\x80")


@dataclass(frozen=True)
class CalibratedCamera:
    """A camera of a calibration file."""

    name: str
    intrinsics: Intrinsics
    T_camera_rig: Floats | None = None  # (4, 4), rig: what cameras share; None: not stated
    unit: Unit | None = None  # of the translation; None: the format does not fix it
    note: str = ""  # a remark for the user; mostly empty


@dataclass(frozen=True)
class Rig:
    """Cameras of files that belong together and share a world frame."""

    files: tuple[str, ...]
    cameras: tuple[CalibratedCamera, ...]


@dataclass(frozen=True)
class Format:
    """A format of calibration files."""

    name: str  # with an article, as in "this is a Kalibr file"
    shown: str  # in the list of allowed formats
    recognises: Callable[[Content], bool]  # whether a file is in this format
    cameras: Callable[[Group], Mapping[str, Reader]]  # readers of the cameras of a group, by name
    # sorts files into groups; None for formats whose files do not refer to each other
    groups: Callable[[Group], list[Group]] | None = None
    holds_several: bool = True  # whether one file can hold several cameras


@dataclass(frozen=True)
class Content:
    """A calibration file."""

    name: str  # as the user wrote it
    text: str

    @property
    def stem(self) -> str:
        """Name of the file without folder and ending."""
        return Path(self.name).stem

    @cached_property
    def lines(self) -> list[str]:
        """Lines of the text, stripped."""
        return [line.strip() for line in self.text.splitlines()]

    def parsed(self) -> Any:
        """Return JSON or YAML; raise BadKeyError, chosen by the file's ending, if it is neither."""
        json_problem = ""
        if self.text.lstrip().startswith("{"):
            try:
                return json.loads(self.text)
            except (ValueError, RecursionError) as error:
                json_problem = f"not JSON: {error}"  # YAML allows braces too
        try:
            return parse_yaml(self.text)
        except BadKeyError:
            ending = Path(self.name).suffix.lower()
            if ending == ".toml":
                parse_toml(self.text)
            if ending == ".json" and json_problem:
                raise BadKeyError(json_problem) from None
            raise

    @cached_property
    def mapping(self) -> dict[Any, Any]:
        """Content as JSON or YAML; empty if it is neither, no mapping, or OpenCV's dialect."""
        if "opencv-matrix" in self.text or self.text.lstrip().startswith("<"):
            return {}
        try:
            content = self.parsed()
        except BadKeyError:
            return {}
        return content if isinstance(content, dict) else {}

    @cached_property
    def toml(self) -> dict[str, Any]:
        """Content as TOML; empty if it is not TOML."""
        try:
            return tomllib.loads(self.text)
        except (ValueError, RecursionError):
            return {}


def read_content(path: Path, name: str) -> Content:
    """Read a calibration file; raise BadKeyError if it is missing or not text."""
    content = read_bytes(path)
    with in_file(name):
        if content.startswith(_BINARY):
            raise BadKeyError(
                "a NumPy or pickle file; write camera matrix and distortion with cv2.FileStorage, "
                "or as numbers into camera_matrix and distortion in place of calibration"
            )
        return Content(name, as_text(content))
