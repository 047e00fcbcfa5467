"""Calibration files of OpenCV, Kalibr and ROS, told apart by content."""

from __future__ import annotations

import pickle
from pathlib import Path

import cv2
import numpy as np
import pytest
from rounding import rounding

from mixpose.errors import SessionError
from mixpose.records import Floats
from mixpose.sensors import FisheyeCamera, PinholeCamera
from mixpose.session import SensorSetup, load_session
from mixpose.session.geometry import size_of

K = np.array([[810.5, 0, 640.25], [0, 805.0, 512.5], [0, 0, 1]])
D5 = np.array([-0.1, 0.02, 1e-05, -2e-4, 0.3])
D4 = np.array([0.01, -0.002, 0.0003, -1e-5])

ROS = """
image_width: 1280
image_height: 1024
camera_name: front
camera_matrix:
  rows: 3
  cols: 3
  data: [810.5, 0, 640.25, 0, 805.0, 512.5, 0, 0, 1]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [-0.1, 0.02, 1e-05, -2e-4, 0.3]
projection_matrix:
  rows: 3
  cols: 4
  data: [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0]
"""
ROS_MESSAGE = """
header: {seq: 1, stamp: {secs: 0, nsecs: 0}, frame_id: front}
height: 1024
width: 1280
distortion_model: "plumb_bob"
D: [-0.1, 0.02, 1e-05, -2e-4, 0.3]
K: [810.5, 0.0, 640.25, 0.0, 805.0, 512.5, 0.0, 0.0, 1.0]
binning_x: 0
binning_y: 0
roi: {x_offset: 0, y_offset: 0, height: 0, width: 0, do_rectify: false}
---
"""
KALIBR = """
cam0:
  cam_overlaps: [1]
  camera_model: pinhole
  distortion_coeffs: [-0.1, 0.02, 1e-05, -2e-4]
  distortion_model: radtan
  intrinsics: [810.5, 805.0, 640.25, 512.5]
  resolution: [1280, 1024]
  rostopic: /cam0/image_raw
cam1:
  T_cn_cnm1:
  - [1.0, 0.0, 0.0, 0.1]
  - [0.0, 1.0, 0.0, 0.0]
  - [0.0, 0.0, 1.0, 0.0]
  - [0.0, 0.0, 0.0, 1.0]
  camera_model: pinhole
  distortion_coeffs: [0.01, -0.002, 0.0003, -1e-5]
  distortion_model: equidistant
  intrinsics: [810.5, 805.0, 640.25, 512.5]
  resolution: [1280, 1024]
"""


def load(folder: Path, keys: str, model: str = "pinhole") -> SensorSetup:
    path = folder / "session.toml"
    path.write_text(
        f"""unit = "m"
        [object]
        name = "o"
        points = [[0, 0, 0], [1, 0, 0], [0, 1, 0]]
        [[sensor]]
        name = "cam"
        model = "{model}"
        {keys}
        """,
        encoding="utf-8",
    )
    return load_session(path).sensors[0]


def message_of(folder: Path, keys: str, model: str = "pinhole") -> str:
    with pytest.raises(SessionError) as caught:
        load(folder, keys, model)
    message = str(caught.value)
    assert len(message.splitlines()) == 1
    return message.removeprefix(f"{folder / 'session.toml'}: ")


def file_storage(path: Path, **nodes: int | Floats) -> None:
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for name, value in nodes.items():
        storage.write(name, value)
    storage.release()


@pytest.mark.parametrize("suffix", ["yml", "xml", "json"])
@pytest.mark.parametrize(
    ("matrix", "distortion"),
    [
        ("camera_matrix", "distortion_coefficients"),
        ("Camera_Matrix", "Distortion_Coefficients"),
        ("K", "D"),
        ("M", "dist_coeffs"),
        ("cameraMatrix", "distCoeffs"),
        ("mtx", "dist"),
    ],
)
def test_opencv_files_of_every_dialect_and_usual_name(
    tmp_path: Path, suffix: str, matrix: str, distortion: str
) -> None:
    nodes: dict[str, int | Floats] = {matrix: K, distortion: D5}
    nodes |= {"image_width": 1280, "image_height": 1024}
    file_storage(tmp_path / f"c.{suffix}", **nodes)
    # the ending is no help: formats are told by content
    (tmp_path / f"c.{suffix}").rename(tmp_path / "camera.calib")
    setup = load(tmp_path, 'calibration = "camera.calib"')
    assert isinstance(setup.sensor, PinholeCamera)
    np.testing.assert_array_equal(setup.sensor.camera_matrix, K)
    np.testing.assert_array_equal(setup.sensor.distortion, D5)
    assert setup.resolution == (1280, 1024)


