"""Calibrations in plain YAML: Kalibr's camchain and ROS's camera_info."""

from __future__ import annotations

from typing import Any

from mixpose.limits import MOST_YAML_BYTES, MOST_YAML_NODES
from mixpose.rigid import Floats
from mixpose.session.arrays import resolution
from mixpose.session.intrinsics import CameraModel, Intrinsics, camera_matrix, distortion
from mixpose.session.messages import BadKeyError, found, one_of, under
from mixpose.session.schema_sensors import CalibrationTable

# Kalibr calls them radtan and equidistant, ROS the others; all are OpenCV's coefficients.
_MODELS: dict[str, CameraModel] = {
    "radtan": "pinhole",
    "plumb_bob": "pinhole",
    "rational_polynomial": "pinhole",
    "none": "pinhole",
    "equidistant": "fisheye",
    "fisheye": "fisheye",
}


def model_of_distortion(name: object) -> CameraModel | None:
    """The camera model that a distortion model of Kalibr or ROS belongs to.

    Returns
    -------
    {"pinhole", "fisheye"} or None
        None for the empty name, which ROS writes for a camera without distortion.

    Raises
    ------
    BadKeyError
        If mixpose has no such model.
    """
    if name is None or name == "":
        return None
    if isinstance(name, str) and name in _MODELS:
        return _MODELS[name]
    raise BadKeyError(found(name, one_of(_MODELS)))


def parse_yaml(text: str) -> Any:
    """Parse the first document of a YAML text."""
    import yaml  # noqa: PLC0415  # only sessions with such a calibration need it

    if len(text) > MOST_YAML_BYTES:
        raise BadKeyError(
            f"found {len(text)} characters of YAML; allowed: at most {MOST_YAML_BYTES}"
        )
    try:
        for node in yaml.compose_all(text, yaml.SafeLoader):
            _check_size(node)
        return next((part for part in yaml.safe_load_all(text) if part is not None), None)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        line = f" at line {mark.line + 1}" if mark else ""
        raise BadKeyError(f"not YAML{line}: {error.problem or error.context}") from error
    except (yaml.YAMLError, ValueError, LookupError, TypeError, RecursionError) as error:
        raise BadKeyError(f"not YAML: {error}") from error


def _check_size(root: Any) -> None:
    """Refuse a document that its aliases make large: a few bytes may stand for gigabytes."""
    sizes: dict[int, float] = {}

    def size_of(node: Any) -> float:
        known = sizes.get(id(node))
        if known is not None:
            return known
        sizes[id(node)] = float("inf")  # met again inside of itself: without end
        value = node.value
        parts = [] if isinstance(value, str) else value
        flat = [each for part in parts for each in (part if isinstance(part, tuple) else (part,))]
        sizes[id(node)] = 1 + sum(map(size_of, flat))
        return sizes[id(node)]

    if root is not None and size_of(root) > MOST_YAML_NODES:
        raise BadKeyError(
            f"its aliases (*name) stand for more than {MOST_YAML_NODES} values; write out what is "
            "meant"
        )


def kalibr_cameras(content: dict[str, Any]) -> list[str]:
    """Names of the cameras in a Kalibr camchain; empty if the file is none."""
    return [
        name
        for name, camera in content.items()
        if isinstance(name, str) and isinstance(camera, dict) and "intrinsics" in camera
    ]


def read_kalibr(content: dict[str, Any], wanted: CalibrationTable) -> Intrinsics:
    """Read one camera of a Kalibr camchain; where cameras stand to each other is not read.

    Raises
    ------
    BadKeyError
    """
    cameras = kalibr_cameras(content)
    name = wanted.camera
    if name is None:
        if len(cameras) > 1:
            raise BadKeyError(
                f"holds the cameras {', '.join(cameras)}; choose one as "
                f'calibration = {{ file = "...", camera = "{cameras[0]}" }}'
            )
        name = cameras[0]
    if name not in cameras:
        raise BadKeyError(f'found no camera "{name}"; cameras in the file: {", ".join(cameras)}')
    camera = content[name]
    with under(name):
        if camera.get("camera_model", "pinhole") != "pinhole":
            raise BadKeyError(found(camera["camera_model"], '"pinhole"'), "camera_model")
        with under("distortion_model"):
            stated = _present(camera, "distortion_model")
            model = model_of_distortion(stated) or "pinhole"
        with under("intrinsics"):
            K = _kalibr_matrix(_plain(camera["intrinsics"]))
        with under("distortion_coeffs"):
            coefficients = [] if stated == "none" else _present(camera, "distortion_coeffs")
            D = distortion(_plain(coefficients), model)
        with under("resolution"):
            size = _resolution(camera.get("resolution"))
    return Intrinsics(K, D, size, model)


def _kalibr_matrix(intrinsics: Any) -> Floats:
    if not isinstance(intrinsics, list) or len(intrinsics) != 4:
        raise BadKeyError(found(intrinsics, "[fu, fv, pu, pv]"))
    fu, fv, pu, pv = intrinsics
    return camera_matrix([[fu, 0.0, pu], [0.0, fv, pv], [0.0, 0.0, 1.0]])


def is_camera_info(content: dict[str, Any]) -> bool:
    """Whether a YAML file is ROS's camera_info: a calibration file or a printed message."""
    return "camera_matrix" in content or bool({"K", "k"} & set(content))


def read_camera_info(content: dict[str, Any], model: CameraModel) -> Intrinsics:
    """Read ROS's camera_info, as camera_calibration saves it or as a topic prints it.

    Raises
    ------
    BadKeyError
        Also if the message tells of a cropped or binned image, which its matrix does not show.
    """
    _whole_image(content)
    with under("distortion_model"):
        stated = model_of_distortion(content.get("distortion_model"))
    matrix_key = _first(content, ("camera_matrix", "K", "k"))
    with under(matrix_key):
        K = camera_matrix(_matrix_data(content[matrix_key]))
    distortion_key = _first(content, ("distortion_coefficients", "D", "d"))
    with under(distortion_key):
        D = distortion(_matrix_data(_present(content, distortion_key)), stated or model)
        if D.size and stated is None:
            raise BadKeyError(
                f"found {D.size} coefficients without a distortion_model; "
                f"allowed: one of {one_of(_MODELS)}"
            )
    width = content.get(_first(content, ("image_width", "width")))
    height = content.get(_first(content, ("image_height", "height")))
    with under("image_width"):
        size = None if width is None and height is None else _resolution([width, height])
    return Intrinsics(K, D, size, stated)


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


def _present(content: dict[str, Any], key: str) -> Any:
    """A key without which a camera would silently count as free of distortion."""
    if key not in content:
        raise BadKeyError(f"missing; keys in the file: {', '.join(map(str, content))[:80]}")
    return content[key]


def _first(content: dict[str, Any], keys: tuple[str, ...]) -> str:
    return next((key for key in keys if key in content), keys[0])


def _matrix_data(value: Any) -> Any:
    """The numbers of a matrix, written as rows, cols and data or as a plain list."""
    return _plain(value.get("data") if isinstance(value, dict) else value)


def _plain(value: Any) -> Any:
    """Turn text such as 1e-05, which YAML does not take for a number, into numbers."""
    if isinstance(value, list):
        return [_plain(item) for item in value]
    if isinstance(value, str):
        try:
            return float(value)
        except ValueError:
            return value
    return value


def _resolution(value: Any) -> tuple[int, int] | None:
    """Width and height; None where they are missing or, as some drivers write, zero."""
    return None if value in (None, [0, 0]) else resolution(value)
