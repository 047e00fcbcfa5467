"""What the command line says about wrong options, sources and resumed runs: one line each."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from command_line import assert_one_line, command
from report_runs import estimate, write

from mixpose.cli import main
from mixpose.cli.run import named_sources

SYNTHETIC = Path(__file__).parents[1] / "data" / "synthetic"
SESSION = str(SYNTHETIC / "two_cameras" / "session.toml")


def said(capsys: pytest.CaptureFixture[str], status: int, *arguments: str) -> str:
    with pytest.raises(SystemExit) as caught:
        main(arguments)
    text = capsys.readouterr().err
    assert caught.value.code == status, text
    return text


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (["run", "x.toml", "--steps", "3"],
         "--steps: no such option; did you mean --step? See mixpose run --help"),
        (["run", "x.toml", "--zzz"], "--zzz: no such option; see mixpose run --help"),
        (["run"], "SESSION.toml: missing; see mixpose run --help"),
        (["run", "x.toml", "--start", "a"],
         "--start: found a; allowed: integer; see mixpose run --help"),
        (["run", "x.toml", "--step=0"],
         "--step: found 0; allowed: greater than or equal to 1; see mixpose run --help"),
        (["run", "x.toml", "--format", "xml"],
         "--format: found xml; allowed: 'jsonl', 'csv', 'tum', 'bop', 'ros'; "
         "see mixpose run --help"),
        (["run", "x.toml", "-o"], "-o: found no value; see mixpose run --help"),
        (["rum"], "rum: no such command; did you mean 'run'? See mixpose --help"),
        (["check", "a.toml", "b.toml"],
         "b.toml: found, but no argument is left for it; see mixpose check --help"),
        (["simulate", "x.toml", "--frames", "3"],
         "--output: missing; see mixpose simulate --help"),
    ],
)  # fmt: skip
def test_wrong_options_are_worded_like_all_errors(
    arguments: list[str], line: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert said(capsys, 2, *arguments) == f"mixpose: {line}\n"


def test_a_source_is_looked_for_in_the_working_directory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for n in range(12):
        (tmp_path / f"img{n}.jpg").touch()
    monkeypatch.chdir(tmp_path)
    line = said(capsys, 3, "run", SESSION, "--source", "left=img*.png")
    assert f"looked in {tmp_path}, where there is img0.jpg, ... (12 in all)" in line
    line = said(capsys, 3, "run", SESSION, "--source", "left=frames/img*.png")
    assert f"there is no folder {tmp_path / 'frames'}" in line
    (tmp_path / "empty").mkdir()
    line = said(capsys, 3, "run", SESSION, "--source", "left=empty")
    assert f"looked in {tmp_path / 'empty'}, which is empty" in line
    assert len(line.splitlines()) == 1


def test_a_run_resumes_with_the_same_recording_only(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    other = tmp_path / "left"
    other.mkdir()
    for path in (SYNTHETIC / "two_cameras").glob("left000*.png"):
        shutil.copy(path, other)
    poses = tmp_path / "poses.jsonl"
    to_file = ["run", SESSION, "-o", str(poses), "--stop"]
    said(capsys, 0, *to_file, "2", "--source", f"left={other}")
    header = json.loads(poses.read_text(encoding="utf-8").splitlines()[0])
    assert header["sources"] == {"left": str(other)}
    before = poses.read_bytes()
    line = said(capsys, 2, *to_file, "3", "--resume")
    assert f"was written with --source left={other}, this run has no --source" in line
    assert poses.read_bytes() == before
    said(capsys, 0, *to_file, "3", "--resume", "--source", f"left={other}")
    assert len(poses.read_text(encoding="utf-8").splitlines()) == 4
    whole = poses.read_bytes()
    line = said(capsys, 0, *to_file, "3", "--resume", "--source", f"left={other}")
    assert line == f"mixpose: nothing left to do: {poses} has all frames asked for already\n"
    assert poses.read_bytes() == whole


def test_a_run_resumes_with_the_same_step_and_labels_only(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    poses = tmp_path / "poses.jsonl"
    to_file = ["run", SESSION, "-o", str(poses), "--stop"]
    said(capsys, 0, *to_file, "3", "--step", "2", "--labels")
    header = json.loads(poses.read_text(encoding="utf-8").splitlines()[0])
    assert header["options"] == {"step": 2, "labels": True}
    before = poses.read_bytes()
    for others in ([], ["--labels", "--step", "3"], ["--step", "2"]):
        line = said(capsys, 2, *to_file, "6", "--resume", *others)
        now = " ".join(others) or "no --source, --step or --labels"
        assert f"was written with --labels --step 2, this run has {now}; give the same" in line
        assert poses.read_bytes() == before
    said(capsys, 0, *to_file, "6", "--resume", "--labels", "--step", "2")
    frames = [json.loads(line)["frame"] for line in poses.read_text("utf-8").splitlines()[1:]]
    assert frames == [0, 2, 4]


def test_a_run_of_the_sessions_own_recording_names_no_sources(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    poses = tmp_path / "poses.jsonl"
    said(capsys, 0, "run", SESSION, "-o", str(poses), "--stop", "1")
    header = json.loads(poses.read_text(encoding="utf-8").splitlines()[0])
    assert not {"sources", "options"} & set(header)


def test_the_shell_completes_commands_and_options() -> None:
    def completed(words: str) -> list[str]:
        asked = {"_MIXPOSE_COMPLETE": "complete_bash", "COMP_WORDS": words}
        result = subprocess.run(
            [sys.executable, "-m", "mixpose"], capture_output=True, text=True, check=False,
            env=os.environ | asked | {"COMP_CWORD": str(words.count(" "))},
        )  # fmt: skip
        return result.stdout.split()

    assert "check" in completed("mixpose ch")
    assert "--quick" in completed("mixpose check --")
    assert completed("mixpose run s.toml --format ") == ["jsonl", "csv", "tum", "bop", "ros"]


def test_a_finished_run_that_is_resumed_says_that_nothing_was_left(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = ["run", SESSION, "-o", str(tmp_path / "p.jsonl"), "--stop", "2"]
    said(capsys, 0, *run)
    written = (tmp_path / "p.jsonl").read_bytes()
    assert "nothing left to do" in said(capsys, 0, *run, "--resume")
    assert (tmp_path / "p.jsonl").read_bytes() == written


def test_a_dash_is_standard_output(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    poses = command("run", SESSION, "--stop", "1", "-o", "-")
    assert poses.returncode == 0, poses.stderr
    assert [json.loads(line)["type"] for line in poses.stdout.splitlines()] == ["header", "pose"]
    (tmp_path / "p.jsonl").write_text(poses.stdout, encoding="utf-8")
    table = command("convert", "p.jsonl", "--format", "csv", "-o", "-")
    assert table.stdout.startswith("frame,time_s,object")
    assert [path.name for path in tmp_path.iterdir()] == ["p.jsonl"]


def test_a_number_in_place_of_a_recording_is_a_camera_unless_a_file_has_that_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert named_sources(["left=0", "right=12"]) == {"left": "camera:0", "right": "camera:12"}
    (tmp_path / "0").mkdir()
    assert named_sources(["left=0", "right=a0"]) == {"left": "0", "right": "a0"}


def test_check_looks_at_the_recording_that_is_named(tmp_path: Path) -> None:
    for n in range(3):
        shutil.copy(SYNTHETIC / "two_cameras" / f"left{n:04d}.png", tmp_path / f"seen{n}.png")
    found = command("check", SESSION, "--quick", "--source", f"left={tmp_path}")
    assert found.returncode == 0, found.stderr
    assert "3 images 640x512, frames 0-2" in found.stdout
    wrong = command("check", SESSION, "--source", "middle=x")
    assert_one_line(wrong, 2, "--source middle=...: no such sensor, allowed: left, right")


def test_a_camera_that_does_not_open_is_an_error_of_a_check(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    session = SYNTHETIC / "one_camera_video" / "session.toml"
    found = command("check", session, "--source", "camera=97")
    assert_one_line(found, 3, "camera:97: does not open")


@pytest.mark.parametrize("unit_of_time", ["fps = 25", ""])
def test_frame_numbers_that_stand_for_seconds_are_told(unit_of_time: str, tmp_path: Path) -> None:
    text = Path(SESSION).read_text(encoding="utf-8").replace("fps = 25", unit_of_time)
    text = text.replace('source = "', f'source = "{Path(SESSION).parent.as_posix()}/')
    (tmp_path / "s.toml").write_text(text, encoding="utf-8")
    poses = tmp_path / "p.jsonl"
    run = command("run", tmp_path / "s.toml", "--stop", "2", "-o", poses)
    assert "warning" not in run.stderr  # JSON lines have both
    for done in (
        command("run", tmp_path / "s.toml", "--stop", "2", "-o", tmp_path / "p.tum"),
        command("convert", poses, "-o", tmp_path / "q.tum"),
    ):
        assert done.returncode == 0, done.stderr
        told = done.stderr.count("poses have no times, so that frame numbers stand for seconds")
        assert told == (0 if unit_of_time else 1)


def test_a_report_is_no_pdf(tmp_path: Path) -> None:
    poses = write(tmp_path / "p.jsonl", [estimate(0, np.eye(4), "lost")], None)
    result = command("report", poses, "-o", tmp_path / "report.pdf")
    assert_one_line(result, 2, "found the suffix .pdf", "name it report.html")
    assert not (tmp_path / "report.pdf").exists()


@pytest.mark.parametrize(
    ("words", "name", "instead"),
    [
        (["smooth", "POSES"], "smooth.csv", "name it smooth.jsonl"),
        (["learn", "SESSION"], "body.toml", "name it body.csv"),
        (["calibrate", "SESSION"], "rig.json", "name it rig.toml"),
        (["align", "SESSION", "--floor", "POSES"], "floor.yml", "name it floor.toml"),
    ],
)
def test_a_name_that_ends_as_another_format_does_is_refused(
    words: list[str], name: str, instead: str, tmp_path: Path
) -> None:
    poses = write(tmp_path / "p.jsonl", [estimate(0, np.eye(4), "lost")], None)
    places = {"POSES": str(poses), "SESSION": SESSION}
    asked = [places.get(word, word) for word in words]
    result = command(*asked, "-o", tmp_path / name)
    assert_one_line(result, 2, f"found the suffix {Path(name).suffix}", instead)
    assert not (tmp_path / name).exists()


def test_a_format_that_nothing_tells_is_asked_for(tmp_path: Path) -> None:
    poses = write(tmp_path / "p.jsonl", [estimate(0, np.eye(4), "lost")], None)
    assert_one_line(command("convert", poses), 2, "--format: missing, where there is no -o")
    foreign = command("convert", poses, "-o", tmp_path / "p.foo")
    assert_one_line(foreign, 2, "p.foo: no format has this suffix; add --format")
