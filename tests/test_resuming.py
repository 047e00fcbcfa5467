"""A run that is killed, cut off by a full disk or disturbed by another, and goes on: same bytes."""

from __future__ import annotations

import errno
import json
import os
import random
import re
import shutil
import signal
import socket
import subprocess
import sys
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from mixpose.cli import lines, main
from mixpose.cli.continuation import Note
from mixpose.cli.lines import LineFile, note_path
from mixpose.encoding import decode, encode
from mixpose.errors import SessionError
from mixpose.runner import Memory
from mixpose.whole_files import appearing_whole

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tools"))

from kills import one_round, without_latency

from mixpose.records import Floats

SYNTHETIC = Path(__file__).parents[1] / "data" / "synthetic"
RANGES = SYNTHETIC / "range_profiles" / "session.toml"
VIDEO = SYNTHETIC / "one_camera_video" / "session.toml"

needs_posix = pytest.mark.skipif(sys.platform == "win32", reason="limits of files are POSIX's")


def command(*arguments: str | Path) -> int:
    with pytest.raises(SystemExit) as ended:
        main([str(argument) for argument in arguments])
    return int(ended.value.code or 0)


@pytest.fixture(scope="module")
def ranges(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The poses of an undisturbed run of `RANGES`."""
    path = tmp_path_factory.mktemp("undisturbed") / "whole.jsonl"
    assert command("run", RANGES, "-o", path) == 0
    return path


@pytest.mark.parametrize(
    "name", ["parallel_beams", "range_profiles", "two_cameras", "several_bodies", "real_room"]
)
def test_a_run_in_pieces_writes_the_bytes_of_a_run_at_once(name: str, tmp_path: Path) -> None:
    shutil.copytree(SYNTHETIC / name, tmp_path, dirs_exist_ok=True)
    session = tmp_path / "session.toml"
    for path in tmp_path.glob("*[0-9][0-9].[jp][pn]g"):
        if int(path.stem[-2:]) >= 8:
            path.unlink()
    for path in tmp_path.glob("*.npy"):
        np.save(path, np.load(path)[:8])
    whole, parts = tmp_path / "whole.jsonl", tmp_path / "parts.jsonl"
    assert command("run", session, "-o", whole) == 0
    assert command("run", session, "-o", parts, "--stop", "4") == 0
    note = decode(Note, json.loads(note_path(parts).read_bytes()))  # or all is estimated again
    assert note.frame == 3
    assert command("run", session, "-o", parts, "--stop", "5", "--resume") == 0
    assert command("run", session, "-o", parts, "--resume") == 0
    assert without_latency(parts) == without_latency(whole)
    # nothing is left to go on with, so nothing is left beside the poses
    assert not note_path(parts).exists()


@needs_posix
def test_a_run_killed_at_random_moments_writes_the_bytes_of_an_undisturbed_one(
    tmp_path: Path,
) -> None:
    assert command("run", VIDEO, "-o", tmp_path / "whole.jsonl") == 0
    rng, kills = random.Random(3), 0
    for _ in range(20):  # where a run is done before it is killed, the next ones make up for it
        more, same = one_round(VIDEO, tmp_path, rng, 3 - kills)
        assert same
        kills += more
        if kills == 3:
            break
    assert kills == 3


def test_without_what_the_run_knew_its_frames_are_estimated_again(
    ranges: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    parts = tmp_path / "parts.jsonl"
    text = ranges.read_text(encoding="utf-8").splitlines(keepends=True)
    parts.write_text("".join(text[:4]) + text[4][:50], encoding="utf-8")
    assert command("run", RANGES, "-o", parts, "--resume") == 0
    assert "frames up to 2 are estimated again and left as they are" in capsys.readouterr().err
    assert without_latency(parts) == without_latency(ranges)
    assert parts.read_text(encoding="utf-8").splitlines(keepends=True)[:4] == text[:4]


def test_frames_that_are_estimated_again_are_not_published_and_drawn_again(tmp_path: Path) -> None:
    session = SYNTHETIC / "several_bodies" / "session.toml"
    poses, drawn = tmp_path / "poses.jsonl", tmp_path / "drawn"
    assert command("run", session, "-o", poses, "--stop", "2") == 0
    note_path(poses).unlink()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiving:
        receiving.bind(("127.0.0.1", 0))
        url = f"udp://127.0.0.1:{receiving.getsockname()[1]}"
        words = ("--resume", "--publish", url, "--overlay", drawn)
        assert command("run", session, "-o", poses, "--stop", "3", *words) == 0
        receiving.setblocking(False)
        received = []
        with suppress(BlockingIOError):
            while True:
                received.append(json.loads(receiving.recv(65536)))
    frames = [line["frame"] for line in received if line["type"] == "pose"]
    assert frames == [2, 2, 2, 2]
    assert [path.name for path in drawn.iterdir()] == ["overlay_000002.png"]
    written = poses.read_text(encoding="utf-8").splitlines()[1:]
    assert [json.loads(line)["frame"] for line in written] == [0] * 4 + [1] * 4 + [2] * 4


def test_what_another_run_knew_is_not_believed(ranges: Path, tmp_path: Path) -> None:
    parts = tmp_path / "parts.jsonl"
    assert command("run", RANGES, "-o", parts, "--stop", "4") == 0
    lines_there = parts.read_bytes().replace(b'"latency_ms": ', b'"latency_ms": 1')
    parts.write_bytes(lines_there)  # no longer what the note was about
    assert command("run", RANGES, "-o", parts, "--resume") == 0
    assert without_latency(parts) == without_latency(ranges)


@needs_posix
def test_two_runs_never_write_to_one_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lines, "PATIENCE_S", 0.0)
    first = LineFile(tmp_path / "poses.jsonl")
    with pytest.raises(SessionError, match="another run is writing there"):
        LineFile(tmp_path / "poses.jsonl")
    first.close()
    LineFile(tmp_path / "poses.jsonl").close()


def limited(size: int, *arguments: str | Path) -> subprocess.CompletedProcess[str]:
    """A command whose files cannot grow beyond a size, as on a full disk."""
    import resource

    def limit() -> None:
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, size))

    return subprocess.run(
        [sys.executable, "-B", "-m", "mixpose", *map(str, arguments)],  # no module compiled in half
        capture_output=True, text=True, check=False, preexec_fn=limit,
    )  # fmt: skip


@needs_posix
def test_on_a_full_disk_the_last_line_is_whole_and_the_file_is_named(
    ranges: Path, tmp_path: Path
) -> None:
    poses = tmp_path / "poses.jsonl"
    result = limited(6000, "run", RANGES, "-o", poses)
    assert result.returncode == 2
    assert result.stderr == (
        f"mixpose: -o {poses}: cannot be written: File too large; the lines before are whole\n"
    )
    content = poses.read_text(encoding="utf-8")
    assert content.endswith("}\n")
    assert 1 < len([json.loads(line) for line in content.splitlines()]) < 11
    assert command("run", RANGES, "-o", poses, "--resume") == 0
    assert without_latency(poses) == without_latency(ranges)


@needs_posix
def test_a_note_that_finds_no_room_stops_no_run(ranges: Path, tmp_path: Path) -> None:
    poses = tmp_path / "poses.jsonl"
    note_path(poses).mkdir()  # nothing can be put there, as on a disk that the note would fill
    assert command("run", RANGES, "-o", poses, "--stop", "5") == 0
    undisturbed = without_latency(ranges)
    assert without_latency(poses) == b"".join(undisturbed.splitlines(keepends=True)[:6])
    assert command("run", RANGES, "-o", poses, "--resume") == 0
    assert without_latency(poses) == undisturbed


def test_a_full_disk_under_a_file_that_appears_whole_is_told_with_its_name(tmp_path: Path) -> None:
    def write() -> None:
        with appearing_whole(tmp_path / "summary.json") as part:
            part.write_text("half", encoding="ascii")
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))  # as a write itself has it

    with pytest.raises(OSError, match=r"No space left on device: .*summary\.json"):
        write()
    assert list(tmp_path.iterdir()) == []


@needs_posix
def test_a_file_that_appears_whole_keeps_its_mode_and_links_to_it(tmp_path: Path) -> None:
    file, link = tmp_path / "session.toml", tmp_path / "link.toml"
    file.write_text("old", encoding="ascii")
    file.chmod(0o640)
    link.symlink_to(file)
    with appearing_whole(link) as part:
        part.write_text("new", encoding="ascii")
    assert link.is_symlink()
    assert file.read_text(encoding="ascii") == "new"
    assert file.stat().st_mode & 0o777 == 0o640
    assert {path.name for path in tmp_path.iterdir()} == {"session.toml", "link.toml"}


def test_poses_that_begin_elsewhere_are_not_gone_on_with(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    poses, whole = tmp_path / "poses.jsonl", tmp_path / "whole.jsonl"
    assert command("run", RANGES, "-o", whole, "--start", "4") == 0
    assert command("run", RANGES, "-o", poses, "--start", "4", "--stop", "8") == 0
    assert command("run", RANGES, "-o", poses, "--resume") == 2
    message = f"--resume: {poses} begins with frame 4, this run with 0; leave out --resume"
    assert message in capfd.readouterr().err
    assert command("run", RANGES, "-o", poses, "--start", "4", "--resume") == 0
    assert without_latency(poses) == without_latency(whole)


@needs_posix
def test_a_pipe_is_not_gone_on_with(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    pipe, poses = tmp_path / "camera", tmp_path / "poses.jsonl"
    os.mkfifo(pipe)
    assert command("run", VIDEO, "-o", poses, "--stop", "2") == 0
    assert command("run", VIDEO, "-o", poses, "--resume", "--source", f"camera={pipe}") == 2
    assert "sensor 'camera' is live, what it missed is gone" in capfd.readouterr().err


@needs_posix
def test_on_a_full_disk_a_converted_file_stays_as_it_was(ranges: Path, tmp_path: Path) -> None:
    poses, table = shutil.copy(ranges, tmp_path / "poses.jsonl"), tmp_path / "poses.csv"
    assert command("convert", poses, "-o", table) == 0
    before = table.read_bytes()
    result = limited(700, "convert", poses, "-o", table)
    assert result.returncode == 2
    assert result.stderr.startswith(f"mixpose: -o {table}: cannot be written: File too large")
    assert len(result.stderr.splitlines()) == 1
    assert table.read_bytes() == before
    assert sorted(path.name for path in tmp_path.iterdir()) == ["poses.csv", "poses.jsonl"]


@needs_posix
def test_an_overlay_that_a_full_disk_cuts_short_is_no_video_and_stands_in_no_ones_way(
    tmp_path: Path,
) -> None:
    video = tmp_path / "seen.avi"
    result = limited(30_000, "run", VIDEO, "-o", tmp_path / "p.csv", "--overlay", video)
    assert result.returncode == 2
    assert re.match(rf"mixpose: --overlay {video}: .* (disk full|File too large)", result.stderr)
    assert len(result.stderr.splitlines()) == 1
    assert not video.exists()
    video.with_name(".seen.part.avi").write_bytes(b"RIFF as a kill leaves it")
    again = command("run", VIDEO, "-o", tmp_path / "p.csv", "--overlay", video, "--stop", "2")
    assert again == 0
    assert [path.name for path in tmp_path.iterdir() if "part" in path.name] == []


@dataclass(frozen=True)
class Inner:
    values: Floats
    weight: float | None = None


@dataclass(frozen=True)
class Outer:
    parts: tuple[Inner, ...]
    by_name: dict[str, Inner]
    count: int = 0


def test_records_come_back_bit_by_bit() -> None:
    rng = np.random.default_rng(0)
    parts = (Inner(rng.normal(size=(2, 3)).T, 0.1 + 0.2), Inner(np.empty((0, 6))))
    record = Outer(parts, {"ä": Inner(np.array([np.nan, np.inf, -0.0, 5e-324]))}, 10**30)
    found = decode(Outer, json.loads(json.dumps(encode(record))))
    assert found.count == record.count
    assert found.parts[0].weight == record.parts[0].weight
    pairs = [*zip(found.parts, parts, strict=True), (found.by_name["ä"], record.by_name["ä"])]
    for one, other in pairs:
        assert one.values.tobytes() == other.values.tobytes()
        assert one.values.flags.f_contiguous == other.values.flags.f_contiguous
    wrongs: list[object] = [
        [],
        {"is": "Path"},
        {"is": "Inner", "values": []},
        {"is": "Outer", "a": 1},
    ]
    for wrong in wrongs:
        with pytest.raises(ValueError, match="no Memory"):
            decode(Memory, wrong)
