"""ROS's camera_info in the older INI form: headings in words, numbers in the lines below."""

from __future__ import annotations

from mixpose.session.calibration.camera import CalibratedCamera, Format, Group
from mixpose.session.calibration.content import Content
from mixpose.session.calibration.plain import size_of
from mixpose.session.intrinsics import CameraModel, Intrinsics, camera_matrix, distortion
from mixpose.session.messages import BadKeyError, found, under

_WORDS = ("camera matrix", "distortion", "rectification", "projection", "width", "height")


def _recognises(content: Content) -> bool:
    return "[image]" in content.lines and "camera matrix" in content.lines


def _names(group: Group) -> list[str]:
    headings = [line[1:-1] for line in group[0].lines if line.startswith("[") and line[-1] == "]"]
    return [next((name for name in headings if name and name != "image"), group[0].stem)]


def _read(group: Group, name: str, model: CameraModel) -> CalibratedCamera:
    values = _values(group[0])
    with under("camera matrix"):
        K = camera_matrix(values.get("camera matrix"))
    with under("distortion"):
        # five coefficients of the plumb bob, eight of the rational model: both are OpenCV's
        D = distortion(values.get("distortion", []), "pinhole")
    with under("[image]"):
        size = size_of([_integer(values, word) for word in ("width", "height")])
    return CalibratedCamera(name, Intrinsics(K, D, size, "pinhole"))


def _values(content: Content) -> dict[str, list[float]]:
    """Numbers below each heading."""
    values: dict[str, list[float]] = {}
    word = ""
    for line in content.lines:
        if not line or line[0] in "#;[":
            continue
        if line in _WORDS:
            word = line
            values[word] = []
            continue
        if word:
            try:
                values[word] += [float(cell) for cell in line.split()]
            except ValueError as error:
                raise BadKeyError(found(line, "numbers"), word) from error
    return values


def _integer(values: dict[str, list[float]], word: str) -> int | float | None:
    found_numbers = values.get(word)
    if not found_numbers:
        return None
    number = found_numbers[0]
    return int(number) if number == int(number) else number


ROS_INI = Format(
    "a ROS INI file",
    "the same as INI ([image] ... camera matrix)",
    _recognises,
    _names,
    _read,
    holds_several=False,
)
