"""ROS's camera_info: YAML as camera_calibration saves it, a message as printed, or the older INI.

The INI form has headings in words, and numbers in the lines below.
"""

from __future__ import annotations

from typing import Any

from mixpose.session.calibration.camera import CalibratedCamera, Content, Format, Group
from mixpose.session.calibration.pieces import MODELS, model_of_distortion, plain, present, size_of
from mixpose.session.intrinsics import CameraModel, Intrinsics, camera_matrix, distortion
from mixpose.session.messages import BadKeyError, found, one_of, under

_INI_WORDS = ("camera matrix", "distortion", "rectification", "projection", "width", "height")


def _names(group: Group) -> list[str]:
    name = group[0].mapping.get("camera_name")
    return [name if isinstance(name, str) and name.strip() else group[0].stem]


def _read(group: Group, name: str, model: CameraModel) -> CalibratedCamera:
    content = group[0].mapping
    _whole_image(content)
    with under("distortion_model"):
        stated = model_of_distortion(content.get("distortion_model"))
    matrix_key = _first(content, ("camera_matrix", "K", "k"))
    with under(matrix_key):
        K = camera_matrix(_matrix_data(content[matrix_key]))
    distortion_key = _first(content, ("distortion_coefficients", "D", "d"))
    with under(distortion_key):
        D = distortion(_matrix_data(present(content, distortion_key)), stated or model)
        if D.size and stated is None:
            raise BadKeyError(
                f"found {D.size} coefficients without a distortion_model; "
                f"allowed: one of {one_of(MODELS)}"
            )
    width = content.get(_first(content, ("image_width", "width")))
    height = content.get(_first(content, ("image_height", "height")))
    with under("image_width"):
        size = None if width is None and height is None else size_of([width, height])
    return CalibratedCamera(name, Intrinsics(K, D, size, stated))


def _whole_image(content: dict[str, Any]) -> None:
    for key in ("binning_x", "binning_y"):
        if content.get(key, 0) not in (0, 1):
            raise BadKeyError(
                f"{found(content[key], '0 or 1')}; for binned images give camera_matrix and "
                "resolution in the session file",
                key,
            )
    roi = content.get("roi")
    if not isinstance(roi, dict):
        return
    for key in ("x_offset", "y_offset"):
        if roi.get(key, 0) != 0:
            raise BadKeyError(
                f"{found(roi[key], '0')}; for cropped images give camera_matrix and resolution "
                "in the session file",
                "roi",
                key,
            )


def _first(content: dict[str, Any], keys: tuple[str, ...]) -> str:
    return next((key for key in keys if key in content), keys[0])


def _matrix_data(value: Any) -> Any:
    """The numbers of a matrix, written as rows, cols and data or as a plain list."""
    return plain(value.get("data") if isinstance(value, dict) else value)


def _ini_names(group: Group) -> list[str]:
    headings = [line[1:-1] for line in group[0].lines if line.startswith("[") and line[-1] == "]"]
    return [next((name for name in headings if name and name != "image"), group[0].stem)]


def _read_ini(group: Group, name: str, model: CameraModel) -> CalibratedCamera:
    values = _ini_values(group[0])
    with under("camera matrix"):
        K = camera_matrix(values.get("camera matrix"))
    with under("distortion"):
        # five coefficients of the plumb bob, eight of the rational model: both are OpenCV's
        D = distortion(values.get("distortion", []), "pinhole")
    with under("[image]"):
        size = size_of([_integer(values, word) for word in ("width", "height")])
    return CalibratedCamera(name, Intrinsics(K, D, size, "pinhole"))


def _ini_values(content: Content) -> dict[str, list[float]]:
    """Numbers below each heading."""
    values: dict[str, list[float]] = {}
    word = ""
    for line in content.lines:
        if not line or line[0] in "#;[":
            continue
        if line in _INI_WORDS:
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


ROS = Format(
    "a ROS file",
    "ROS camera_info (camera_matrix ...)",
    recognises=lambda content: bool({"camera_matrix", "K", "k"} & set(map(str, content.mapping))),
    names=_names,
    read=_read,
    holds_several=False,
)

ROS_INI = Format(
    "a ROS INI file",
    "the same as INI ([image] ... camera matrix)",
    recognises=lambda content: {"[image]", "camera matrix"} <= set(content.lines),
    names=_ini_names,
    read=_read_ini,
    holds_several=False,
)
