from __future__ import annotations

import csv
import io
import json
import re
import zlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mixpose import rigid
from mixpose.errors import RecordingError, SessionError
from mixpose.poses.header import Header
from mixpose.poses.jsonl import JsonlWriter, ResumePoint, read_poses, resume_point
from mixpose.poses.writers import FORMATS, pose_message
from mixpose.records import Estimate, Hypothesis, SensorReport

HALF_TURN = rigid.from_rotation_vector([0.0, 0.0, np.pi], [0.0, 0.0, 0.0])
HEADER = Header(
    unit="mm",
    session="rig/session.toml",
    session_sha256="ab" * 32,
    mixpose="0.1.0",
    seed=7,
    symmetries={"tracker": np.stack([np.eye(4), HALF_TURN])},
)
T = rigid.from_rotation_vector([0.3, -0.2, 0.1], [1500.0, -0.0, 0.1 + 0.2])
GOOD = Estimate(
    frame=12,
    time_s=0.4,
    object="tracker",
    status="ok",
    T_world_object=T,
    covariance=np.diag([1.0, 2.0, 3.0, 0.1, 0.2, 0.3]),
    score=0.93,
    sensors={"left": SensorReport(True, 0.83, 0.21), "right": SensorReport(False)},
    latency_ms=1.7,
)
LOST = replace(GOOD, frame=13, time_s=0.5, status="lost", T_world_object=None, covariance=None)
AMBIGUOUS = replace(
    GOOD,
    frame=14,
    status="ambiguous",
    hypotheses=(Hypothesis(T, 0.6), Hypothesis(T @ HALF_TURN, 0.4)),
)


def written(name: str, *estimates: Estimate, header: Header = HEADER) -> str:
    stream = io.StringIO()
    writer = FORMATS[name](stream, header)
    for estimate in estimates:
        writer.write(estimate)
    writer.close()
    assert not stream.closed
    return stream.getvalue()


def test_why_a_frame_is_not_ok_stands_in_its_line_and_is_read_again(tmp_path: Path) -> None:
    doubted = replace(AMBIGUOUS, doubt="features that would fix it are hidden or cut")
    lines = [json.loads(line) for line in written("jsonl", GOOD, AMBIGUOUS, doubted).splitlines()]
    assert [line.get("why") for line in lines[1:]] == [None, None, doubted.doubt]
    path = tmp_path / "poses.jsonl"
    path.write_text(written("jsonl", GOOD, doubted), encoding="utf-8")
    assert [one.doubt for one in read_poses(path).poses] == ["", doubted.doubt]


def test_json_lines_have_the_keys_of_the_contract_in_its_order() -> None:
    header, pose = map(json.loads, written("jsonl", GOOD).splitlines())
    assert replace(HEADER, symmetries={"tracker": np.stack([np.eye(4), HALF_TURN])}) == HEADER
    assert list(header) == [
        *("type", "format", "version", "unit", "covariance", "session", "session_sha256"),
        *("mixpose", "seed", "symmetries"),
    ]
    assert header["format"] == "mixpose-poses"
    assert header["version"] == 1
    assert header["covariance"] == "x y z rx ry rz, world axes, unit^2 and rad^2"
    assert list(pose) == [
        *("type", "frame", "time_s", "object", "status", "T_world_object", "quaternion_xyzw"),
        *("covariance", "confidence", "score", "sensors", "hypotheses", "latency_ms"),
    ]
    assert pose["sensors"]["left"] == {"used": True, "explained": 0.83, "rms": 0.21}
    assert pose["sensors"]["right"] == {"used": False, "explained": None, "rms": None}


def test_json_numbers_come_back_bit_for_bit_and_without_negative_zero() -> None:
    text = written("jsonl", GOOD)
    pose = json.loads(text.splitlines()[1])
    assert np.array_equal(np.array(pose["T_world_object"]), T)
    assert not re.search(r"-0\.0[,\]}]", text)


def test_a_lost_frame_has_null_pose_quaternion_and_covariance() -> None:
    # A stray pose in a lost estimate must not leak out either.
    for lost in (LOST, replace(GOOD, status="lost")):
        pose = json.loads(written("jsonl", lost).splitlines()[1])
        assert pose["T_world_object"] is None
        assert pose["quaternion_xyzw"] is None
        assert pose["covariance"] is None


def test_same_estimates_make_the_same_bytes() -> None:
    assert written("jsonl", GOOD, LOST, AMBIGUOUS) == written("jsonl", GOOD, LOST, AMBIGUOUS)


