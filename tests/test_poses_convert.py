"""Pose lines in the formats of other programs, read by those programs or by their rules."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from mixpose import rigid
from mixpose.cli import main
from mixpose.poses.evaluate import evaluate_files
from mixpose.poses.header import Header
from mixpose.poses.jsonl import JsonlWriter, read_poses
from mixpose.records import Estimate, SensorReport
from mixpose.session import load_session

SYNTHETIC = Path(__file__).parents[1] / "data" / "synthetic"
TRUTH = SYNTHETIC / "one_camera_video" / "truth.jsonl"


def estimate(frame: int, *, status: Any = "ok", time_s: float | None = 0.1) -> Estimate:
    T = rigid.from_rotation_vector([0.3, -0.2, 0.1 * frame], [1500.0, -20.0, 1e-4 * frame])
    deviations = np.array([0.1, 0.2, 0.3, 1e-3, 2e-3, 3e-3])
    mixing = np.eye(6) + 0.1 * np.arange(36).reshape(6, 6) / 36
    covariance = np.diag(deviations) @ mixing @ mixing.T @ np.diag(deviations)
    lost = status == "lost"
    return Estimate(
        frame=frame,
        time_s=None if time_s is None else time_s * frame,
        object="tracker",
        status=status,
        T_world_object=None if lost else T,
        covariance=None if lost else covariance,
        score=0.9,
        sensors={"left": SensorReport(True, 0.8, 0.2)},
        latency_ms=2.0,
    )


ESTIMATES = (estimate(3), estimate(4, status="lost"), estimate(5, status="ambiguous"), estimate(9))


def written(path: Path, *estimates: Estimate, unit: str = "mm", **more: Any) -> Path:
    run: dict[str, Any] = {"session": "s.toml", "session_sha256": "0" * 64, "seed": 3, **more}
    header = Header(unit=unit, mixpose="0.1.0", **run)
    with path.open("w", encoding="utf-8") as stream:
        writer = JsonlWriter(stream, header)
        for each in estimates:
            writer.write(each)
    return path


@pytest.fixture
def poses(tmp_path: Path) -> Path:
    return written(tmp_path / "poses.jsonl", *ESTIMATES)


def convert(*arguments: str | Path) -> int:
    with pytest.raises(SystemExit) as left:
        main(["convert", *map(str, arguments)])
    assert isinstance(left.value.code, int)
    return left.value.code


def refused(capfd: pytest.CaptureFixture[str], *arguments: str | Path) -> str:
    assert convert(*arguments) == 2
    output, errors = capfd.readouterr()
    assert output == ""
    assert len(errors.splitlines()) == 1
    return errors


def test_json_lines_stay_as_they_are(poses: Path, tmp_path: Path) -> None:
    assert convert(poses, "-o", tmp_path / "again.jsonl") == 0
    assert (tmp_path / "again.jsonl").read_text() == poses.read_text()


def test_the_recording_that_was_read_stays_in_json_lines(tmp_path: Path) -> None:
    sources = {"left": "tuesday/left*.png"}
    poses = written(tmp_path / "poses.jsonl", *ESTIMATES, sources=sources)
    assert read_poses(poses).sources == sources
    assert convert(poses, "-o", tmp_path / "again.jsonl") == 0
    assert (tmp_path / "again.jsonl").read_text() == poses.read_text()


def test_a_header_whose_recordings_are_no_names_is_refused(
    poses: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    text = poses.read_text().replace('"seed": 3', '"seed": 3, "sources": {"left": 0}')
    poses.write_text(text)
    assert convert(poses, "-o", tmp_path / "poses.csv") == 3
    assert "poses.jsonl:1: sources.left is 0" in capfd.readouterr().err


def test_table_has_a_row_per_frame(poses: Path, tmp_path: Path) -> None:
    assert convert(poses, "-o", tmp_path / "poses.csv") == 0
    with (tmp_path / "poses.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    assert [row["frame"] for row in rows] == ["3", "4", "5", "9"]
    assert rows[0]["left_explained"] == "0.8"
    assert rows[1]["tx"] == ""


def test_ambiguous_frames_are_left_out_where_wanted(poses: Path, tmp_path: Path) -> None:
    assert convert(poses, "-o", tmp_path / "sure.csv", "--only-ok") == 0
    with (tmp_path / "sure.csv").open() as stream:
        assert [row["frame"] for row in csv.DictReader(stream)] == ["3", "9"]


def test_leaving_out_all_poses_is_told(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    poses = written(tmp_path / "poses.jsonl", estimate(5, status="ambiguous"))
    assert convert(poses, "-o", tmp_path / "sure.csv", "--only-ok") == 0
    warning, last = capfd.readouterr().err.splitlines()
    assert "no pose is ok, and --only-ok leaves out the others" in warning
    assert last.startswith("mixpose: 0 poses -> ")
    assert convert(poses, "-o", tmp_path / "all.csv") == 0
    assert capfd.readouterr().err == f"mixpose: 1 pose -> {tmp_path / 'all.csv'}\n"


def test_ros_messages_are_in_metres_and_radians(poses: Path, tmp_path: Path) -> None:
    assert convert(poses, "-o", tmp_path / "poses.yaml") == 0
    documents = yaml.safe_load_all((tmp_path / "poses.yaml").read_text())
    messages = [message for message in documents if message is not None]
    assert len(messages) == 3  # one is lost
    for message, source in zip(messages, [ESTIMATES[0], *ESTIMATES[2:]], strict=True):
        assert list(message) == ["header", "pose"]
        assert message["header"]["frame_id"] == "world"
        stamp = message["header"]["stamp"]
        assert source.time_s is not None
        assert stamp["sec"] + 1e-9 * stamp["nanosec"] == pytest.approx(source.time_s, abs=1e-9)
        assert source.T_world_object is not None
        assert source.covariance is not None
        pose = message["pose"]["pose"]
        position = [pose["position"][name] for name in "xyz"]
        np.testing.assert_allclose(position, source.T_world_object[:3, 3] / 1000, rtol=1e-12)
        turn = [pose["orientation"][name] for name in "xyzw"]
        np.testing.assert_allclose(turn, rigid.quaternion_xyzw(source.T_world_object), rtol=1e-12)
        matrix = np.array(message["pose"]["covariance"], dtype=np.float64).reshape(6, 6)
        # mm² to m², mm·rad to m·rad, rad² stay
        np.testing.assert_allclose(matrix[:3, :3], source.covariance[:3, :3] * 1e-6, rtol=1e-12)
        np.testing.assert_allclose(matrix[:3, 3:], source.covariance[:3, 3:] * 1e-3, rtol=1e-12)
        np.testing.assert_allclose(matrix[3:, 3:], source.covariance[3:, 3:], rtol=1e-12)


def test_ros_messages_fill_the_real_message_type(poses: Path, tmp_path: Path) -> None:
    typesys = pytest.importorskip("rosbags.typesys")
    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    convert(poses, "-o", tmp_path / "poses.yaml")

    def message(name: str, fields: Any) -> Any:
        kind = store.types[name]
        values = {}
        for field, (sort, detail) in store.fielddefs[name][1]:
            value = fields.pop(field)
            if sort == typesys.base.Nodetype.NAME:
                value = message(detail, value)
            elif isinstance(value, list):
                value = np.array(value, dtype=np.float64)
            values[field] = value
        assert not fields
        return kind(**values)

    name = "geometry_msgs/msg/PoseWithCovarianceStamped"
    for fields in filter(None, yaml.safe_load_all((tmp_path / "poses.yaml").read_text())):
        expected = fields["pose"]["covariance"]
        back = store.deserialize_cdr(store.serialize_cdr(message(name, fields), name), name)
        np.testing.assert_array_equal(back.pose.covariance, expected)


def test_ros_pose_without_covariance_says_unknown(tmp_path: Path) -> None:
    convert(TRUTH, "-o", tmp_path / "truth.yaml")
    first = next(yaml.safe_load_all((tmp_path / "truth.yaml").read_text()))
    assert first["pose"]["covariance"] == [0.0] * 36


def test_ros_time_without_times_is_the_frame_number(tmp_path: Path) -> None:
    poses = written(tmp_path / "poses.jsonl", estimate(7, time_s=None))
    convert(poses, "-o", tmp_path / "poses.yaml")
    text = (tmp_path / "poses.yaml").read_text()
    assert text.startswith("# time is the frame number")
    assert yaml.safe_load(text.split("---")[0])["header"]["stamp"] == {"sec": 7, "nanosec": 0}


def bop_rows(path: Path) -> list[dict[str, Any]]:
    """The rules of the BOP toolkit's reader for results of version bop19, stated anew."""
    header, *lines = path.read_text().splitlines()
    assert header == "scene_id,im_id,obj_id,score,R,t,time"
    rows = []
    for line in lines:
        cells = line.split(",")
        assert len(cells) == 7, "seven cells, none of which holds a comma or is quoted"
        scene_id, im_id, obj_id, score, R, t, time = cells
        rotation = np.array([float(word) for word in R.split()]).reshape(3, 3)
        translation = np.array([float(word) for word in t.split()]).reshape(3, 1)
        row: dict[str, Any] = {"scene_id": int(scene_id), "im_id": int(im_id)}
        row |= {"obj_id": int(obj_id), "score": float(score)}
        rows.append(row | {"R": rotation, "t": translation[:, 0]})
        rows[-1]["time"] = float(time)
    times: dict[tuple[int, int], float] = {}
    for row in rows:  # all estimates of an image carry one time
        assert times.setdefault((row["scene_id"], row["im_id"]), row["time"]) == row["time"]
    return rows


