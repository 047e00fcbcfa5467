"""Read ROS's camera_info: YAML of camera_calibration, a printed message, or the older INI.

The INI form has headings of words, with numbers in the lines below them.
"""

from __future__ import annotations

from functools import partial
from typing import Any

from mixpose.session import geometry as pieces
from mixpose.session.calibration.camera import CalibratedCamera, Content, Format, Group, Reader
from mixpose.session.geometry import CameraModel, Intrinsics
from mixpose.session.messages import BadKeyError, mismatch, one_of, under

_INI_WORDS = ("camera matrix", "distortion", "rectification", "projection", "width", "height")


def _camera(group: Group) -> dict[str, Reader]:
    content = group[0].mapping
    name = content.get("camera_name")
    name = name if isinstance(name, str) and name.strip() else group[0].stem
    return {name: partial(_read, content, name)}


def _read(content: dict[str, Any], name: str, model: CameraModel) -> CalibratedCamera:
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
    cameras=_camera,
    holds_several=False,
)

ROS_INI = Format(
    "a ROS INI file",
    "the same as INI ([image] ... camera matrix)",
    recognises=lambda content: {"[image]", "camera matrix"} <= set(content.lines),
    cameras=_ini_camera,
    holds_several=False,
)