def test_a_named_node_goes_before_one_of_a_usual_name(tmp_path: Path) -> None:
    right = K + np.diag([10.0, 10.0, 0.0])
    nodes = {"K": K, "D": np.zeros((1, 5)), "K2": right, "D2": np.full((1, 5), 0.25)}
    file_storage(tmp_path / "stereo.yml", **nodes)
    keys = 'calibration = { file = "stereo.yml", camera_matrix = "K2", distortion = "D2" }'
    camera = load(tmp_path, keys).sensor
    assert isinstance(camera, PinholeCamera)
    np.testing.assert_array_equal(camera.camera_matrix, right)
    np.testing.assert_array_equal(camera.distortion, [0.25] * 5)


def test_named_nodes_of_a_stereo_file(tmp_path: Path) -> None:
    right = K + np.diag([10.0, 10.0, 0.0])
    nodes = {"M1": K, "D1": np.zeros((1, 5)), "M2": right, "D2": np.zeros((14, 1)), "R": np.eye(3)}
    file_storage(tmp_path / "stereo.yml", **nodes)
    keys = 'calibration = { file = "stereo.yml", camera_matrix = "M2", distortion = "D2" }'
    setup = load(tmp_path, keys)
    assert isinstance(setup.sensor, PinholeCamera)
    np.testing.assert_array_equal(setup.sensor.camera_matrix, right)
    assert setup.sensor.distortion.size == 14
    assert setup.resolution is None


def test_an_opencv_file_written_as_plain_sequences(tmp_path: Path) -> None:
    text = (
        "%YAML:1.0\n---\n"
        f"K: {K.tolist()[0] + K.tolist()[1] + K.tolist()[2]}\nD: {D4.tolist()}\n"
        "image_width: 0\nimage_height: 0\n"
    )
    (tmp_path / "c.yml").write_text(text, encoding="utf-8")
    setup = load(tmp_path, 'calibration = "c.yml"', "fisheye")
    assert isinstance(setup.sensor, FisheyeCamera)
    np.testing.assert_array_equal(setup.sensor.camera_matrix, K)
    np.testing.assert_array_equal(setup.sensor.distortion, D4)
    assert setup.resolution is None


@pytest.mark.parametrize(
    "text", [ROS, ROS_MESSAGE, ROS_MESSAGE.replace("D:", "d:").replace("K:", "k:")]
)
def test_ros_files_and_messages(tmp_path: Path, text: str) -> None:
    (tmp_path / "c.yaml").write_text(text, encoding="utf-8")
    setup = load(tmp_path, 'calibration = "c.yaml"')
    assert isinstance(setup.sensor, PinholeCamera)
    np.testing.assert_array_equal(setup.sensor.camera_matrix, K)
    np.testing.assert_array_equal(setup.sensor.distortion, D5)
    assert setup.resolution == (1280, 1024)


def test_a_ros_camera_without_distortion(tmp_path: Path) -> None:
    text = ROS_MESSAGE.replace('"plumb_bob"', '""').replace(
        "D: [-0.1, 0.02, 1e-05, -2e-4, 0.3]", "D: []"
    )
    (tmp_path / "c.yaml").write_text(text, encoding="utf-8")
    sensor = load(tmp_path, 'calibration = "c.yaml"').sensor
    assert isinstance(sensor, PinholeCamera)
    assert sensor.distortion.size == 0


def test_each_camera_of_a_kalibr_chain(tmp_path: Path) -> None:
    (tmp_path / "chain.yaml").write_text(KALIBR, encoding="utf-8")
    left = load(tmp_path, 'calibration = { file = "chain.yaml", camera = "cam0" }')
    right = load(tmp_path, 'calibration = { file = "chain.yaml", camera = "cam1" }', "fisheye")
    assert isinstance(left.sensor, PinholeCamera)
    assert isinstance(right.sensor, FisheyeCamera)
    np.testing.assert_array_equal(left.sensor.camera_matrix, K)
    np.testing.assert_array_equal(left.sensor.distortion, D5[:4])
    np.testing.assert_array_equal(right.sensor.distortion, D4)
    assert left.resolution == right.resolution == (1280, 1024)


