"""``mixpose run`` on several sessions, as people and their scripts use it: a subprocess."""

from __future__ import annotations

import json
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from mixpose.cli.request import RunRequest
from mixpose.cli.several import run_sessions
from mixpose.errors import SessionError
from mixpose.selection import Selection

SYNTHETIC = Path(__file__).parents[1] / "data" / "synthetic"
RANGES = SYNTHETIC / "range_profiles" / "session.toml"
BEAMS = SYNTHETIC / "parallel_beams" / "session.toml"


def mixpose(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "mixpose", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def poses_of(path: Path) -> list[dict[str, Any]]:
    lines = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
    return [{k: v for k, v in line.items() if k != "latency_ms"} for line in lines]


def refusal(*sessions: Path, output: Path | None, sources: tuple[str, ...] = ()) -> str:
    """Why several sessions are not even begun."""
    request = RunRequest(output, "jsonl", sources, Selection(), resume=False)
    with pytest.raises(SessionError) as caught:
        run_sessions(sessions, request, workers=2)
    return str(caught.value)


def test_several_sessions_give_the_poses_that_each_gives_alone(tmp_path: Path) -> None:
    folder = tmp_path / "poses"
    result = mixpose("run", RANGES, BEAMS, "--workers", "2", "-o", folder, "--stop", "3")
    assert result.returncode == 0, result.stderr
    assert result.stdout == ""
    assert sorted(path.name for path in folder.iterdir()) == [
        "parallel_beams.jsonl", "range_profiles.jsonl",
    ]  # fmt: skip
    assert f"mixpose: {RANGES}: 3 frames: 3 ok" in result.stderr
    alone = tmp_path / "alone.jsonl"
    assert mixpose("run", BEAMS, "-o", alone, "--stop", "3").returncode == 0
    assert poses_of(folder / "parallel_beams.jsonl") == poses_of(alone)

    resumed = mixpose("run", RANGES, BEAMS, "-o", folder, "--stop", "5", "--resume")
    assert resumed.returncode == 0, resumed.stderr
    for name in ("range_profiles", "parallel_beams"):
        frames = [pose["frame"] for pose in poses_of(folder / f"{name}.jsonl")[1:]]
        assert frames == [0, 1, 2, 3, 4]


def test_a_session_that_fails_is_named_and_the_others_are_done(tmp_path: Path) -> None:
    spoilt = tmp_path / "spoilt.toml"
    text = RANGES.read_text(encoding="utf-8")
    spoilt.write_text(text, encoding="utf-8")  # its profiles are not in this folder
    missing = tmp_path / "missing.toml"
    folder = tmp_path / "poses"
    result = mixpose("run", missing, spoilt, RANGES, "--workers", "2", "-o", folder, "--stop", "2")
    assert result.returncode == 3  # a session that is wrong is 2, a recording that is missing 3
    lines = sorted(result.stderr.splitlines())
    assert len(lines) == 3, result.stderr
    assert f"mixpose: {missing}: no such file" in result.stderr
    assert f"mixpose: {spoilt}: " in result.stderr
    assert [path.name for path in folder.iterdir()] == ["range_profiles.jsonl"]


def test_sessions_whose_poses_would_share_a_file_are_refused(tmp_path: Path) -> None:
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        shutil.copy(RANGES, tmp_path / name / "same.toml")
    first, second = tmp_path / "a" / "same.toml", tmp_path / "b" / "same.toml"
    folder = tmp_path / "poses"
    message = refusal(first, second, output=folder)
    for words in (str(first), str(second), str(folder / "same.jsonl"), "rename"):
        assert words in message
    assert not folder.exists()


def test_options_that_serve_one_session_only_are_refused(tmp_path: Path) -> None:
    assert "-o DIR: missing" in refusal(RANGES, BEAMS, output=None)
    file = tmp_path / "poses.jsonl"
    file.touch()
    assert f"{file}: is a file" in refusal(RANGES, BEAMS, output=file)
    nowhere = tmp_path / "no" / "poses"
    assert f"{nowhere}: cannot be made: No such file" in refusal(RANGES, BEAMS, output=nowhere)
    named = refusal(RANGES, BEAMS, output=tmp_path, sources=("front=x.npy",))
    assert "--source front=x.npy" in named
    assert "2 sessions" in named


def test_workers_of_a_single_session_are_told_to_have_nothing_to_do() -> None:
    result = mixpose("run", RANGES, "--workers", "2", "--stop", "1")
    assert result.returncode == 0
    assert "warning: --workers 2: one session" in result.stderr
    assert len(result.stdout.splitlines()) == 2


@pytest.mark.skipif(sys.platform == "win32", reason="interrupts are sent otherwise there")
@pytest.mark.parametrize("request_to_end", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupt_ends_all_sessions_and_keeps_their_poses(
    tmp_path: Path, request_to_end: signal.Signals
) -> None:
    text = "\n".join(
        line
        for line in RANGES.read_text(encoding="utf-8").replace(".npy", ".csv").splitlines()
        if not line.startswith(("range_min", "bin_size"))
    )
    rows = "".join(f"{k},950\n{k},1010\n{k},1080\n" for k in range(5000))
    for name in ("front", "side", "top"):
        (tmp_path / f"{name}.csv").write_text("frame,range\n" + rows, encoding="utf-8")
    sessions = [tmp_path / f"{name}.toml" for name in "abc"]  # the third one waits its turn
    for session in sessions:
        session.write_text(text, encoding="utf-8")
    folder = tmp_path / "poses"
    command = [sys.executable, "-m", "mixpose", "run", *map(str, sessions), "-o", str(folder)]
    process = subprocess.Popen([*command, "--workers", "2"], stderr=subprocess.PIPE, text=True)
    begun = [folder / "a.jsonl", folder / "b.jsonl"]
    deadline = time.monotonic() + 30
    while time.monotonic() < deadline:
        if all(path.exists() and path.stat().st_size > 3000 for path in begun):
            break
        time.sleep(0.05)
    process.send_signal(request_to_end)
    _, stderr = process.communicate(timeout=30)
    assert process.returncode == 130
    said = "interrupted; everything so far is written\n"
    expected = sorted(["mixpose: " + said, *(f"mixpose: {s}: {said}" for s in sessions[:2])])
    assert sorted(stderr.splitlines(keepends=True)) == expected
    for path in begun:
        assert len(poses_of(path)) > 1
    assert not (folder / "c.jsonl").exists()
