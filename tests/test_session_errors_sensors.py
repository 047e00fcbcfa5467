"""Sensors that a session describes wrong: one line that names the key, the find and the rule."""

from __future__ import annotations

from pathlib import Path

import pytest
from session_lines import LINES, message_of, with_lines

LEFT = 'sensor["left"].'
IDENTITY = "[[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]"

WRONG: list[tuple[dict[str, str], list[str]]] = [
    # any sensor
    ({"left": LINES["left"].replace('name = "left"', "")}, ["sensor[0].name: missing"]),
    ({"left": LINES["left"].replace('"left"', '"a=b"')}, ['sensor["a=b"].name: found "a=b"']),
    (
        {"left": LINES["left"].replace('"left"', '"beam"')},
        ["sensor[1].name", "the name of sensor[0]"],
    ),
    ({"left": LINES["left"].replace('"left"', "3")}, ["sensor[0].name: found 3"]),
    (
        {"left": LINES["left"].replace("pinhole", "pinhol")},
        [LEFT + "model", 'did you mean "pinhole"?'],
    ),
    (
        {"left": LINES["left"].replace("model", "modle")},
        [LEFT + 'modle: unknown key; did you mean "model"?'],
    ),
    ({"left": '[[sensor]]\nname = "left"'}, [LEFT + "model: missing", '"lateration"']),
    ({"left": LINES["left"].replace('"l*.png"', '""')}, [LEFT + 'source: found ""']),
    ({"left": LINES["left"].replace('"l*.png"', "[]")}, [LEFT + "source: found []"]),
    ({"left": LINES["left"].replace('"l*.png"', '["a", 3]')}, [LEFT + 'source: found ["a", 3]']),
    ({"left_more": "fps = 0"}, [LEFT + "fps: found 0"]),
    ({"left_more": "fps = 1e300"}, [LEFT + "fps: found 1e+300"]),
    ({"left_more": 'fps = 5\ntimes = "t.csv"'}, [LEFT + "fps: stands beside times"]),
    (
        {"left_more": "sigma = 5"},
        [
            LEFT + "sigma: unknown key",
            "[object] or [object.gravity] or [extract] or [sensor.extract]",
        ],
    ),
    ({"left_more": "euler_xyz_deg = [0, 0, 0]"}, [LEFT + "euler_xyz_deg: unknown key", "[start]"]),
    ({"left_more": "range_bias = 1"}, [LEFT + "range_bias: unknown key", "model lateration"]),
    # where it stands
    (
        {"left_more": "T_sensor_world = " + IDENTITY.replace("0, 1]]", "1, 1]]")},
        [LEFT + "T_sensor_world: found no rigid motion", "last row"],
    ),
    (
        {"left_more": "T_sensor_world = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [5, 0, 0, 1]]"},
        [LEFT + "T_sensor_world", "transpose"],
    ),
    (
        {"left_more": "T_sensor_world = " + IDENTITY.replace("[[1", "[[1.001")},
        [LEFT + "T_sensor_world", "not orthonormal", "by 0.002"],
    ),
    (
        {"left_more": "T_sensor_world = " + IDENTITY.replace("[[1", "[[-1")},
        [LEFT + "T_sensor_world", "mirrors"],
    ),
    (
        {"left_more": "T_sensor_world = " + IDENTITY.replace("0]", "inf]", 1)},
        [LEFT + "T_sensor_world[0][3]: found inf"],
    ),
    (
        {"left_more": "T_world_sensor = " + IDENTITY},
        [
            LEFT + 'T_world_sensor: unknown key; did you mean "T_sensor_world", the inverse of it, '
            "which maps world to sensor coordinates?"
        ],
    ),
    ({"left_more": "T_sensor_wrld = " + IDENTITY}, ['did you mean "T_sensor_world"?']),
    ({"left_more": "quaternion_xyzw = [0, 0, 0, 1]"}, [LEFT + "translation: missing"]),
    # cameras
    ({"matrix": ""}, [LEFT + "camera_matrix: missing", "calibration"]),
    (
        {"matrix": "camera_matirx = 3"},
        [LEFT + 'camera_matirx: unknown key; did you mean "camera_matrix"?'],
    ),
    ({"matrix": "camera_matrix = [[800, 0], [0, 800]]"}, [LEFT + "camera_matrix: found [[800, 0]"]),
    (
        {"matrix": "camera_matrix = [[800, 0, 640], [0, 0, 512], [0, 0, 1]]"},
        [LEFT + "camera_matrix: found the focal length fy = 0"],
    ),
    (
        {"matrix": "camera_matrix = [[-800, 0, 640], [0, 800, 512], [0, 0, 1]]"},
        [LEFT + "camera_matrix: found the focal length fx = -800"],
    ),
    (
        {"matrix": "camera_matrix = [[5e-324, 0, 640], [0, 800, 512], [0, 0, 1]]"},
        [LEFT + "camera_matrix: found the focal length fx = 4.94066e-324"],
    ),
    (
        {"matrix": "camera_matrix = [[800, 0, 0], [0, 800, 0], [640, 512, 1]]"},
        [LEFT + "camera_matrix", "transpose it"],
    ),
    (
        {"matrix": "camera_matrix = [[800, 640, 0], [0, 800, 512], [0, 0, 1]]"},
        [LEFT + "camera_matrix", "cx comes third"],
    ),
    (
        {"matrix": "camera_matrix = [[800, 0, 640], [0, 800, 512], [0, 0, 2]]"},
        [LEFT + "camera_matrix", "[0, 0, 1]]"],
    ),
    (
        {"left_more": "distortion = [0.1, 0.1, 0]"},
        [LEFT + "distortion: found 3 coefficients", "4 or 5 or 8"],
    ),
    ({"left_more": "distortion = [0.1, 0.1, 0, nan]"}, [LEFT + "distortion[3]: found nan"]),
    ({"left_more": "distortion = 0.1"}, [LEFT + "distortion: found 0.1"]),
    (
        {
            "left": LINES["left"].replace("pinhole", "fisheye"),
            "left_more": "distortion = [0, 0, 0, 0, 0]",
        },
        [LEFT + "distortion: found 5 coefficients; allowed: 4 numbers for model fisheye"],
    ),
    ({"left_more": "resolution = [640]"}, [LEFT + "resolution: found [640]"]),
    ({"left_more": "resolution = [640, 0]"}, [LEFT + "resolution: found [640, 0]"]),
    ({"left_more": f"resolution = [640, {10**400}]"}, [LEFT + "resolution: found", "more digits"]),
    ({"left_more": "resolution = [640.0, 480]"}, [LEFT + "resolution: found [640.0, 480]"]),
    ({"left_more": "resolution = [true, 480]"}, [LEFT + "resolution: found [true, 480]"]),
    ({"left_more": 'calibration = "c.yml"'}, [LEFT + "camera_matrix: stands beside calibration"]),
    ({"matrix": 'calibration = "none.yml"'}, [LEFT + "calibration: no such file", "none.yml"]),
    ({"matrix": "calibration = 3"}, [LEFT + "calibration: found 3"]),
    ({"matrix": "calibration = { node = 1 }"}, [LEFT + "calibration.node: unknown key"]),
    # parallel
    ({"beam_keys": "principal_point = [100, 50]"}, ['sensor["beam"].pixel_size: missing']),
    ({"beam_keys": "pixel_size = 1"}, ['sensor["beam"].principal_point: missing', "[u, v]"]),
    (
        {"beam_keys": "pixel_size = 0\nprincipal_point = [100, 50]"},
        ['sensor["beam"].pixel_size: found 0'],
    ),
    (
        {"beam_keys": "pixel_size = 1\nprincipal_point = [100]"},
        ['sensor["beam"].principal_point: found [100]'],
    ),
    # lateration
    ({"sonar_keys": ""}, ['sensor["sonar"].position: missing']),
    ({"sonar_keys": "position = [1, 2]"}, ['sensor["sonar"].position: found [1, 2]']),
    (
        {"sonar_keys": "position = [1, 2, 3]\nrange_bias = nan"},
        ['sensor["sonar"].range_bias: found nan'],
    ),
    ({"sonar_keys": "position = [1, 2, 3]\nbin_size = 1"}, ['sensor["sonar"].range_min: missing']),
    ({"sonar_keys": "position = [1, 2, 3]\nrange_min = 1"}, ['sensor["sonar"].bin_size: missing']),
    (
        {"sonar_keys": "position = [1, 2, 3]\nrange_min = 1\nbin_size = 0"},
        ['sensor["sonar"].bin_size: found 0'],
    ),
    (
        {"sonar_keys": "position = [1, 2, 3]\nresolution = [1, 1]"},
        ['sensor["sonar"].resolution: unknown key', "model pinhole or fisheye"],
    ),
]


@pytest.mark.parametrize(("changed", "words"), WRONG, ids=lambda case: str(case)[:70])
def test_a_wrong_line_is_named(tmp_path: Path, changed: dict[str, str], words: list[str]) -> None:
    message = message_of(tmp_path, with_lines(**changed))
    for word in words:
        assert word in message


def test_no_sensor_at_all(tmp_path: Path) -> None:
    text = "\n".join(list(LINES.values())[:8])
    assert message_of(tmp_path, text).startswith("sensor: missing")
    assert message_of(tmp_path, "sensor = []\n" + text).startswith("sensor: found []")


def test_a_sensor_in_single_brackets(tmp_path: Path) -> None:
    message = message_of(tmp_path, with_lines(left="[sensor]", beam="", sonar=""))
    assert message.startswith("sensor: found {")
    assert "[[sensor]], in double brackets" in message
