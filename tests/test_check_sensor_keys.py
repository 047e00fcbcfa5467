"""Which keys of sensors `mixpose check` doubts, and which directions it calls unknown."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from inspected import copied, left_image, write_left

from mixpose import runner
from mixpose.body import Body, SegmentFeature
from mixpose.checking import key_warnings
from mixpose.checking.keys import _trials, advice
from mixpose.cli.app import CheckRequest
from mixpose.cli.check import check_session
from mixpose.extraction import ExtractOptions
from mixpose.sensors import PinholeCamera
from mixpose.session import Session, load_session

SYNTHETIC = Path(__file__).parents[1] / "data" / "synthetic"
TRILATERATION = """
unit = "m"

[object]
name = "trolley"
points = [[0.2, 0.15, 0], [-0.1, 0.14, 0], [-0.07, -0.14, 0]]

[start]
T_world_object = [[1, 0, 0, 0.2], [0, 1, 0, 0.4], [0, 0, 1, 1.0], [0, 0, 0, 1]]

[extract]
sigma = 0.08
"""


@pytest.fixture
def session() -> Session:
    return load_session(SYNTHETIC / "two_cameras" / "session.toml")


NORMALS = "or give normals in [object], if the body hides some of them"


def test_recorded_calibrations_and_widths_raise_no_doubt(session: Session) -> None:
    assert key_warnings(session) == []
    assert key_warnings(load_session(SYNTHETIC / "range_profiles" / "session.toml")) == []


def test_a_calibration_of_images_twice_as_large_is_doubted(session: Session) -> None:
    left, right = session.sensors
    assert isinstance(left.sensor, PinholeCamera)
    twice = left.sensor.camera_matrix * [[2.0], [2.0], [1.0]]
    sensor = replace(left.sensor, camera_matrix=twice)
    (warning,) = key_warnings(replace(session, sensors=(replace(left, sensor=sensor), right)))
    assert warning.startswith("sensor 'left': the principal point cx = ")
    assert "of 640x512 px: is the calibration of images of another size" in warning


def test_a_width_of_a_twentieth_of_the_image_is_doubted(session: Session) -> None:
    widest = 0.05 * max(session.sensors[0].resolution or (0, 0))
    for sigma, doubted in ((0.99 * widest, False), (1.01 * widest, True)):
        setups = [replace(s, extract=replace(s.extract, sigma=sigma)) for s in session.sensors]
        said = key_warnings(replace(session, sensors=tuple(setups)))
        assert any("wider than a twentieth of the image" in one for one in said) == doubted


def test_ranges_with_the_width_of_pixels_are_doubted() -> None:
    ranges = load_session(SYNTHETIC / "range_profiles" / "session.toml")
    wide = [replace(s, extract=replace(s.extract, sigma=500.0)) for s in ranges.sensors]
    (warning,) = key_warnings(replace(ranges, sensors=tuple(wide)))
    assert warning.startswith("sensor 'front' and 2 more: sigma = 500 mm in [extract] is wider")


def test_directions_that_sensors_in_one_plane_do_not_see_are_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = TRILATERATION
    for k, place in enumerate([(-3, 3), (3, 3), (3, -3), (-3, -3)]):
        text += f"""
