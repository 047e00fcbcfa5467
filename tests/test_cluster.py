"""Many recordings on a cluster of ``dask.distributed``, a worker of which is killed."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tools"))

from cluster_trial import done_in, make_recordings, mixpose, run_and_kill, same_alone

pytest.importorskip("distributed")


@pytest.mark.skipif(sys.platform == "win32", reason="processes are killed otherwise there")
def test_a_killed_worker_costs_no_recording_and_doubles_none(tmp_path: Path) -> None:
    sessions = make_recordings(tmp_path, 4, 8)
    status, midway = run_and_kill(sessions, tmp_path, 2)
    poses = tmp_path / "poses"
    assert status == 0
    assert midway < 4
    names = [session.parent.name for session in sessions]
    assert done_in(poses) == names
    assert same_alone(sessions[2], poses / names[2] / "poses.jsonl", tmp_path)
    # nothing half done is left
    assert sorted(path.name for path in poses.iterdir()) == [*names, "summary.csv", "summary.json"]
    again = subprocess.run(
        mixpose("run", *sessions, "-o", poses, "--scheduler", "local", "--workers", "2"),
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert again.returncode == 0
    assert "4 of 4 recordings are done already" in again.stderr


def test_a_scheduler_that_does_not_answer_is_one_line(tmp_path: Path) -> None:
    sessions = [tmp_path / "a.toml", tmp_path / "b.toml"]
    command = mixpose("run", *sessions, "-o", tmp_path / "poses", "--scheduler", "nonsense://x:1")
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    assert result.returncode == 2
    assert result.stderr.startswith("mixpose: --scheduler nonsense://x:1: no scheduler answers")
    assert len(result.stderr.splitlines()) == 1
