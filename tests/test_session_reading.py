"""Sessions that are right: every key and every form of the session file."""

from __future__ import annotations

import hashlib
import os
from pathlib import Path

import numpy as np
import pytest
from rounding import rounding
from scipy.spatial.transform import Rotation

import mixpose.session as session_room
from mixpose.body import PointFeature, SegmentFeature
from mixpose.errors import SessionError
from mixpose.extraction.options import ExtractOptions
from mixpose.fit import EstimatorOptions
from mixpose.rigid import TWIST_NAMES
from mixpose.sensors import FisheyeCamera, ParallelBeam, PinholeCamera, RangeSensor
from mixpose.session import Session, load_session

OBJECT = """
unit = "mm"
[object]
name = "tracker"
points = [[0, 0, 0], [10, 0, 0], [0, 20, 0], [0, 0, 30]]
"""
CAMERA = """
[[sensor]]
name = "left"
model = "pinhole"
source = "left*.png"
camera_matrix = [[800, 0, 640], [0, 800, 512], [0, 0, 1]]
"""
RECORDINGS = os.environ.get("MIXPOSE_RECORDINGS")


def read(folder: Path, text: str) -> Session:
    path = folder / "session.toml"
    path.write_text(text, encoding="utf-8")
    return load_session(path)


def read_object(folder: Path, lines: str) -> Session:
    return read(folder, f'unit = "mm"\n[object]\nname = "o"\n{lines}\n{CAMERA}')


def test_a_quaternion_of_three_decimals_is_scaled_and_one_further_off_is_told(
    tmp_path: Path,
) -> None:
    # 0.5e-3 in each of four numbers misses the length by 1e-3 at most, here by 1.9e-3 and 2.1e-3
    start = "[start]\nquaternion_xyzw = [0, 0, 0, {}]\ntranslation = [0, 0, 0]\n"
    for w in ("1.0019", "0.9981"):
        session = read(tmp_path, OBJECT + start.format(w) + CAMERA)
        assert session.start is not None
        np.testing.assert_array_equal(session.start.T_world_object, np.eye(4))
    for w in ("1.0021", "0.9979"):
        with pytest.raises(SessionError, match=f"found a quaternion of length {w}"):
            read(tmp_path, OBJECT + start.format(w) + CAMERA)


def test_the_smallest_session_has_the_defaults(tmp_path: Path) -> None:
    session = read(tmp_path, OBJECT + CAMERA)
    assert session.path == tmp_path / "session.toml"
    assert session.folder == tmp_path
    assert session.sha256 == hashlib.sha256(session.path.read_bytes()).hexdigest()
    assert (session.unit, session.metres_per_unit) == ("mm", 1e-3)
    assert session.start is None
    assert session.estimator == EstimatorOptions("matched", TWIST_NAMES, 1000, 0)
    assert session.body.name == "tracker"
    assert session.body.is_exact
    assert session.body.normals is None
    (left,) = session.sensors
    assert isinstance(left.sensor, PinholeCamera)
    np.testing.assert_array_equal(left.sensor.T_sensor_world, np.eye(4))
    assert left.sensor.distortion.size == 0
    assert left.extract == ExtractOptions()
    assert (left.source, left.times, left.fps, left.resolution) == ("left*.png", None, None, None)


