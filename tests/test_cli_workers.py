"""``mixpose run`` on several sessions, as people and their scripts use it: a subprocess."""

from __future__ import annotations

import json
import re
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import pytest
from command_line import LONGEST_S, command, has_written, started, wait_until
from long_recordings import RANGE_FRAMES, long_ranges

from mixpose.cli.lines import LineFile
from mixpose.cli.recording_job import Job, Running, finished, outcome_of, run_job
from mixpose.cli.request import RunRequest
from mixpose.cli.several import names_of, run_sessions, sessions_of
from mixpose.errors import SessionError

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tools"))

from cluster_trial import make_recordings
from kills import without_latency

SYNTHETIC = Path(__file__).parents[1] / "data" / "synthetic"
RANGES = SYNTHETIC / "range_profiles" / "session.toml"
CAMERAS = SYNTHETIC / "two_cameras" / "session.toml"
BODIES = SYNTHETIC / "several_bodies" / "session.toml"


def poses_of(path: Path) -> list[dict[str, Any]]:
    lines = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
    return [{k: v for k, v in line.items() if k != "latency_ms"} for line in lines]


def refusal(*sessions: Path, output: Path | None, sources: tuple[str, ...] = ()) -> str:
    """Why several sessions are not even begun."""
    request = RunRequest([], output, "jsonl", list(sources), workers=2)
    with pytest.raises(SessionError) as caught:
        run_sessions(sessions, request)
    return str(caught.value)


@pytest.fixture
def done_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """In place of the process of a recording, for what becomes of folders: poses without a line."""

    def run(_: Running, command: list[str], folder: Path, *more: object) -> int:
        (folder / "poses.jsonl").write_text("", encoding="utf-8")
        return 0

    monkeypatch.setattr(Running, "run", run)


def killed_parent(
    sessions: list[Path], folder: Path, begin: Callable[[Iterable[bool]], bool] = all
) -> list[Path]:
    """What two sessions write, where the run is killed when both or any of them have begun."""
    words = [sys.executable, "-m", "mixpose", "run", *map(str, sessions), "-o", str(folder)]
    begun = [folder / f".{name}.unfinished" / "poses.jsonl" for name in names_of(sessions)]
    with started([*words, "--workers", "2"], stderr=subprocess.DEVNULL) as process:
        wait_until(lambda: begin(has_written(path) for path in begun), by=process)
    return begun


def status_of(folder: Path) -> dict[str, Any]:
    status: dict[str, Any] = json.loads((folder / "status.json").read_text(encoding="utf-8"))
    return status