@pytest.mark.parametrize("name", FORMATS)
def test_each_frame_is_flushed_as_soon_as_it_is_written(name: str, tmp_path: Path) -> None:
    path = tmp_path / "poses"
    with path.open("w", encoding="utf-8") as stream:
        writer = FORMATS[name](stream, HEADER)
        for count, frame in enumerate((20, 21, 22), start=1):
            writer.write(replace(GOOD, frame=frame, time_s=float(frame)))
            text = path.read_text()
            if name == "ros":
                assert text.count("---\n") == count
                continue
            assert len(text.splitlines()) == count + 1  # below what the columns are


@pytest.mark.parametrize("name", FORMATS)
@pytest.mark.parametrize(
    "broken",
    [
        replace(GOOD, T_world_object=T * np.nan),
        replace(GOOD, score=float("nan")),
        replace(GOOD, sensors={"left": SensorReport(True, 0.5, float("inf"))}),
        replace(GOOD, hypotheses=(Hypothesis(T, float("nan")),)),
    ],
)
def test_no_writer_lets_a_nan_out(name: str, broken: Estimate) -> None:
    with pytest.raises(ValueError, match=r"frame 12: .* is not finite"):
        written(name, broken)


def test_an_object_name_outside_ascii_needs_no_locale(tmp_path: Path) -> None:
    path = tmp_path / "poses.jsonl"
    with path.open("w", encoding="ascii") as stream:
        JsonlWriter(stream, HEADER).write(replace(GOOD, object="Tür"))
    assert read_poses(path).poses[0].object == "Tür"


def test_csv_has_one_flat_row_per_frame_and_empty_cells_for_a_lost_one() -> None:
    text = written("csv", GOOD, LOST, header=replace(HEADER, sensors=("left", "right")))
    good, lost = csv.DictReader(io.StringIO(text))
    assert float(good["tx"]) == 1500.0
    assert good["unit"] == "mm"
    assert float(good["cov_y_y"]) == 2.0
    assert sum(name.startswith("cov_") for name in good) == 21
    turn = Rotation.from_rotvec([float(good[f"rotvec_{axis}"]) for axis in "xyz"])
    assert np.allclose(turn.as_matrix(), T[:3, :3])
    assert good["left_rms"] == "0.21"
    assert (good["right_used"], good["right_rms"]) == ("false", "")
    assert lost["status"] == "lost"
    assert {lost[name] for name in lost if name[:2] in ("tx", "qw", "ro") or "cov" in name} == {""}


def test_csv_takes_sensor_columns_from_the_first_frame_and_refuses_strangers() -> None:
    rows = written("csv", GOOD).splitlines()
    assert "right_explained" in rows[0].split(",")
    with pytest.raises(ValueError, match="no columns for sensors"):
        written("csv", GOOD, replace(GOOD, sensors={"third": SensorReport(True)}))


def test_csv_of_no_frames_still_has_its_column_names() -> None:
    assert written("csv").startswith("frame,time_s,object,status,unit,tx,")


def test_tum_is_in_metres_and_leaves_lost_frames_out() -> None:
    lines = written("tum", GOOD, LOST, AMBIGUOUS).splitlines()
    assert lines[0] == "# time tx ty tz qx qy qz qw, in s and m, by mixpose"
    assert len(lines) == 3
    values = np.array([float(word) for word in lines[1].split(" ")])
    assert values[:4].tolist() == [0.4, 1.5, 0.0, (0.1 + 0.2) / 1000]
    assert np.allclose(values[4:], rigid.quaternion_xyzw(T))


def test_tum_without_times_counts_frames_and_says_so() -> None:
    lines = written("tum", replace(GOOD, time_s=None)).splitlines()
    assert lines[1].startswith("# time is the frame number")
    assert lines[2].startswith("12.0 1.5 ")


def test_tum_refuses_a_mix_of_frames_with_and_without_times() -> None:
    with pytest.raises(RecordingError, match="frame 12 has no time"):
        written("tum", AMBIGUOUS, replace(GOOD, time_s=None))


def test_bop_rows_are_what_its_toolkit_reads() -> None:
    metres = replace(HEADER, unit="m")
    lines = written("bop", GOOD, LOST, replace(GOOD, latency_ms=0.0), header=metres).splitlines()
    assert lines[0] == "scene_id,im_id,obj_id,score,R,t,time"
    assert len(lines) == 3
    scene, image, object_, score, R, t, time = lines[1].split(",")
    assert (int(scene), int(image), int(object_), float(score)) == (0, 12, 1, 0.93)
    assert np.array_equal(np.array(R.split(), float).reshape(3, 3), T[:3, :3])
    assert np.allclose(np.array(t.split(), float), 1000 * T[:3, 3])
    assert float(time) == 0.0017
    assert lines[2].endswith(",-1.0")


def interrupted(path: Path, tail: str) -> None:
    path.write_text(written("jsonl", GOOD, LOST) + tail)


