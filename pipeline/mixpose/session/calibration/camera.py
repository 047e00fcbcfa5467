"""A calibration file, what it says of a camera, and how a format of such files is registered."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, TypeAlias

from mixpose.records import Floats
from mixpose.session.intrinsics import CameraModel, Intrinsics
from mixpose.session.messages import BadKeyError, in_file
from mixpose.session.text_files import as_text, parse_toml, parse_yaml, read_bytes
from mixpose.units import Unit

Group: TypeAlias = "Sequence[Content]"
"""Files that belong together."""

Reader: TypeAlias = "Callable[[CameraModel], CalibratedCamera]"
"""What reads a camera; the session's model helps where files do not state one."""

# how a NumPy array, an archive of them, and a pickle of Python begin
_NO_TEXT = (b"\x93NUMPY", b"PK\x03\x04", b"\x80")


@dataclass(frozen=True)
class CalibratedCamera:
    """A camera of a calibration file."""

    name: str
    intrinsics: Intrinsics
    T_camera_rig: Floats | None = None  # (4, 4), from what the file's cameras share; None: not said
    unit: Unit | None = None  # of the translation; None where the format does not fix it
    note: str = ""  # what a person should know of it; mostly empty


@dataclass(frozen=True)
class Rig:
    """Cameras of files that belong together, and so of one world."""

    files: tuple[str, ...]
    cameras: tuple[CalibratedCamera, ...]


@dataclass(frozen=True)
class Format:
    """A format of calibration files."""

    name: str  # with its article, as in "this is a Kalibr file"
    shown: str  # for the list of what is allowed
    recognises: Callable[[Content], bool]  # whether a file is in this format
    cameras: Callable[[Group], Mapping[str, Reader]]  # those of a group by name
    # groups of files; None for formats whose files stand alone
    groups: Callable[[Group], list[Group]] | None = None
    holds_several: bool = True  # whether one file can hold several cameras


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
        """What the text says as JSON or YAML, or why it is neither, by its name's ending."""
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