@pytest.mark.parametrize("unit", ["mm", "m", "um"])
def test_bop_results_keep_the_rules_of_the_toolkits_reader(unit: str, tmp_path: Path) -> None:
    poses = written(tmp_path / "poses.jsonl", *ESTIMATES, unit=unit)
    options = ("--format", "bop", "--scene-id", "48", "--obj-id", "15")
    assert convert(poses, "-o", tmp_path / "mixpose_lm-test.csv", *options) == 0
    rows = bop_rows(tmp_path / "mixpose_lm-test.csv")
    assert [(row["scene_id"], row["im_id"], row["obj_id"]) for row in rows] == [
        (48, 3, 15),
        (48, 5, 15),
        (48, 9, 15),
    ]
    mm = {"mm": 1.0, "m": 1000.0, "um": 0.001}[unit]
    for row, source in zip(rows, [ESTIMATES[0], *ESTIMATES[2:]], strict=True):
        assert source.T_world_object is not None
        np.testing.assert_allclose(row["R"], source.T_world_object[:3, :3], atol=1e-15)
        np.testing.assert_allclose(row["t"], source.T_world_object[:3, 3] * mm, rtol=1e-12)
        assert row["time"] == pytest.approx(0.002)


@pytest.mark.parametrize(
    ("options", "number"),
    [("", 2), ("--object b", 2), ("--obj-id 7", 8), ("--object b --obj-id 7", 7)],
)
def test_bop_numbers_of_objects_stay_whatever_is_left_out(
    options: str, number: int, tmp_path: Path
) -> None:
    first, second = (
        replace(estimate(3, status=s), object=o) for s, o in (("lost", "a"), ("ok", "b"))
    )
    poses = written(tmp_path / "poses.jsonl", first, second)
    for more in ([], ["--only-ok"]):
        output = tmp_path / f"{len(more)}.csv"
        assert convert(poses, "--format", "bop", *more, *options.split(), "-o", output) == 0
        assert [row["obj_id"] for row in bop_rows(output)] == [number]


