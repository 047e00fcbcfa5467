"""Poses of one body seen from another, as a tool in the axes of a patient, and tips in tables."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from command_line import assert_one_line, command

from mixpose import rigid
from mixpose.poses.estimates import relative_to_body
from mixpose.poses.header import Header
from mixpose.poses.jsonl import JsonlWriter, read_poses
from mixpose.records import Estimate, SensorReport

SYNTHETIC = Path(__file__).parents[1] / "data" / "synthetic"
PLACES = {"patient": [40.0, -20.0, 900.0], "tool": [90.0, 30.0, 860.0]}


def estimate(name: str, frame: int, **changes: Any) -> Estimate:
    turn = [0.3, -0.2, 0.1 * frame] if name == "patient" else [-1.0, 0.1 * frame, 0.4]
    mixing = np.diag([0.01] * 3 + [0.001] * 3) @ np.random.default_rng(frame).normal(size=(6, 6))
    told = Estimate(
        frame=frame,
        time_s=0.1 * frame,
        object=name,
        status="ok",
        T_world_object=rigid.from_rotation_vector(turn, PLACES[name]),
        covariance=mixing @ mixing.T,
        score=0.9,
        sensors={"left": SensorReport(True, 0.8, 0.2)},
        confidence=0.9999,
    )
    return replace(told, **changes)


def lost(name: str, frame: int) -> Estimate:
    return estimate(
        name, frame, status="lost", T_world_object=None, covariance=None, confidence=0.0
    )


def written(path: Path, *estimates: Estimate) -> Path:
    header = Header("mm", "s.toml", "0" * 64, "0.1.0", 3, objects={"patient": 1, "tool": 1})
    with path.open("w", encoding="utf-8") as stream:
        writer = JsonlWriter(stream, header)
        for each in estimates:
            writer.write(each)
    return path


def both(tmp_path: Path, tool: Estimate, patient: Estimate) -> Estimate:
    lines = read_poses(written(tmp_path / "poses.jsonl", patient, tool)).poses
    return relative_to_body(lines[1], lines[0])


def test_a_point_of_the_tool_is_where_the_patient_has_it(tmp_path: Path) -> None:
    tool, patient = estimate("tool", 3), estimate("patient", 3)
    told = both(tmp_path, tool, patient)
    assert tool.T_world_object is not None
    assert patient.T_world_object is not None
    assert told.T_world_object is not None
    point = np.array([7.0, -8.0, 9.0, 1.0])
    in_world = patient.T_world_object @ told.T_world_object @ point
    np.testing.assert_allclose(in_world, tool.T_world_object @ point, atol=1e-9)
    assert told.status == "ok"
    assert told.confidence == pytest.approx(0.9999**2)


def test_the_covariance_is_that_of_errors_of_both(tmp_path: Path) -> None:
    tool, patient = estimate("tool", 3), estimate("patient", 3)
    told = both(tmp_path, tool, patient)
    T_tool, T_patient = tool.T_world_object, patient.T_world_object
    assert T_tool is not None
    assert T_patient is not None
    expected = np.zeros((6, 6))
    still = rigid.inverse(T_patient) @ T_tool
    steps = 1e-6 * np.eye(6)
    for which, one in enumerate((tool, patient)):
        J = np.empty((6, 6))
        for k, step in enumerate(steps):
            moved = [T_tool, T_patient]
            moved[which] = rigid.perturb(moved[which], step)
            J[:, k] = rigid.twist_between(still, rigid.inverse(moved[1]) @ moved[0]) / 1e-6
        assert one.covariance is not None
        expected += J @ one.covariance @ J.T
    assert told.covariance is not None
    np.testing.assert_allclose(told.covariance, expected, rtol=1e-5, atol=1e-9)


def test_what_either_body_leaves_open_is_left_open(tmp_path: Path) -> None:
    tool, patient = estimate("tool", 3), estimate("patient", 3)
    told = both(tmp_path, tool, replace(patient, status="ambiguous", confidence=0.7))
    assert told.status == "ambiguous"
    assert told.confidence == pytest.approx(0.7 * 0.9999)
    assert both(tmp_path, tool, replace(patient, filled=True)).filled
    assert both(tmp_path, tool, lost("patient", 3)).status == "lost"
    assert both(tmp_path, lost("tool", 3), patient).status == "lost"
    line = read_poses(written(tmp_path / "alone.jsonl", tool)).poses[0]
    assert relative_to_body(line, None).T_world_object is None


def test_convert_writes_the_other_bodies_in_the_axes_of_one(tmp_path: Path) -> None:
    frames = [estimate(name, k) for k in range(3) for name in PLACES]
    frames[4] = lost("patient", 2)
    poses = written(tmp_path / "poses.jsonl", *frames)
    result = command("convert", poses, "--relative-to", "patient", "-o", tmp_path / "tool.csv")
    assert result.returncode == 0
    assert "1 of 3 poses are lost, as 'patient' has none then" in result.stderr
    with (tmp_path / "tool.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["object"] for row in rows] == ["tool"] * 3
    assert [row["status"] for row in rows] == ["ok", "ok", "lost"]
    a, b = frames[0].T_world_object, frames[1].T_world_object
    assert a is not None
    assert b is not None
    told = [float(rows[0][key]) for key in ("tx", "ty", "tz")]
    np.testing.assert_allclose(told, (rigid.inverse(a) @ b)[:3, 3], atol=1e-9)
    assert (
        command("convert", poses, "--relative-to", "patient", "-o", tmp_path / "a.yaml").returncode
        == 0
    )
    first = next(yaml.safe_load_all((tmp_path / "a.yaml").read_text()))
    assert first["header"]["frame_id"] == "patient"


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--format", "bop", "--relative-to", "tool"), "is a body, and --format bop holds"),
        (("-o", "a.jsonl", "--relative-to", "tool"), "belongs to --format bop or csv or ros"),
        (("-o", "a.csv", "--relative-to", "spoon"), "no body, which are patient, tool; "),
        (("-o", "a.csv", "--relative-to", "tool", "--object", "tool"), "told relative to"),
        (("-o", "a.csv", "--relative-to", "tool", "--session", "s.toml"), "which needs none"),
    ],
)
def test_what_poses_cannot_be_relative_to_is_told(
    tmp_path: Path, options: tuple[str, ...], message: str
) -> None:
    poses = written(tmp_path / "poses.jsonl", estimate("patient", 0), estimate("tool", 0))
    assert_one_line(command("convert", poses, *options, cwd=tmp_path), 2, message)


def test_what_is_neither_a_camera_nor_a_body_is_told_with_all_that_are(tmp_path: Path) -> None:
    poses = written(tmp_path / "poses.jsonl", estimate("patient", 0), estimate("tool", 0))
    session = ("--session", SYNTHETIC / "two_cameras" / "session.toml")
    result = command("convert", poses, "-o", tmp_path / "a.csv", "--relative-to", "spoon", *session)
    assert result.returncode == 2
    assert result.stderr.endswith("cameras are left, right, bodies are patient, tool\n")


def test_a_file_of_one_body_has_none_to_be_seen_from(tmp_path: Path) -> None:
    poses = written(tmp_path / "poses.jsonl", estimate("tool", 0))
    result = command("convert", poses, "-o", tmp_path / "a.csv", "--relative-to", "tool")
    assert_one_line(result, 2, "has poses of no other body")


def test_tables_tell_where_the_tip_is(tmp_path: Path) -> None:
    session = (SYNTHETIC / "one_camera_video" / "session.toml").read_text(encoding="utf-8")
    folder = (SYNTHETIC / "one_camera_video").as_posix()
    for key in ("source", "file", "calibration"):
        session = session.replace(f'{key} = "', f'{key} = "{folder}/')
    told = session.replace("[object]\n", "[object]\ntip = [0.0, -5.0, 40.0]\n")
    (tmp_path / "session.toml").write_text(told, encoding="utf-8")
    poses = tmp_path / "poses.jsonl"
    run = ("run", tmp_path / "session.toml", "--stop", "2")
    assert command(*run, "-o", poses).returncode == 0
    assert command(*run, "-o", tmp_path / "run.csv").returncode == 0
    assert command("convert", poses, "-o", tmp_path / "convert.csv").returncode == 0
    lines = [json.loads(line) for line in poses.read_text().splitlines()[1:]]
    for name in ("run.csv", "convert.csv"):
        with (tmp_path / name).open() as file:
            rows = list(csv.DictReader(file))
        for line, row in zip(lines, rows, strict=True):
            tip = [float(row[f"tip_{axis}"]) for axis in "xyz"]
            np.testing.assert_allclose(tip, line["tip"], rtol=1e-9)
            assert float(row["tip_cov_y_z"]) == pytest.approx(line["tip_covariance"][1][2])


def test_a_file_that_says_no_unit_is_taken_for_the_other_and_that_is_told(tmp_path: Path) -> None:
    poses = written(tmp_path / "poses.jsonl", estimate("tool", 0))
    bare = tmp_path / "bare.jsonl"
    bare.write_text("\n".join(poses.read_text().splitlines()[1:]), encoding="utf-8")
    told = command("evaluate", poses, bare)
    assert told.returncode == 0
    assert "bare.jsonl: no header says the unit of its lengths; taken for mm" in told.stderr
    assert command("evaluate", poses, poses).stderr == ""
