"""How a command ends when it is asked to, or when nobody reads what it says."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from command_line import LONGEST_S, has_written, started, wait_until
from long_recordings import CAMERA_FRAMES, long_cameras

from mixpose.cli import main

SESSION = Path(__file__).parents[1] / "data" / "synthetic" / "two_cameras" / "session.toml"
MIXPOSE = f"{sys.executable} -m mixpose"

needs_posix = pytest.mark.skipif(os.name == "nt", reason="signals and shells are POSIX's")


def in_shell(command: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(["sh", "-c", command], capture_output=True, text=True, check=False)


@needs_posix
@pytest.mark.parametrize("request_to_end", [signal.SIGTERM, signal.SIGHUP])
def test_a_request_to_end_finishes_the_video_as_an_interrupt_does(
    tmp_path: Path, request_to_end: signal.Signals
) -> None:
    import cv2

    poses, video = tmp_path / "poses.jsonl", tmp_path / "seen.mp4"
    session = long_cameras(tmp_path)
    command = [sys.executable, "-m", "mixpose", "run", str(session), "-o", str(poses)]
    command += ["--overlay", str(video)]
    with started(command, stderr=subprocess.PIPE) as process:
        wait_until(lambda: has_written(poses), by=process)
        process.send_signal(request_to_end)
        _, stderr = process.communicate(timeout=LONGEST_S)
    assert process.returncode == 130
    assert stderr == "mixpose: interrupted; everything so far is written\n"
    count = len(poses.read_text(encoding="utf-8").splitlines()) - 1
    assert 0 < count < CAMERA_FRAMES  # it was interrupted
    # an MP4 that is not finished has no frame; the frame being written may be in one of the two
    assert abs(cv2.VideoCapture(str(video)).get(cv2.CAP_PROP_FRAME_COUNT) - count) <= 1


@needs_posix
def test_a_run_that_ignores_hangups_goes_on_after_one(tmp_path: Path) -> None:
    poses = tmp_path / "poses.jsonl"
    command = f"trap '' HUP; exec {MIXPOSE} run {SESSION} -o {poses}"
    with started(["sh", "-c", command], stderr=subprocess.PIPE) as process:
        wait_until(lambda: poses.exists() or process.poll() is not None)
        process.send_signal(signal.SIGHUP)
        process.communicate(timeout=LONGEST_S)
    assert process.returncode == 0


@pytest.mark.parametrize(
    ("arguments", "status"),
    [(["run", "no.toml"], 2), (["run", "no.toml", "--foo"], 2), (["evaluate", "no", "no"], 3)],
)
def test_debug_adds_the_traceback_and_keeps_the_line_and_the_status(
    arguments: list[str], status: int, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as plain:
        main(arguments)
    line = capsys.readouterr().err
    with pytest.raises(SystemExit) as debugged:
        main([*arguments, "--debug"])
    said = capsys.readouterr().err
    assert plain.value.code == debugged.value.code == status
    assert said.startswith("Traceback")
    assert said.endswith(line)


@needs_posix
def test_a_reader_that_has_seen_enough_gives_status_0() -> None:
    result = in_shell(f"({MIXPOSE} run {SESSION}; echo $? >&2) | head -n 1")
    assert json.loads(result.stdout)["type"] == "header"
    assert result.stderr == "0\n"


@needs_posix
def test_messages_never_go_among_the_poses_where_standard_error_is_closed() -> None:
    result = in_shell(f"{MIXPOSE} run {SESSION} --stop 1 2>&-")
    assert result.returncode == 0
    types = [json.loads(line)["type"] for line in result.stdout.splitlines()]
    assert types == ["header", "pose"]


@needs_posix
@pytest.mark.parametrize("command", [f"run {SESSION} --stop 1", "schema"])
def test_a_closed_standard_output_is_one_line(command: str) -> None:
    result = in_shell(f"{MIXPOSE} {command} >&-")
    assert result.returncode == 2
    assert result.stderr == "mixpose: output: cannot be written or read: not writable\n"


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs a device that is always full")
def test_a_run_that_cannot_tell_how_it_went_still_writes_its_poses(tmp_path: Path) -> None:
    poses = tmp_path / "poses.jsonl"
    result = in_shell(f"{MIXPOSE} run {SESSION} --stop 2 -o {poses} 2>/dev/full")
    assert result.returncode == 0
    assert len(poses.read_text(encoding="utf-8").splitlines()) == 3


def test_a_compiled_module_that_is_cut_is_no_interrupt(tmp_path: Path) -> None:
    environment = {**os.environ, "PYTHONPYCACHEPREFIX": str(tmp_path)}
    environment.pop("PYTHONDONTWRITEBYTECODE", None)

    def schema() -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-m", "mixpose", "schema"]
        return subprocess.run(command, capture_output=True, text=True, check=False, env=environment)

    assert schema().returncode == 0
    for name in ("poses/schema", "cli/request"):  # of the command, and of all of them
        folder, stem = name.split("/")
        (compiled,) = tmp_path.rglob(f"mixpose/{folder}/{stem}.*.pyc")
        whole = compiled.read_bytes()
        compiled.write_bytes(whole[:40])  # the header, and little more
        result = schema()
        assert result.returncode == 2
        (line,) = result.stderr.splitlines()
        assert line.startswith(f"mixpose: {compiled}: is damaged: ")
        assert line.endswith("; remove this file, Python makes it anew")
        compiled.write_bytes(whole)