def test_every_table_and_key_is_read(tmp_path: Path) -> None:
    session = read(
        tmp_path,
        """
        unit = "um"
        [object]
        name = "t"
        points = [[0, 0, 0], [10, 0, 0]]
        segments = [[[0, 0, 0], [0, 0, 5]]]
        sigma = [1, 2, 3]
        normals = [[0, 0, 2], [0, 3, 0], [1, 0, 0]]
        [start]
        euler_xyz_deg = [10, 20, 30]
        translation = [1, 2, 3]
        rotation_deg = 5
        distance = 7.5
        [estimator]
        objective = "paper"
        free = ["rz", "x"]
        samples = 50
        seed = 9
        confidence = 0.99
        [extract]
        method = "mine.tools:find"
        polarity = "dark"
        threshold = 128
        min_area = 2
        max_area = 100.5
        sigma = 2
        [[sensor]]
        name = "fish"
        model = "fisheye"
        source = ["b.png", "a.png"]
        camera_matrix = [[300, 0, 320], [0, 310, 240], [0, 0, 1]]
        distortion = [0.1, 0, 0, 0]
        resolution = [640, 480]
        quaternion_xyzw = [0, 0, 0.7071, 0.7071]
        translation = [0, 0, 100]
        fps = 25
        [sensor.extract]
        threshold = "local"
        max_area = 50
        [[sensor]]
        name = "beam"
        model = "parallel"
        source = "frames/"
        pixel_size = 0.5
        principal_point = [100, 50]
        resolution = [200, 100]
        rotation_vector = [0, 0, 1.5707963267948966]
        translation = [1, 2, 3]
        times = "times.csv"
        [[sensor]]
        name = "sonar"
        model = "lateration"
        source = "profiles.npy"
        position = [1, 2, 3]
        range_bias = 0.25
        range_min = 10
        bin_size = 0.5
        """,
    )
    assert session.metres_per_unit == 1e-6
    assert session.estimator == EstimatorOptions("paper", ("x", "rz"), 50, 9, confidence=0.99)
    assert session.start is not None
    assert (session.start.rotation_deg, session.start.distance) == (5.0, 7.5)
    fish, beam, sonar = session.sensors
    assert fish.extract == ExtractOptions("mine.tools:find", "dark", "local", 2, 50, 2)
    assert beam.extract == ExtractOptions("mine.tools:find", "dark", 128.0, 2, 100.5, 2)
    assert fish.source == ("b.png", "a.png")
    assert fish.fps == 25
    assert beam.times == tmp_path / "times.csv"
    assert isinstance(fish.sensor, FisheyeCamera)
    assert fish.resolution == fish.sensor.resolution == (640, 480)
    np.testing.assert_array_equal(fish.sensor.distortion, [0.1, 0, 0, 0])
    quarter_turn = [[0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 100], [0, 0, 0, 1]]
    # a quaternion of four decimals, scaled to length 1, is a quarter turn exactly
    np.testing.assert_allclose(fish.sensor.T_sensor_world, quarter_turn, atol=rounding(1))
    assert isinstance(beam.sensor, ParallelBeam)
    assert beam.sensor.pixel_size == 0.5
    np.testing.assert_array_equal(beam.sensor.principal_point, [100, 50])
    np.testing.assert_allclose(
        beam.sensor.T_sensor_world[:2, :2], [[0, -1], [1, 0]], atol=rounding(1)
    )
    assert isinstance(sonar.sensor, RangeSensor)
    assert sonar.sensor.range_bias == 0.25
    assert sonar.sensor.range_limits is None
    assert (sonar.range_min, sonar.bin_size, sonar.resolution) == (10, 0.5, None)


def test_euler_angles_turn_about_x_first_then_y_then_z(tmp_path: Path) -> None:
    text = OBJECT + "[start]\neuler_xyz_deg = [10, 20, 30]\ntranslation = [1, 2, 3]\n" + CAMERA
    start = read(tmp_path, text).start
    a, b, c = np.radians([10, 20, 30])
    R1 = [[1, 0, 0], [0, np.cos(a), -np.sin(a)], [0, np.sin(a), np.cos(a)]]
    R2 = [[np.cos(b), 0, np.sin(b)], [0, 1, 0], [-np.sin(b), 0, np.cos(b)]]
    R3 = [[np.cos(c), -np.sin(c), 0], [np.sin(c), np.cos(c), 0], [0, 0, 1]]
    assert start is not None
    np.testing.assert_allclose(
        start.T_world_object[:3, :3], np.array(R3) @ R2 @ R1, atol=rounding(1)
    )
    np.testing.assert_array_equal(start.T_world_object[:3, 3], [1, 2, 3])


