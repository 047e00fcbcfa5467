"""Times of frames from a table or a rate."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mixpose.cli.app import CheckRequest
from mixpose.cli.check import check_session
from mixpose.cli.request import RunRequest
from mixpose.cli.run import run_session
from mixpose.errors import RecordingError, SessionError
from mixpose.frames import Source, open_source, pair
from mixpose.frames.source import SensorKind, SourceSpec
from mixpose.frames.times import FrameTimes, clock_of, read_times
from mixpose.frames.video import open_video
from mixpose.runner import open_sources
from mixpose.session import load_session

SYNTHETIC = Path(__file__).parents[1] / "data" / "synthetic"
VIDEO = SYNTHETIC / "one_camera_video" / "camera.avi"  # of 60 frames


def write(folder: Path, text: str) -> Path:
    path = folder / "times.csv"
    path.write_text(text)
    return path


def rows(*numbers: int) -> str:
    return "frame,time_s\n" + "".join(f"{n},{0.5 + n}\n" for n in numbers)


def video_session(folder: Path, *timed: int) -> Path:
    """A session of the video whose frames have their times from a table."""
    text = (SYNTHETIC / "one_camera_video" / "session.toml").read_text(encoding="utf-8")
    source = f'source = "{VIDEO.as_posix()}"\ntimes = "times.csv"'
    session = folder / "session.toml"
    session.write_text(text.replace('source = "camera.avi"', source), encoding="utf-8")
    write(folder, rows(*timed))
    return session


def test_table_gives_times_by_frame_in_any_order(tmp_path: Path) -> None:
    times = read_times(write(tmp_path, "time_s,frame\n0.5,7\n0.25,3\n"))
    assert (times(3), times(7)) == (0.25, 0.5)


def test_frame_without_a_time_is_told(tmp_path: Path) -> None:
    times = read_times(write(tmp_path, "frame,time_s\n0,0\n"))
    with pytest.raises(RecordingError, match=r"times\.csv: no time for frame 1"):
        times(1)


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("", "line 1: found nothing"),
        ("0,0.1\n", "line 1: found 0,0.1"),
        ("frame,time\n", "line 1: found frame,time,"),
        ("frame,time_s\n0,0\n0,1\n", "line 3: frame 0 has a time already"),
        ("frame,time_s\n0,nan\n", "line 2: time_s: found 'nan'"),
        ("frame,time_s\n0,1_0\n", "line 2: time_s: found '1_0'"),
        ("frame,time_s\n1_0,1\n", "line 2: frame: found '1_0'"),
        ("frame,time_s\na,1\n", "line 2: frame: found 'a'"),
    ],
)
def test_bad_table_is_told(tmp_path: Path, text: str, found: str) -> None:
    with pytest.raises(RecordingError, match=rf"times\.csv, {found}"):
        read_times(write(tmp_path, text))


def test_missing_table_is_told(tmp_path: Path) -> None:
    spec = SourceSpec("left", "*.png", tmp_path, "camera", times=tmp_path / "none.csv")
    with pytest.raises(RecordingError, match=r"none\.csv: cannot be read"):
        clock_of(spec)


def test_a_session_in_another_folder_finds_the_table_beside_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "below").mkdir()
    video_session(tmp_path / "below", *range(60))
    monkeypatch.chdir(tmp_path)
    # the folder of the session stands in the path once, not twice
    session = load_session(Path("below/session.toml"))
    frame = next(open_sources(session, {})["camera"].frames())
    assert frame.time_s == 0.5


def detections(folder: Path) -> str:
    (folder / "found.csv").write_text("frame,u,v\n-1,1,1\n4,1,1\n4,2,2\n2,1,1\n3,1,1\n")
    return "found.csv"


def images(folder: Path) -> str:
    for number in (-1, 2, 3, 4):
        (folder / f"f{abs(number)}.png").write_bytes(b"not looked at")
    return "f*.png"


def profiles(folder: Path) -> str:
    np.save(folder / "echo.npy", np.ones((5, 3), np.float32))
    return "echo.npy"


@pytest.mark.parametrize("write_source", [detections, images, profiles])
def test_frames_without_a_row_are_told_before_any_is_read(
    write_source: Callable[[Path], str], tmp_path: Path
) -> None:
    kind: SensorKind = "lateration" if write_source is profiles else "camera"
    name = write_source(tmp_path)
    times = write(tmp_path, rows(-1, 0, 1, 3))
    spec = SourceSpec("a", name, tmp_path, kind, times=times, range_min=0.0, bin_size=1.0)
    sources: dict[str, Source] = {"a": open_source(spec)}
    with pytest.raises(RecordingError, match=r"times\.csv: no row for frames 2, 4; allowed is a"):
        pair(sources)
    # only frames that are asked for need one
    pair(sources, 3, 4).close()
    with pytest.raises(RecordingError, match=r"no row for frame 4; allowed"):
        pair(sources, 3)


def test_many_frames_without_a_row_are_counted(tmp_path: Path) -> None:
    for number in range(20):
        (tmp_path / f"f{number}.png").write_bytes(b"not looked at")
    spec = SourceSpec("a", "f*.png", tmp_path, "camera", times=write(tmp_path, rows(3)))
    with pytest.raises(
        RecordingError, match=r"frames 0, 1, 2, 4, 5, \.\.\. \(19 frames\); allowed"
    ):
        pair({"a": open_source(spec)})


def test_a_run_without_a_row_leaves_the_poses_of_the_last_one(tmp_path: Path) -> None:
    session = video_session(tmp_path, *range(57), 58, 59)
    poses = tmp_path / "poses.jsonl"
    before = '{"type": "header", "mixpose": "0.1"}\n'
    poses.write_text(before)
    with pytest.raises(RecordingError, match=r"times\.csv: no row for frame 57; allowed"):
        run_session(RunRequest([str(session)], poses))
    assert poses.read_text() == before


@pytest.mark.parametrize("quick", [False, True])
def test_a_check_tells_rows_that_lack_beyond_the_frames_that_it_looks_at(
    quick: bool, tmp_path: Path
) -> None:
    session = video_session(tmp_path, *range(57), 58, 59)
    with pytest.raises(RecordingError, match=r"times\.csv: no row for frame 57; allowed"):
        check_session(CheckRequest(session, quick=quick))


def test_a_video_that_promises_more_frames_than_it_has_needs_rows_for_those_it_has(
    tmp_path: Path,
) -> None:
    times = write(tmp_path, rows(*range(60)))
    video = open_video(SourceSpec("a", "", tmp_path, "camera", times=times), str(VIDEO), None)
    promising = replace(video, promised=70, clock=read_times(times))
    promising.check_times(range(100))
    with pytest.raises(RecordingError, match=r"no row for frame 59; allowed"):
        replace(promising, clock=FrameTimes(times, dict.fromkeys(range(59), 0.0))).check_times(
            range(100)
        )


@pytest.mark.parametrize("fps", [0.0, -5.0, float("nan"), float("inf")])
def test_rate_must_be_positive(fps: float) -> None:
    with pytest.raises(SessionError, match="'left': fps"):
        clock_of(SourceSpec("left", "*.png", Path(), "camera", fps=fps))


def test_a_rate_may_be_of_less_than_a_frame_per_second() -> None:
    clock = clock_of(SourceSpec("left", "*.png", Path(), "camera", fps=0.1))
    assert clock is not None
    assert clock(3) == pytest.approx(30.0)


def test_table_and_rate_together_are_told() -> None:
    with pytest.raises(SessionError, match="only one"):
        clock_of(SourceSpec("left", "*.png", Path(), "camera", times=Path("t.csv"), fps=5.0))