@pytest.mark.parametrize(("unit", "baseline"), [("m", 0.1), ("mm", 100.0)])
def test_a_kalibr_chain_says_in_metres_where_its_cameras_stand(
    unit: str, baseline: float, tmp_path: Path
) -> None:
    (tmp_path / "chain.yaml").write_text(KALIBR, encoding="utf-8")
    load(tmp_path, 'calibration = { file = "chain.yaml", camera = "cam1" }', "fisheye")
    path = tmp_path / "session.toml"
    text = path.read_text(encoding="utf-8").replace('unit = "m"', f'unit = "{unit}"')
    path.write_text(text, encoding="utf-8")
    (setup,) = load_session(path).sensors
    assert isinstance(setup.sensor, FisheyeCamera)
    expected = np.eye(4)
    expected[0, 3] = baseline
    np.testing.assert_allclose(
        setup.sensor.T_sensor_world, expected, rtol=1e-12, atol=rounding(expected)
    )


def test_the_only_camera_of_a_kalibr_chain_needs_no_name(tmp_path: Path) -> None:
    (tmp_path / "chain.yaml").write_text(KALIBR[: KALIBR.index("cam1")], encoding="utf-8")
    assert load(tmp_path, 'calibration = "chain.yaml"').resolution == (1280, 1024)


WRONG_TEXTS = [
    # what the file is
    ("", "pinhole", ["no keys", "FileStorage", "camchain", "camera_info"]),
    ("just: words\n", "pinhole", ["found just", "camera_info"]),
    ("a: [1, 2\nb: 3", "pinhole", ["not YAML at line"]),
    ("- 1\n- 2\n", "pinhole", ["no keys"]),
    ("0: {intrinsics: [1, 1, 0, 0]}\n", "pinhole", ["found 0; allowed"]),
    ("%YAML:1.0\n---\nM1: [1, 2", "pinhole", ["FileStorage"]),
    ("%YAML:1.0\n---\n- 1\n", "pinhole", ["no named nodes"]),
    ("<?xml version='1.0'?>\n<nothing/>", "pinhole", ["OpenCV"]),
    # OpenCV
    ("%YAML:1.0\n---\nM1: 3\nD1: 4\n", "pinhole", ["none of the nodes camera_matrix", "M1, D1"]),
    (
        f"%YAML:1.0\n---\nK: {K.tolist()[0] * 3}\n",
        "pinhole",
        ["distortion_coefficients", "file: K"],
    ),
    (f"%YAML:1.0\n---\nK: {K.tolist()[0]}\nD: [ ]\n", "pinhole", ["K[0]: found 810.5"]),
    ("%YAML:1.0\n---\nK: [1,0,.Nan,0,1,0,0,0,1]\nD: [0,0,0,0]\n", "pinhole", ["K[2]: found nan"]),
    ("%YAML:1.0\n---\nK: [1,0,0,0,1,0,0,0,1]\nD: [0,0,0]\n", "pinhole", ["D: found 3 coeff"]),
    ("%YAML:1.0\n---\nK: [1,0,0,0,1,0,0,0,1]\nD: [0,0,0,0,0]\n", "fisheye", ["D: found 5 coeff"]),
    ("%YAML:1.0\n---\nK: words\nD: [0,0,0,0]\n", "pinhole", ['K: found "words"']),
    (
        "%YAML:1.0\n---\nK: !!opencv-matrix\n  rows: 3\n  cols: 3\n  dt: d\n  data: [1]\nD: 0",
        "pinhole",
        ["K: found a matrix whose data is not rows x cols"],
    ),
    (
        "%YAML:1.0\n---\nfisheye_model: 1\nK: [1,0,0,0,1,0,0,0,1]\nD: [0,0,0,0]\n",
        "pinhole",
        ['found a fisheye camera; change the sensor\'s model from "pinhole" to "fisheye"'],
    ),
    (
        "%YAML:1.0\n---\nK: !!opencv-matrix\n  rows: 3\n  clos: 3\n  dt: d\n"
        "  data: [1, 0, 0, 0, 1, 0, 0, 0, 1]\nD: [0,0,0,0]\n",
        "pinhole",
        ["K: found a matrix whose data is not rows x cols"],
    ),
    # Kalibr
    (KALIBR, "pinhole", ["cameras cam0, cam1", 'camera = "cam0"']),
    (KALIBR[: KALIBR.index("cam1")], "fisheye", ["found a pinhole camera", 'to "pinhole"']),
    (
        KALIBR[: KALIBR.index("cam1")].replace("radtan", "fov"),
        "pinhole",
        ["cam0.distortion_model", '"fov"'],
    ),
    (
        KALIBR[: KALIBR.index("cam1")].replace("model: pinhole", "model: omni"),
        "pinhole",
        ['cam0.camera_model: found "omni"'],
    ),
    (
        KALIBR[: KALIBR.index("cam1")].replace("distortion_coeffs", "coeffs"),
        "pinhole",
        ["cam0.distortion_coeffs: missing"],
    ),
    (
        KALIBR[: KALIBR.index("cam1")].replace("[810.5, 805.0,", "["),
        "pinhole",
        ["cam0.intrinsics: found [640.25, 512.5]"],
    ),
    (
        KALIBR[: KALIBR.index("cam1")].replace("1280", "-1"),
        "pinhole",
        ["cam0.resolution: found [-1, 1024]"],
    ),
    # ROS
    (ROS, "fisheye", ["found a pinhole camera", 'from "fisheye" to "pinhole"']),
    (ROS.replace("plumb_bob", "thin_prism"), "pinhole", ['distortion_model: found "thin_prism"']),
    (ROS.replace("distortion_model: plumb_bob", ""), "pinhole", ["without a distortion_model"]),
    (
        ROS.replace("distortion_coefficients", "dist"),
        "pinhole",
        ["distortion_coefficients: missing"],
    ),
    (ROS.replace("1e-05", "x"), "pinhole", ['distortion_coefficients[2]: found "x"']),
    (ROS.replace("810.5", ".nan"), "pinhole", ["camera_matrix[0]: found nan"]),
    (ROS_MESSAGE.replace("binning_x: 0", "binning_x: 2"), "pinhole", ["binning_x: found 2"]),
    (ROS_MESSAGE.replace("x_offset: 0", "x_offset: 8"), "pinhole", ["roi.x_offset: found 8"]),
]