@pytest.fixture(scope="module")
def both(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """The folder of two sessions that ran side by side, and what was said."""
    folder = tmp_path_factory.mktemp("both") / "poses"
    result = command("run", BODIES, CAMERAS, "--workers", "2", "-o", folder, "--stop", "2")
    assert result.returncode == 0, result.stderr
    assert result.stdout == ""
    return folder, result.stderr


def test_several_sessions_give_the_poses_that_each_gives_alone(
    both: tuple[Path, str], tmp_path: Path
) -> None:
    folder, said = both
    names = ["several_bodies", "summary.csv", "summary.json", "two_cameras"]
    assert sorted(path.name for path in folder.iterdir()) == names
    for name in names[::3]:
        files = sorted(path.name for path in (folder / name).iterdir())
        assert files == ["log.txt", "poses.jsonl", "status.json"]
    assert f"mixpose: {CAMERAS}: 2 frames: 2 ok" in said
    assert said.endswith(f"2 recordings: 2 done -> {folder / 'summary.csv'}\n")
    alone = tmp_path / "alone.jsonl"
    assert command("run", CAMERAS, "-o", alone, "--stop", "2").returncode == 0
    assert poses_of(folder / "two_cameras" / "poses.jsonl") == poses_of(alone)
    status = status_of(folder / "two_cameras")
    assert (status["state"], status["frames"]) == ("done", {"ok": 2})

    before = (folder / "two_cameras" / "poses.jsonl").stat().st_mtime_ns
    again = command("run", BODIES, CAMERAS, "-o", folder, "--stop", "2")
    assert "2 of 2 recordings are done already" in again.stderr
    assert (folder / "two_cameras" / "poses.jsonl").stat().st_mtime_ns == before


def test_poses_of_several_bodies_are_counted_beside_those_of_one(
    both: tuple[Path, str], tmp_path: Path
) -> None:
    folder, said = both
    alone = command("run", BODIES, "-o", tmp_path / "alone.jsonl", "--stop", "2")
    told = "mixpose: 2 frames of 4 bodies: 8 ok"
    assert alone.stderr.splitlines()[-1].startswith(told)
    assert told.replace("mixpose:", f"mixpose: {BODIES}:") in said.splitlines()
    rows = (folder / "summary.csv").read_text(encoding="utf-8").splitlines()[1:]
    assert [row.split(",")[:5] for row in rows] == [
        ["several_bodies", "done", "8", "0", "0"], ["two_cameras", "done", "2", "0", "0"],
    ]  # fmt: skip
    status = status_of(folder / "several_bodies")
    assert (status["frames"], status["bodies"]) == ({"ok": 8}, 4)


def test_a_session_that_fails_is_named_and_the_same_command_does_what_is_left(
    tmp_path: Path,
) -> None:
    spoilt, missing = tmp_path / "spoilt.toml", tmp_path / "missing.toml"
    text = RANGES.read_text(encoding="utf-8")
    spoilt.write_text(text, encoding="utf-8")  # its profiles are not in this folder
    listed = tmp_path / "all.txt"
    listed.write_text(f"# of today\n{missing}\nspoilt.toml\n\n{RANGES}\n", encoding="utf-8")
    folder = tmp_path / "poses"
    words = ("run", listed, "--workers", "2", "-o", folder, "--stop", "2")
    result = command(*words)
    assert result.returncode == 3  # a session that is wrong is 2, a recording that is missing 3
    assert f"mixpose: {missing}: no such file" in result.stderr
    assert f"mixpose: {spoilt}: " in result.stderr
    assert "3 recordings: 1 done, 2 failed" in result.stderr
    assert status_of(folder / "range_profiles")["state"] == "done"
    failed = status_of(folder / "spoilt")
    assert (failed["state"], failed["exit_status"]) == ("failed", 3)
    assert "front.npy: no such file" in failed["reason"]
    assert "front.npy: no such file" in (folder / "spoilt" / "log.txt").read_text(encoding="utf-8")
    summary = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
    assert (summary["recordings"], summary["done"], summary["failed"]) == (3, 1, 2)
    table = (folder / "summary.csv").read_text(encoding="utf-8").splitlines()
    assert table[0] == "name,state,ok,ambiguous,lost,warnings,seconds,reason"
    assert [line.split(",")[:3] for line in table[1:]] == [
        ["missing", "failed", "0"], ["spoilt", "failed", "0"], ["range_profiles", "done", "2"],
    ]  # fmt: skip

    for name in ("front", "side", "top"):
        shutil.copy(RANGES.parent / f"{name}.npy", tmp_path)
    again = command(*words)
    assert "1 of 3 recordings are done already" in again.stderr
    assert again.returncode == 2
    assert status_of(folder / "spoilt")["state"] == "done"
    assert not [path.name for path in folder.iterdir() if path.name.startswith(".")]


def test_sessions_of_one_name_are_told_apart_by_their_folders() -> None:
    sessions = ["/d/a/same.toml", "/d/b/same.toml", "/d/c/session.toml", "/e/c/session.toml"]
    assert names_of([Path(s) for s in sessions]) == ["a-same", "b-same", "d-c", "e-c"]
    assert names_of([Path("/d/one.toml"), Path("/d/One.toml")]) == ["d-one-0", "d-One-1"]


def test_a_pattern_names_sessions_and_one_that_matches_none_is_told(tmp_path: Path) -> None:
    found = sessions_of([str(SYNTHETIC / "*" / "session.toml"), str(RANGES)])
    names = [path.parent.name for path in found]
    assert {"one_camera_video", "parallel_beams", "range_profiles", "two_cameras"} <= {*names}
    assert len({*names}) == len(names)  # one of them was named twice
    with pytest.raises(SessionError, match="matches no session file"):
        sessions_of([str(tmp_path / "*.toml")])
    (tmp_path / "empty.txt").write_text("# nothing\n", encoding="utf-8")
    with pytest.raises(SessionError, match="names no session"):
        sessions_of([str(tmp_path / "empty.txt")])


@pytest.mark.usefixtures("done_at_once")
def test_a_folder_that_another_worker_made_whole_stays(tmp_path: Path) -> None:
    job = Job("beams", str(CAMERAS), "ab", ("--stop=1",), "0", str(tmp_path), "poses.jsonl", True)
    first, second = run_job(job), run_job(replace(job, mixpose="1"))
    assert first.state == second.state == "done"
    assert finished(job) is None  # of another version: done again
    assert finished(replace(job, mixpose="1")) == second
    made = (tmp_path / "beams" / "poses.jsonl").stat().st_mtime_ns
    assert run_job(replace(job, mixpose="1")) == second
    assert (tmp_path / "beams" / "poses.jsonl").stat().st_mtime_ns == made
    assert [path.name for path in tmp_path.iterdir()] == ["beams"]


def test_a_worker_that_does_not_see_the_folder_says_so(tmp_path: Path) -> None:
    job = Job("no", str(tmp_path / "no.toml"), "", (), "0", str(tmp_path), "poses.jsonl", True)
    outcome = run_job(job)
    assert outcome.state == "failed"
    assert "a folder that all workers see under the same name" in str(outcome.reason)


@pytest.mark.skipif(sys.platform == "win32", reason="processes end otherwise there")
def test_the_children_of_a_killed_parent_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("mixpose.cli.lines.PATIENCE_S", LONGEST_S)
    begun = killed_parent(long_ranges(tmp_path, "ab"), tmp_path / "poses")
    # whoever still writes holds the lock; when nobody does, the files stay as they are
    for path in begun:
        LineFile(path, afresh=False).close()
    sizes = [path.stat().st_size for path in begun]
    time.sleep(0.3)
    assert sizes == [path.stat().st_size for path in begun]
    assert all(size > 3000 for size in sizes)
    for path in begun:
        frames = [pose["frame"] for pose in poses_of(path)[1:]]
        assert frames == list(range(len(frames)))


@pytest.mark.skipif(sys.platform == "win32", reason="processes end otherwise there")
def test_the_command_of_a_killed_parent_given_again_at_once_writes_each_line_once(
    tmp_path: Path,
) -> None:
    sessions, folder = make_recordings(tmp_path, 2, 20), tmp_path / "poses"
    begun = killed_parent(sessions, folder, any)
    assert any(path.exists() for path in begun)  # it was killed midway
    again = command("run", *sessions, "-o", folder, "--workers", "2")
    assert again.returncode == 0, again.stderr
    alone = tmp_path / "alone.jsonl"
    for session in sessions:
        assert command("run", session, "-o", alone).returncode == 0
        poses = folder / session.parent.name / "poses.jsonl"
        assert len(poses_of(poses)) == 21  # with the header
        assert without_latency(poses) == without_latency(alone)


@pytest.mark.skipif(sys.platform == "win32", reason="nothing is locked there")
def test_a_second_run_into_the_folder_leaves_alone_what_the_first_one_does(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("mixpose.cli.lines.PATIENCE_S", 0.0)
    sessions, folder = long_ranges(tmp_path, "ab"), tmp_path / "poses"
    words = [sys.executable, "-m", "mixpose", "run", *map(str, sessions), "-o", str(folder)]
    begun = folder / ".a.unfinished" / "poses.jsonl"
    with started(words, stderr=subprocess.DEVNULL) as process:
        wait_until(lambda: has_written(begun), by=process)
        request = RunRequest([], folder, "jsonl")
        assert run_sessions(sessions[:1], request) == 2
        assert begun.exists()
        assert not (folder / "a").exists()
    summary = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
    assert f"-o {folder / 'a'}: another run is writing there" in summary["results"][0]["reason"]


@pytest.mark.usefixtures("done_at_once")
def test_an_unfinished_recording_stays_when_one_whose_name_begins_its_own_is_done(
    tmp_path: Path,
) -> None:
    begun = tmp_path / ".range_profiles.1.unfinished" / "poses.jsonl"
    left = tmp_path / f".range_profiles.{'0' * 32}"  # by a worker that was killed
    for folder in (begun.parent, left):
        folder.mkdir()
    begun.touch()
    request = RunRequest([], tmp_path, "jsonl", stop=1)
    assert run_sessions([RANGES], request) == 0
    assert begun.exists()
    assert not left.exists()


@pytest.mark.usefixtures("done_at_once")
def test_recordings_of_another_place_and_the_same_name_are_neither_taken_nor_replaced(
    tmp_path: Path,
) -> None:
    days = [tmp_path / day / "ranges" / "session.toml" for day in ("monday", "tuesday")]
    for session in days:
        shutil.copytree(RANGES.parent, session.parent)
    folder = tmp_path / "poses"
    request = RunRequest([], folder, "jsonl", stop=1)
    assert run_sessions(days[:1], request) == 0
    told = refusal(days[1], output=folder)
    assert told.startswith(f"-o {folder}: ranges in it is of {days[0]}, not of {days[1]}")
    (folder / "ranges").rename(folder / ".ranges.unfinished")  # as after an interrupt
    assert f"{folder}: .ranges.unfinished in it is of {days[0]}" in refusal(days[1], output=folder)
    (folder / ".ranges.unfinished").rename(folder / "ranges")
    assert status_of(folder / "ranges")["session"] == str(days[0])
    roundabout = tmp_path / "poses" / ".." / "monday" / "ranges" / "session.toml"
    assert run_sessions([roundabout], request) == 0


def test_options_that_serve_one_session_only_are_refused(tmp_path: Path) -> None:
    assert "-o DIR: missing" in refusal(RANGES, CAMERAS, output=None)
    file = tmp_path / "poses.jsonl"
    file.touch()
    assert f"{file}: is a file" in refusal(RANGES, CAMERAS, output=file)
    nowhere = tmp_path / "no" / "poses"
    assert f"{nowhere}: cannot be made: No such file" in refusal(RANGES, CAMERAS, output=nowhere)
    named = refusal(RANGES, CAMERAS, output=tmp_path, sources=("front=x.npy",))
    assert "--source front=x.npy" in named
    assert "2 sessions" in named


def test_several_sessions_cannot_be_paused(tmp_path: Path) -> None:
    request = RunRequest([], tmp_path, "jsonl", pause=True, workers=2)
    found = re.escape(f"--pause: found 2 sessions ({RANGES}, {CAMERAS}), allowed with one only")
    with pytest.raises(SessionError, match=f"^{found}$"):
        run_sessions((RANGES, CAMERAS), request)


def test_workers_of_a_single_session_are_told_to_have_nothing_to_do() -> None:
    result = command("run", RANGES, "--workers", "2", "--stop", "1")
    assert result.returncode == 0
    assert "warning: --workers 2: one session" in result.stderr
    assert len(result.stdout.splitlines()) == 2


@pytest.mark.skipif(sys.platform == "win32", reason="interrupts are sent otherwise there")
@pytest.mark.parametrize(
    ("request_to_end", "ignoring"),
    [
        (signal.SIGINT, ""),
        (signal.SIGTERM, ""),
        (signal.SIGTERM, "trap '' INT;"),  # as what a script starts in the background
    ],
)
def test_an_interrupt_ends_all_sessions_and_keeps_their_poses(
    tmp_path: Path, request_to_end: signal.Signals, ignoring: str
) -> None:
    sessions = long_ranges(tmp_path, "abc")  # the third one waits its turn
    folder = tmp_path / "poses"
    run = [sys.executable, "-m", "mixpose", "run", *map(str, sessions), "-o", str(folder)]
    words = ["sh", "-c", f'{ignoring} exec "$@"', "sh", *run, "--workers", "2"]
    begun = [folder / f".{name}.unfinished" / "poses.jsonl" for name in "ab"]
    with started(words, stderr=subprocess.PIPE) as process:
        wait_until(lambda: all(map(has_written, begun)), by=process)
        process.send_signal(request_to_end)
        _, stderr = process.communicate(timeout=LONGEST_S)
    assert process.returncode == 130
    assert stderr.splitlines()[-1] == "mixpose: interrupted; everything so far is written"
    for path in begun:
        assert 1 < len(poses_of(path)) <= RANGE_FRAMES
    assert not [path for path in folder.iterdir() if path.name[:2] in ("c", ".c")]


def job_of(folder: Path, *options: str) -> Job:
    return Job("ranges", str(RANGES), "ab", options, "0", str(folder), "poses.jsonl")


def begun(folder: Path, job: Job) -> Path:
    """What an interrupted run of a job left: its first four frames."""
    part = folder / ".ranges.unfinished"
    part.mkdir(parents=True)
    to = part / "poses.jsonl"
    assert command("run", RANGES, "-o", to, *job.options, "--stop", "4").returncode == 0
    status = asdict(outcome_of(job, "interrupted", 130))
    (part / "status.json").write_text(json.dumps(status), encoding="utf-8")
    return part


@pytest.mark.parametrize(
    "changed",
    [
        {"options": ("--start=2",)},
        {"session_sha256": "cd"},
        {"mixpose": "1"},
    ],
)
def test_what_was_begun_otherwise_is_begun_anew(tmp_path: Path, changed: dict[str, Any]) -> None:
    begun(tmp_path, replace(job_of(tmp_path), **changed))
    outcome = run_job(job_of(tmp_path, "--stop=6"))
    assert outcome.state == "done", outcome.reason
    assert [line["frame"] for line in poses_of(tmp_path / "ranges" / "poses.jsonl")[1:]] == [
        *range(6)
    ]
    assert sum(outcome.frames.values()) == 6


def test_a_recording_that_goes_on_counts_the_poses_of_all_its_runs(tmp_path: Path) -> None:
    job = job_of(tmp_path)
    part = begun(tmp_path, job)
    (part / "log.txt").write_text("mixpose: warning: of the first run\n", encoding="utf-8")
    outcome = run_job(job)
    assert outcome.state == "done", outcome.reason
    poses = poses_of(tmp_path / "ranges" / "poses.jsonl")[1:]
    assert outcome.frames == Counter(line["status"] for line in poses)
    assert len({line["frame"] for line in poses}) == len(poses) > 4
    assert "of the first run" in (tmp_path / "ranges" / "log.txt").read_text(encoding="utf-8")


def test_poses_stay_where_a_run_with_other_options_fails(tmp_path: Path) -> None:
    assert run_job(job_of(tmp_path, "--stop=3")).state == "done"
    before = (tmp_path / "ranges" / "poses.jsonl").read_bytes()
    failed = run_job(replace(job_of(tmp_path, "--stop=4"), session=str(RANGES.parent)))
    assert failed.state == "failed"
    assert str(failed.reason).endswith("; ranges is as it was before")
    assert (tmp_path / "ranges" / "poses.jsonl").read_bytes() == before
    assert status_of(tmp_path / "ranges")["state"] == "done"


def test_a_run_that_failed_is_not_gone_on_with(tmp_path: Path) -> None:
    job = job_of(tmp_path)
    part = begun(tmp_path, job)
    (part / "sub").mkdir()
    failed = json.dumps(asdict(outcome_of(job, "failed", 3)))
    (part / "status.json").write_text(failed, encoding="utf-8")
    stamp = (part / "poses.jsonl").stat().st_mtime_ns
    assert run_job(job).state == "done"
    assert (tmp_path / "ranges" / "poses.jsonl").stat().st_mtime_ns > stamp
    # written at once, and not from the fourth frame on
    (line,) = (tmp_path / "ranges" / "log.txt").read_text(encoding="utf-8").splitlines()[-1:]
    assert line.startswith("mixpose: 20 frames: ")


def test_poses_that_were_damaged_meanwhile_fail_in_one_line(tmp_path: Path) -> None:
    job = job_of(tmp_path)
    poses = begun(tmp_path, job) / "poses.jsonl"
    lines = poses.read_bytes().splitlines(keepends=True)
    poses.write_bytes(b"".join([*lines[:2], b"\0" * 40 + b"\n", *lines[3:]]))
    outcome = run_job(job)
    assert outcome.state == "failed"
    assert str(outcome.reason).startswith("poses.jsonl:3: not JSON")