def noisy(path: Path) -> Path:
    """The truth, each position off by a known amount; a frame is lost."""
    rng = np.random.default_rng(5)
    estimates = []
    for line in read_poses(TRUTH).poses:
        assert line.T_world_object is not None
        T = line.T_world_object.copy()
        T[:3, 3] += rng.normal(0, 0.5, 3)
        lost = line.frame == 17
        estimates.append(
            Estimate(
                frame=line.frame,
                time_s=line.time_s,
                object=line.object,
                status="lost" if lost else "ok",
                T_world_object=None if lost else T,
                covariance=None,
                score=0.5,
                sensors={},
            )
        )
    return written(path, *estimates)


def test_evo_opens_trajectories_and_agrees_on_the_position_error(tmp_path: Path) -> None:
    pytest.importorskip("evo")
    from evo.core import metrics, sync
    from evo.tools import file_interface

    poses = noisy(tmp_path / "poses.jsonl")
    convert(poses, "-o", tmp_path / "poses.tum")
    convert(TRUTH, "-o", tmp_path / "truth.tum")
    truth = file_interface.read_tum_trajectory_file(str(tmp_path / "truth.tum"))
    found = file_interface.read_tum_trajectory_file(str(tmp_path / "poses.tum"))
    assert truth.num_poses == 60
    assert found.num_poses == 59
    assert truth.check()[0]
    error = metrics.APE(metrics.PoseRelation.translation_part)
    error.process_data(sync.associate_trajectories(truth, found))
    rms_m = error.get_statistic(metrics.StatisticsType.rmse)
    ours = evaluate_files(poses, TRUTH).translation
    assert ours is not None
    assert 0.5 < ours.rms < 1.2  # 0.5 mm along each axis
    assert rms_m * 1000 == pytest.approx(ours.rms, rel=1e-9)