@pytest.mark.parametrize(("text", "model", "words"), WRONG_TEXTS)
def test_a_wrong_calibration_file(tmp_path: Path, text: str, model: str, words: list[str]) -> None:
    (tmp_path / "c.yml").write_text(text, encoding="utf-8")
    message = message_of(tmp_path, 'calibration = "c.yml"', model)
    assert message.startswith('sensor["cam"].calibration: c.yml: ')
    for word in words:
        assert word in message


@pytest.mark.parametrize(
    ("text", "keys", "word"),
    [
        (ROS, 'camera = "cam0"', '"cam0" is for a file of several cameras, this is a ROS file'),
        (ROS, 'camera_matrix = "K"', "is for an OpenCV file, this is a ROS file"),
        (KALIBR, 'distortion = "D"', "is for an OpenCV file, this is a Kalibr file"),
        (KALIBR, 'camera = "cam7"', 'no camera "cam7"; cameras in the file: cam0, cam1'),
        ("%YAML:1.0\n---\nK: 1\n", 'camera = "cam0"', "this is an OpenCV file"),
        (
            "%YAML:1.0\n---\nM1: 1\n",
            'camera_matrix = "M2"',
            'found no node "M2" for camera_matrix; nodes in the file: M1',
        ),
    ],
)
def test_keys_that_do_not_fit_the_file(tmp_path: Path, text: str, keys: str, word: str) -> None:
    (tmp_path / "c.yml").write_text(text, encoding="utf-8")
    assert word in message_of(tmp_path, f'calibration = {{ file = "c.yml", {keys} }}')


def test_a_resolution_that_contradicts_the_calibration(tmp_path: Path) -> None:
    (tmp_path / "c.yaml").write_text(ROS, encoding="utf-8")
    agreeing = load(tmp_path, 'calibration = "c.yaml"\nresolution = [1280, 1024]')
    assert agreeing.resolution == (1280, 1024)
    message = message_of(tmp_path, 'calibration = "c.yaml"\nresolution = [640, 512]')
    assert message.startswith('sensor["cam"].resolution: found [640, 512]')
    assert "[1280, 1024]" in message


def test_a_calibration_that_is_not_text(tmp_path: Path) -> None:
    (tmp_path / "c.yml").write_bytes(b"\xff\xfe\x00\x01")
    assert "c.yml: not UTF-8" in message_of(tmp_path, 'calibration = "c.yml"')
    (tmp_path / "folder").mkdir()
    assert "cannot read" in message_of(tmp_path, 'calibration = "folder"')


def test_arrays_saved_by_numpy_are_told_where_to_go(tmp_path: Path) -> None:
    np.savez(tmp_path / "c.npz", mtx=np.eye(3), dist=np.zeros((1, 5)))
    message = message_of(tmp_path, 'calibration = "c.npz"')
    assert "c.npz: a NumPy or pickle file; write camera matrix and distortion with" in message
    (tmp_path / "c.p").write_bytes(pickle.dumps({"mtx": [[1.0]]}))
    assert "c.p: a NumPy or pickle file" in message_of(tmp_path, 'calibration = "c.p"')


def test_sizes_that_are_missing_or_zero_are_not_known() -> None:
    assert [size_of(size) for size in (None, [0, 0], [640, 480])] == [None, None, (640, 480)]
