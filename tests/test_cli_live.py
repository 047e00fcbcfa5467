"""The command line on cameras and pipes that run."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from pathlib import Path

import pytest
from command_line import LONGEST_S

from mixpose.cli import main
from mixpose.errors import SessionError
from mixpose.session import load_session

CLIP = Path(__file__).parents[1] / "data" / "synthetic" / "one_camera_video" / "camera.avi"
needs_pipes = pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no named pipes here")


def run_mixpose(*arguments: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "mixpose", "run", *arguments]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


@needs_pipes
def test_poses_of_a_pipe_appear_while_it_is_written_and_its_end_ends_the_run(
    tmp_path: Path,
) -> None:
    pipe = tmp_path / "camera"
    os.mkfifo(pipe)
    session = str(CLIP.with_name("session.toml"))
    data = CLIP.read_bytes()
    seen = threading.Event()

    def write() -> None:
        with pipe.open("wb") as stream:
            stream.write(data[:250_000])
            stream.flush()
            seen.wait(LONGEST_S)
            stream.write(data[250_000:])

    writer = threading.Thread(target=write, daemon=True)
    writer.start()
    with run_mixpose(session, "--source", f"camera={pipe}") as process:
        assert process.stdout is not None
        early = [process.stdout.readline() for _ in range(10)]  # the rest is not sent yet
        seen.set()
        assert process.stderr is not None
        # not `communicate`, which passes over what `readline` has read ahead
        rest, errors = process.stdout.read(), process.stderr.read()
    writer.join()
    assert process.returncode == 0, errors
    assert '"frame": 8,' in early[-1]
    assert len(early) + len(rest.splitlines()) == 61
    assert "60 ok" in errors


def test_camera_that_is_not_there_ends_a_run_with_one_line(
    capfd: pytest.CaptureFixture[str],
) -> None:
    session = str(CLIP.with_name("session.toml"))
    with pytest.raises(SystemExit) as left:
        main(["run", session, "--source", "camera=camera:97"])
    assert left.value.code == 3
    assert capfd.readouterr() == ("", "mixpose: camera:97: does not open\n")


def test_live_run_cannot_be_resumed(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    session = str(CLIP.with_name("session.toml"))
    output = str(tmp_path / "poses.jsonl")
    with pytest.raises(SystemExit) as left:
        main(["run", session, "--source", "camera=camera:0", "-o", output, "--resume"])
    assert left.value.code == 2
    assert capfd.readouterr().err.startswith("mixpose: --resume: sensor 'camera' is live")


def test_number_as_source_is_a_camera(tmp_path: Path) -> None:
    path = tmp_path / "session.toml"
    text = CLIP.with_name("session.toml").read_text()
    path.write_text(text.replace('source = "camera.avi"', "source = 2"))
    assert load_session(path).sensors[0].source == "camera:2"
    path.write_text(text.replace('source = "camera.avi"', "source = -1"))
    with pytest.raises(SessionError, match=r"source: found -1; allowed: .*a camera's number"):
        load_session(path)