def test_a_run_goes_on_after_its_last_whole_frame(tmp_path: Path) -> None:
    path = tmp_path / "poses.jsonl"
    interrupted(path, written("jsonl", AMBIGUOUS).splitlines()[1][:50])
    found = resume_point(path, HEADER)
    whole = len(written("jsonl", GOOD, LOST))
    checksum = zlib.crc32(path.read_bytes()[:whole])
    assert found == ResumePoint(frame=13, lines=1, size=whole, checksum=checksum, first=12)
    with path.open("r+") as stream:
        stream.truncate(whole)
        stream.seek(whole)
        JsonlWriter(stream, HEADER, resume=True).write(AMBIGUOUS)
    assert path.read_text() == written("jsonl", GOOD, LOST, AMBIGUOUS)


def test_a_run_starts_afresh_where_no_frame_is_whole(tmp_path: Path) -> None:
    path = tmp_path / "poses.jsonl"
    assert resume_point(path, HEADER) is None
    header = written("jsonl")
    for beginning in ("", header[:5], header[:-1], header, header + '{"type": "po'):
        path.write_text(beginning)
        assert resume_point(path, HEADER) is None


def test_a_run_never_goes_on_in_a_file_of_another_run(tmp_path: Path) -> None:
    path = tmp_path / "poses.jsonl"
    interrupted(path, "")
    for other in (replace(HEADER, seed=8), replace(HEADER, session_sha256="cd"), HEADER):
        if other is HEADER:
            assert resume_point(path, other) is not None
            continue
        with pytest.raises(SessionError, match="--resume"):
            resume_point(path, other)


def test_a_run_never_goes_on_in_a_file_of_a_session_alike_in_another_folder(tmp_path: Path) -> None:
    path, monday = tmp_path / "poses.jsonl", tmp_path / "monday.toml"
    path.write_text(written("jsonl", GOOD).replace("rig/session.toml", monday.as_posix()))
    assert resume_point(path, HEADER) is not None  # moved since
    monday.touch()
    with pytest.raises(SessionError, match=r"poses of .*monday\.toml, this run is of"):
        resume_point(path, HEADER)
    roundabout = tmp_path / "x" / ".." / "monday.toml"
    assert resume_point(path, replace(HEADER, session=str(roundabout))) is not None


@pytest.mark.parametrize("content", [b"\x89PNG\r\n\x1a\n\x00", b"notes", b"unit = 1\nhalf"])
def test_resuming_leaves_a_file_that_holds_no_poses_alone(content: bytes, tmp_path: Path) -> None:
    path = tmp_path / "poses.jsonl"
    path.write_bytes(content)
    with pytest.raises(RecordingError):
        resume_point(path, HEADER)
    assert path.read_bytes() == content


@pytest.mark.parametrize(
    ("seconds", "stamp"),
    [(1.5, (1, 500_000_000)), (-0.25, (-1, 750_000_000)), (2**31 - 1, (2**31 - 1, 0))],
)
def test_a_stamp_of_ros_counts_nanoseconds_upwards(seconds: float, stamp: tuple[int, int]) -> None:
    T = rigid.from_rotation_vector([0.0, 0.0, 0.5], [1000.0, -2000.0, 500.0])
    estimate = Estimate(3, None, "tool", "ok", T, np.diag([4e6] * 3 + [0.1] * 3), 0.9, {})
    message = pose_message(estimate, "mm", seconds, "lab")
    assert message["header"] == {
        "stamp": {"sec": stamp[0], "nanosec": stamp[1]},
        "frame_id": "lab",
    }
    assert message["pose"]["pose"]["position"] == {"x": 1.0, "y": -2.0, "z": 0.5}  # metres
    assert message["pose"]["covariance"][0] == 4.0  # m²
    with pytest.raises(RecordingError, match="frame 3: time 2147483648 s is beyond what format"):
        pose_message(estimate, "mm", 2.0**31)


def test_a_lost_frame_of_a_body_with_a_tip_is_written_as_it_was_read(tmp_path: Path) -> None:
    tip = np.array([0.0, 0.0, -100.0])
    told = written("jsonl", *(replace(one, tip_object=tip) for one in (GOOD, LOST)), LOST)
    path = tmp_path / "poses.jsonl"
    path.write_text(told, encoding="utf-8")
    again = written("jsonl", *read_poses(path).poses).splitlines()
    lines = [json.loads(line) for line in again]
    assert lines[1]["tip"] is not None
    assert (lines[2]["tip"], lines[2]["tip_covariance"]) == (None, None)
    assert "tip" not in lines[3]
    assert again[2:] == told.splitlines()[2:]


def test_a_time_of_ros_that_no_clock_has_is_refused() -> None:
    with pytest.raises(RecordingError, match=r"frame 12: time 1e\+300 s is beyond what format"):
        pose_message(replace(GOOD, time_s=1e300), "mm", 1e300)