def test_first_of_several_right_answers_is_written(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    other = estimate(3)
    poses = written(tmp_path / "truth.jsonl", estimate(3), other, estimate(9))
    assert convert(poses, "--format", "tum") == 0
    output, errors = capfd.readouterr()
    assert len(output.splitlines()) == 3  # with what the columns are
    assert "warning" in errors
    assert "several right answers in 1 frame; the first is written" in errors
    assert convert(poses, "--format", "jsonl") == 0
    assert len(capfd.readouterr().out.splitlines()) == 4


def test_unit_is_asked_for_where_no_header_says_it(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    bare: dict[str, Any] = {"frame": 0, "object": "a", "T_world_object": np.eye(4).tolist()}
    bare["T_world_object"][0][3] = 5.0
    path = tmp_path / "truth.jsonl"
    path.write_text(json.dumps(bare) + "\n")
    assert "add --unit, one of m, cm, mm, um" in refused(capfd, path, "--format", "tum")
    assert convert(path, "--format", "tum", "--unit", "cm") == 0
    assert capfd.readouterr().out.splitlines()[-1].startswith("0.0 0.05 0.0 0.0 ")


def test_several_objects_are_no_trajectory(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    lines = [
        {"frame": i, "object": name, "T_world_object": np.eye(4).tolist(), "time_s": i}
        for i in range(2)
        for name in ("a", "b")
    ]
    path = tmp_path / "truth.jsonl"
    path.write_text("".join(json.dumps(line) + "\n" for line in lines))
    message = refused(capfd, path, "--format", "tum", "--unit", "m")
    assert "holds a, b, and format 'tum' holds one object; choose with --object, or" in message
    assert convert(path, "--format", "tum", "--unit", "m", "--object", "b") == 0
    assert len(capfd.readouterr().out.splitlines()) == 3  # with what the columns are
    assert convert(path, "--format", "bop", "--unit", "m") == 0
    rows = capfd.readouterr().out.splitlines()[1:]
    assert [row.split(",")[1:3] for row in rows] == [["0", "1"], ["0", "2"], ["1", "1"], ["1", "2"]]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ([], "--format: missing, where there is no -o whose suffix tells the format"),
        (["-o", "poses.txt"], "-o poses.txt: no format has this suffix; add --format"),
        (["--format", "tum", "--scene-id", "3"], "--scene-id: belongs to --format bop, found"),
        (["--format", "tum", "--object", "b"], "--object b: "),
        (["--format", "tum", "--unit", "m"], "says that its unit is mm"),
        (["--format", "tum", "--unit", "inch"], "--unit inch: allowed are m, cm, mm, um"),
        (["--format", "ros2"], "--format"),
        (
            ["--format", "jsonl", "--relative-to", "left"],
            "belongs to --format bop or csv or ros or tum",
        ),
        (["--format", "tum", "--session", "s.toml"], "--session: belongs to"),
        (["--format", "tum", "--relative-to", "left"], "its session s.toml is not there"),
    ],
)
def test_wrong_options_are_told(
    poses: Path, options: list[str], message: str, capfd: pytest.CaptureFixture[str]
) -> None:
    assert message in refused(capfd, poses, *options)


def test_nothing_of_the_users_is_overwritten(
    poses: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    notes = tmp_path / "notes.yaml"
    notes.write_text("# camera settings\nexposure: 3\n")
    assert "mixpose did not write" in refused(capfd, poses, "-o", notes)
    assert notes.read_text().endswith("exposure: 3\n")
    before = poses.read_text()
    assert "is an input of this run" in refused(capfd, poses, "-o", poses)
    assert poses.read_text() == before
    for name in ("poses.yaml", "poses.tum", "poses.csv", "again.jsonl"):
        assert convert(poses, "-o", tmp_path / name) == 0
        assert convert(poses, "-o", tmp_path / name) == 0  # its own output it replaces


def test_poses_relative_to_a_camera_are_seen_by_it_where_the_object_is(tmp_path: Path) -> None:
    session = load_session(SYNTHETIC / "two_cameras" / "session.toml")
    right = session.sensors[1].sensor
    T_sensor_world = right.T_sensor_world  # type: ignore[attr-defined]
    assert not np.allclose(T_sensor_world, np.eye(4))
    source = estimate(3)
    poses = written(tmp_path / "poses.jsonl", source)
    options = ("--relative-to", session.sensors[1].name, "--session", session.path)
    convert(poses, "--format", "bop", "-o", tmp_path / "bop.csv", *options)
    row = bop_rows(tmp_path / "bop.csv")[0]
    assert source.T_world_object is not None
    x_object = np.array([7.0, -8.0, 9.0])
    x_world = source.T_world_object @ [*x_object, 1.0]
    np.testing.assert_allclose(
        row["R"] @ x_object + row["t"], (T_sensor_world @ x_world)[:3], rtol=1e-9
    )

    convert(poses, "-o", tmp_path / "poses.yaml", *options)
    message = next(yaml.safe_load_all((tmp_path / "poses.yaml").read_text()))
    assert message["header"]["frame_id"] == session.sensors[1].name
    # a small motion in the world's axes, drawn from the covariance, is the same motion in the
    # sensor's axes: compare by finite differences
    twist = np.array([1.0, -2.0, 0.5, 1e-6, 2e-6, -3e-6])
    moved = T_sensor_world @ rigid.perturb(source.T_world_object, twist)
    seen = rigid.twist_between(T_sensor_world @ source.T_world_object, moved)
    scale = np.array([1e-3] * 3 + [1.0] * 3)
    found = np.array(message["pose"]["covariance"]).reshape(6, 6) / np.outer(scale, scale)
    assert source.covariance is not None
    # Mahalanobis lengths do not depend on the axes
    assert seen @ np.linalg.solve(found, seen) == pytest.approx(
        twist @ np.linalg.solve(source.covariance, twist), rel=1e-4
    )


def test_a_session_in_another_unit_than_the_poses_is_refused(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "truth.jsonl"
    line = {"frame": 0, "object": "tool", "T_world_object": np.eye(4).tolist(), "time_s": 0.0}
    path.write_text(json.dumps(line) + "\n")
    given = ["--session", str(TRUTH.parent / "session.toml"), "--unit", "m"]
    for more in (["--format", "tum", "--relative-to", "camera"], ["--format", "trc"]):
        message = refused(capfd, path, *more, *given)
        assert f"lengths in mm, but those of {path} are in m" in message


def test_formats_without_lost_frames_count_the_others(
    poses: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    for name, many in (("all.csv", 4), ("all.tum", 3)):
        assert convert(poses, "-o", tmp_path / name) == 0
        assert capfd.readouterr().err == f"mixpose: {many} poses -> {tmp_path / name}\n"