[[sensor]]
name = "anchor{k}"
model = "lateration"
position = [{place[0]}, {place[1]}, 1.0]
source = "anchor{k}.csv"
"""
        away = np.hypot(place[0] - 0.2, place[1] - 0.4)
        rows = "".join(f"0,{away + shift:.3f}\n" for shift in (-0.1, 0.0, 0.1))
        (tmp_path / f"anchor{k}.csv").write_text(f"frame,range\n{rows}", encoding="utf-8")
    path = tmp_path / "session.toml"
    path.write_text(text, encoding="utf-8")
    check_session(CheckRequest(path))
    printed = capsys.readouterr().out
    assert "anchor0: lateration, sigma 0.08 m\n" in printed
    assert "at [start], the sensors do not determine z, rx, ry: hold what is known" in printed
    path.write_text(text + '\n[estimator]\nfree = ["x", "y", "rz"]\n', encoding="utf-8")
    check_session(CheckRequest(path))
    assert "do not determine" not in capsys.readouterr().out


def test_a_flood_of_features_of_which_none_is_used_is_too_many_and_not_too_few(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(runner, "MOST_DETECTIONS", 40)
    recording = copied(tmp_path / "recording")
    image = left_image(recording)
    for u in range(20, 620, 10):
        image[10:13, u : u + 3] = 160
    write_left(recording, image)
    check_session(CheckRequest(recording / "session.toml"))
    report = capsys.readouterr().out
    assert "features per frame: 67 / 67 / 67" in report
    assert "sensor 'left': too many features, 67 in frame" in report
    assert "with min_area = 10 in its own [sensor.extract] it would be 7" in report


def with_own(recording: Path, *lines: str) -> Path:
    """The session with extraction keys of the left camera, and of the right."""
    session = recording / "session.toml"
    text = session.read_text(encoding="utf-8")
    before, left, right = text.split("[[sensor]]")
    parts = [f"{part}\n[sensor.extract]\n{own}\n\n" for part, own in zip((left, right), lines)]
    session.write_text("[[sensor]]".join([before, *parts]), encoding="utf-8")
    return session


def test_a_key_is_said_to_stand_where_it_overrides_that_of_all_sensors(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    recording = copied(tmp_path / "recording")
    check_session(CheckRequest(with_own(recording, "min_area = 60", "min_area = 60")))
    report = capsys.readouterr().out
    for side in ("left", "right"):
        assert re.search(
            rf"sensor '{side}': too few features, .* with min_area = \S+ in its own "
            r"\[sensor.extract\] it would be 7",
            report,
        )


def test_keys_that_may_be_changed_are_said_to_stand_where_they_do(session: Session) -> None:
    left = session.sensors[0]
    own = replace(left, overridden=frozenset(["threshold"]))
    dark = np.zeros((8, 8), np.uint8)
    change = "change polarity, threshold, min_area and max_area in [extract]"
    assert advice(session, left, 0, dark, 7) == change
    told = advice(session, own, 0, dark, 7)
    assert told == f"{change}, threshold in its own [sensor.extract]"


@pytest.mark.parametrize("method", ["blobs", "corners", "log"])
def test_widths_of_spots_are_tried_with_the_method_that_has_one(method: str) -> None:
    tried = {key for key, _ in _trials(ExtractOptions(method), np.zeros((8, 8), np.uint8))}
    assert ("spot_sigma" in tried) == (method == "log")


def test_a_key_with_which_a_tenth_of_the_features_is_missed_is_not_advised(
    session: Session, tmp_path: Path
) -> None:
    image = left_image(copied(tmp_path / "recording"))
    left = session.sensors[0]
    blind = replace(left, extract=replace(left.extract, threshold=250.0))
    assert advice(session, blind, 0, image, 7).endswith("it would be 7")
    assert advice(session, blind, 0, image, 8).startswith("change polarity, threshold")
    # some are found, and no value finds more: the body may hide the others
    assert advice(session, left, 0, image, 14).endswith("[extract]; " + NORMALS)
    told = replace(session, body=replace(session.body, normals=np.tile([0.0, 0.0, 1.0], (7, 1))))
    assert advice(told, left, 0, image, 14).endswith("[extract]")


@pytest.mark.parametrize(
    ("right", "where"),
    [
        ('polarity = "dark"', "in [sensor.extract] of 'left' and 'right'"),
        ("min_area = 3", "in [extract] and in [sensor.extract] of 'left'"),
    ],
)
def test_a_polarity_that_sensors_have_of_their_own_is_said_to_stand_there(
    right: str, where: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    recording = copied(tmp_path / "recording")
    path = with_own(recording, 'polarity = "dark"', right)
    text = path.read_text(encoding="utf-8")
    path.write_text(text.replace('method = "blobs"', 'method = "blobs"\npolarity = "dark"', 1))
    check_session(CheckRequest(path))
    assert f'with polarity = "bright" {where}, 1 of 1' in capsys.readouterr().out


def test_a_width_of_ranges_is_said_to_stand_where_it_does() -> None:
    ranges = load_session(SYNTHETIC / "range_profiles" / "session.toml")
    front, *others = ranges.sensors
    wide = replace(front.extract, sigma=500.0)
    front = replace(front, extract=wide, overridden=frozenset(["sigma"]))
    (warning,) = key_warnings(replace(ranges, sensors=(front, *others)))
    assert "sigma = 500 mm in its own [sensor.extract] is wider" in warning


@pytest.mark.parametrize("quick", [False, True])
def test_a_recording_without_a_frame_is_told(
    quick: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    recording = copied(tmp_path / "recording")
    path = recording / "session.toml"
    path.write_text(path.read_text(encoding="utf-8").replace("left*.png", "left.csv"))
    (recording / "left.csv").write_text("frame,u,v\n", encoding="utf-8")
    check_session(CheckRequest(path, quick=quick))
    printed = capsys.readouterr().out
    assert "warning   sensor 'left': its recording has no frame" in printed
    assert "sensor 'right': its recording" not in printed


def test_lines_of_which_points_are_taken_are_doubted(session: Session) -> None:
    ends = 50.0 * np.eye(3)
    body = Body("frame", tuple(SegmentFeature(a, b) for a, b in zip(ends, ends[::-1] + 9.0)))
    lines = replace(session, body=body)
    (warning,) = key_warnings(lines)
    assert warning.startswith("'frame': segments are seen as lines of grey values, and 'left' and ")
    grey = [replace(s, extract=replace(s.extract, method="intensity")) for s in lines.sensors]
    assert key_warnings(replace(lines, sensors=tuple(grey))) == []
