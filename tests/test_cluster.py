"""Many recordings on a cluster of ``dask.distributed``, a worker of which is killed."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from command_line import command

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tools"))

from cluster_trial import done_in, make_recordings, mixpose, run_and_kill
from kills import without_latency

pytest.importorskip("distributed")


@pytest.mark.skipif(sys.platform == "win32", reason="processes are killed otherwise there")
def test_a_killed_worker_costs_no_recording_and_doubles_none(tmp_path: Path) -> None:
    sessions = make_recordings(tmp_path, 3, 8)
    status, midway = run_and_kill(sessions, tmp_path, 2)
    poses = tmp_path / "poses"
    assert status == 0
    assert midway < 3
    names = [session.parent.name for session in sessions]
    assert done_in(poses) == names
    assert command("run", sessions[2], "-o", tmp_path / "alone.jsonl").returncode == 0
    alone = without_latency(tmp_path / "alone.jsonl")
    assert without_latency(poses / names[2] / "poses.jsonl") == alone
    # nothing half done is left
    assert sorted(path.name for path in poses.iterdir()) == [*names, "summary.csv", "summary.json"]
    again = command("run", *sessions, "-o", poses, "--scheduler", "local", "--workers", "2")
    assert again.returncode == 0
    assert "3 of 3 recordings are done already" in again.stderr


def test_a_scheduler_that_does_not_answer_is_one_line(tmp_path: Path) -> None:
    sessions = [tmp_path / "a.toml", tmp_path / "b.toml"]
    words = mixpose("run", *sessions, "-o", tmp_path / "poses", "--scheduler", "nonsense://x:1")
    result = subprocess.run(words, capture_output=True, text=True, check=False)
    assert result.returncode == 2
    assert result.stderr.startswith("mixpose: --scheduler nonsense://x:1: no scheduler answers")
    assert len(result.stderr.splitlines()) == 1
