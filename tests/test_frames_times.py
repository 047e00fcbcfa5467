"""Times of frames from a table or a rate."""

from __future__ import annotations

from pathlib import Path

import pytest

from mixpose.errors import RecordingError, SessionError
from mixpose.frames.source import SourceSpec
from mixpose.frames.times import clock_of, read_times


def write(folder: Path, text: str) -> Path:
    path = folder / "times.csv"
    path.write_text(text)
    return path


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
        ("frame,time_s\na,1\n", "line 2: frame: found 'a'"),
    ],
)
def test_bad_table_is_told(tmp_path: Path, text: str, found: str) -> None:
    with pytest.raises(RecordingError, match=rf"times\.csv, {found}"):
        read_times(write(tmp_path, text))


def test_missing_table_is_told(tmp_path: Path) -> None:
    spec = SourceSpec("left", "*.png", tmp_path, "camera", times=Path("none.csv"))
    with pytest.raises(RecordingError, match=r"none\.csv: cannot be read"):
        clock_of(spec)


def test_table_is_relative_to_the_session(tmp_path: Path) -> None:
    write(tmp_path, "frame,time_s\n2,9\n")
    clock = clock_of(SourceSpec("left", "*.png", tmp_path, "camera", times=Path("times.csv")))
    assert clock is not None
    assert clock(2) == 9


@pytest.mark.parametrize("fps", [0.0, -5.0, float("nan"), float("inf")])
def test_rate_must_be_positive(fps: float) -> None:
    with pytest.raises(SessionError, match="'left': fps"):
        clock_of(SourceSpec("left", "*.png", Path(), "camera", fps=fps))


def test_table_and_rate_together_are_told() -> None:
    with pytest.raises(SessionError, match="only one"):
        clock_of(SourceSpec("left", "*.png", Path(), "camera", times=Path("t.csv"), fps=5.0))