def test_a_matrix_of_four_decimals_becomes_exactly_rigid(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    for _ in range(50):
        T = np.eye(4)
        T[:3, :3] = Rotation.random(rng=rng).as_matrix()
        rows = np.round(T, 4).tolist()
        start = read(tmp_path, f"{OBJECT}[start]\nT_world_object = {rows}\n{CAMERA}").start
        assert start is not None
        R = start.T_world_object[:3, :3]
        np.testing.assert_allclose(R @ R.T, np.eye(3), atol=rounding(1))
        # no entry moves by more than the rounding of all nine together
        np.testing.assert_allclose(R, T[:3, :3], atol=1.5e-4)


@pytest.mark.parametrize(
    ("sigma", "expected"),
    [
        ("0", [np.zeros((3, 3))] * 4),
        ("5.0", [25 * np.eye(3)] * 4),
        ("[1, 2, 3]", [np.diag([1, 4, 9])] * 4),
        ("[[4, 1, 0], [1, 4, 0], [0, 0, 0]]", [[[4, 1, 0], [1, 4, 0], [0, 0, 0]]] * 4),
        ("[1, 2, 3, 0]", [np.eye(3), 4 * np.eye(3), 9 * np.eye(3), np.zeros((3, 3))]),
        (
            "[1, [1, 2, 3], [[2, 1, 0], [1, 2, 0], [0, 0, 1]], 0]",
            [
                np.eye(3),
                np.diag([1, 4, 9]),
                [[2, 1, 0], [1, 2, 0], [0, 0, 1]],
                np.zeros((3, 3)),
            ],
        ),
    ],
)
def test_every_form_of_sigma(tmp_path: Path, sigma: str, expected: list[object]) -> None:
    points = "points = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]\n"
    body = read_object(tmp_path, f"{points}sigma = {sigma}").body
    np.testing.assert_array_equal(body.covariances, np.array(expected, dtype=float))


def test_three_numbers_for_three_points_are_one_spread_for_all(tmp_path: Path) -> None:
    lines = "points = [[0, 0, 0], [1, 0, 0], [0, 1, 0]]\nsigma = [1, 2, 3]"
    body = read_object(tmp_path, lines).body
    np.testing.assert_array_equal(body.covariances, [np.diag([1, 4, 9])] * 3)


def test_three_points_may_have_a_covariance_each(tmp_path: Path) -> None:
    lines = "points = [[0, 0, 0], [1, 0, 0], [0, 1, 0]]\n"
    lines += "sigma = [[[4, 0, 0], [0, 4, 0], [0, 0, 4]], 1, 0]"
    body = read_object(tmp_path, lines).body
    np.testing.assert_array_equal(body.covariances, [4 * np.eye(3), np.eye(3), np.zeros((3, 3))])


def test_segments_alone_make_an_object(tmp_path: Path) -> None:
    lines = """segments = [[[0, 0, 0], [1, 0, 0]], [[0, 0, 0], [0, 1, 0]], [[0, 0, 0], [0, 0, 2]]]
    sigma = 0.5"""
    features = read_object(tmp_path, lines).body.features
    assert all(isinstance(feature, SegmentFeature) for feature in features)
    np.testing.assert_array_equal(features[2].mean, [0, 0, 1])
    np.testing.assert_array_equal(features[0].covariance, 0.25 * np.eye(3))


def test_markers_with_a_size_have_a_radius_each_and_segments_none(tmp_path: Path) -> None:
    text = """
    points = [[0, 0, 0], [9, 0, 0], [0, 9, 0]]
    segments = [[[0, 0, 0], [5, 0, 0]]]
    shape = "sphere"
    radius = RADIUS"""
    for radius, expected in (("7", [7, 7, 7, 0]), ("[1, 2, 3.5]", [1, 2, 3.5, 0])):
        body = read_object(tmp_path, text.replace("RADIUS", radius)).body
        assert body.shape == "sphere"
        np.testing.assert_array_equal(body.radii, expected)


def test_points_come_before_segments_and_normals_have_length_one(tmp_path: Path) -> None:
    lines = """points = [[5, 0, 0], [6, 0, 0]]
    segments = [[[0, 0, 0], [0, 0, 2]]]
    normals = [[0, 0, 2], [0, 3, 4], [1, 0, 0]]"""
    body = read_object(tmp_path, lines).body
    kinds = [type(feature) for feature in body.features]
    assert kinds == [PointFeature, PointFeature, SegmentFeature]
    np.testing.assert_array_equal(body.normals, [[0, 0, 1], [0, 0.6, 0.8], [1, 0, 0]])


@pytest.mark.parametrize(
    ("header", "cells", "expected"),
    [
        ("", "", np.zeros((3, 3))),
        (",sigma", ",0.5", 0.25 * np.eye(3)),
        (", sx, sy, sz", ", 1, 2, 3", np.diag([1, 4, 9])),
        (",xx,xy,xz,yx,yy,yz,zx,zy,zz", ",2,1,0,1,2,0,0,0,1", [[2, 1, 0], [1, 2, 0], [0, 0, 1]]),
    ],
)
def test_a_marker_file_with_each_number_of_sigma_columns(
    tmp_path: Path, header: str, cells: str, expected: object
) -> None:
    rows = [f"{name},{i},2.5,-1e1{cells}" for i, name in enumerate(["a", "b", '"c, d"'])]
    text = "\r\n".join([f"name,x,y,z{header}", *rows, ""])
    # as a spreadsheet on Windows saves it: with a byte order mark
    (tmp_path / "markers.csv").write_text(text, encoding="utf-8-sig", newline="")
    body = read_object(tmp_path, 'file = "markers.csv"').body
    np.testing.assert_array_equal(body.means, [[0, 2.5, -10], [1, 2.5, -10], [2, 2.5, -10]])
    np.testing.assert_array_equal(body.covariances, [expected] * 3)


def test_sigma_of_the_session_goes_with_a_plain_marker_file(tmp_path: Path) -> None:
    (tmp_path / "m.csv").write_text("Name,X,Y,Z\na,0,0,0\nb,1,0,0\n\nc,0,1,0\n", encoding="utf-8")
    body = read_object(tmp_path, 'file = "m.csv"\nsigma = 2').body
    np.testing.assert_array_equal(body.covariances, [4 * np.eye(3)] * 3)


@pytest.mark.parametrize("count", [0, 4, 5, 8, 12, 14])
def test_a_pinhole_camera_takes_every_count_of_opencv(tmp_path: Path, count: int) -> None:
    sensor = read(tmp_path, f"{OBJECT}{CAMERA}distortion = {[0.01] * count}").sensors[0].sensor
    assert isinstance(sensor, PinholeCamera)
    assert sensor.distortion.size == count


def test_a_planned_system_has_no_source(tmp_path: Path) -> None:
    text = OBJECT + CAMERA.replace('source = "left*.png"', "")
    assert read(tmp_path, text).sensors[0].source == ()


def test_a_byte_order_mark_does_no_harm(tmp_path: Path) -> None:
    path = tmp_path / "s.toml"
    path.write_text(OBJECT + CAMERA, encoding="utf-8-sig")
    assert load_session(str(path)).unit == "mm"


def test_reading_twice_gives_the_same(tmp_path: Path) -> None:
    first, second = (read(tmp_path, OBJECT + CAMERA) for _ in range(2))
    assert first.sha256 == second.sha256
    np.testing.assert_array_equal(first.body.means, second.body.means)


def test_all_is_exported() -> None:
    assert all(hasattr(session_room, name) for name in session_room.__all__)


@pytest.mark.skipif(not RECORDINGS, reason="MIXPOSE_RECORDINGS names no folder of recordings")
def test_the_sessions_of_real_recordings_are_read() -> None:
    paths = sorted(Path(str(RECORDINGS)).glob("*/*.toml"))
    assert paths
    features = {
        path.relative_to(str(RECORDINGS)).as_posix(): len(load_session(path).body) for path in paths
    }
    known = {
        "disk_effector/bed.toml": 6,
        "led_tee/session.toml": 4,
        "stereo_chessboard/session.toml": 54,
        "uwb_trolley/session.toml": 3,
    }
    assert known.items() <= features.items()


@pytest.mark.parametrize(("unit", "metres"), [("m", 1.0), ("cm", 0.01), ("mm", 1e-3), ("um", 1e-6)])
def test_every_unit_has_its_length_in_metres(tmp_path: Path, unit: str, metres: float) -> None:
    session = read(tmp_path, (OBJECT + CAMERA).replace('"mm"', f'"{unit}"'))
    assert session.metres_per_unit == metres


def test_each_of_points_and_segments_has_the_spread_of_its_place_in_the_list(
    tmp_path: Path,
) -> None:
    lines = """points = [[5, 0, 0], [6, 0, 0]]
    segments = [[[0, 0, 0], [0, 0, 2]], [[0, 1, 0], [0, 1, 2]]]
    sigma = [1, 2, 3, 4]"""
    body = read_object(tmp_path, lines).body
    assert [covariance[0, 0] for covariance in body.covariances] == [1.0, 4.0, 9.0, 16.0]


def test_a_range_sensor_has_no_bias_and_no_profile_unless_told(tmp_path: Path) -> None:
    sensor = '[[sensor]]\nname = "r"\nmodel = "lateration"\nposition = [0, 0, 9]\n'
    (setup,) = read(tmp_path, OBJECT + sensor).sensors
    assert isinstance(setup.sensor, RangeSensor)
    assert setup.sensor.range_bias == 0.0
    assert (setup.range_min, setup.bin_size) == (None, None)
    # a point 9 away measures 9
    assert setup.sensor.project(np.zeros((1, 3)))[0].tolist() == [[9.0]]
