"""Images named after the nanosecond they were taken in."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from session_lines import with_lines

from mixpose.cli.app import CheckRequest
from mixpose.cli.check import check_session
from mixpose.frames import Source, SourceSpec, open_source, pair, paired_by_stamp

FIRST = 1403636579763555584  # as in recordings of drones
STEP = 50_000_000


def camera(folder: Path, name: str, stamps: list[int], fps: float | None = None) -> Source:
    for stamp in stamps:
        cv2.imwrite(str(folder / f"{name}{stamp}.png"), np.zeros((4, 4), np.uint8))
    return open_source(SourceSpec(name, f"{name}*.png", folder, "camera", fps=fps))


def test_stamps_are_times_whatever_fps_says(tmp_path: Path) -> None:
    source = camera(tmp_path, "a", [FIRST, FIRST + STEP], fps=20.0)
    times = [frame.time_s for frame in source.frames()]
    assert times == pytest.approx([1403636579.763555584, 1403636579.813555584], abs=1e-6)
    assert "end in times since 1970" in str(source.caution())
    assert camera(tmp_path, "b", [FIRST, FIRST + STEP]).caution() is None


def test_tables_of_times_alone_are_paired_by_them_where_one_lacks_a_moment(tmp_path: Path) -> None:
    sources = {}
    for name, times in (("a", [0.1, 0.2, 0.3, 0.5]), ("b", [0.199, 0.301, 0.4, 0.5])):
        rows = "".join(f"{time},1,1\n" for time in times)
        (tmp_path / f"{name}.csv").write_text(f"time_s,u,v\n{rows}", encoding="utf-8")
        sources[name] = open_source(SourceSpec(name, f"{name}.csv", tmp_path, "camera"))
    paired = paired_by_stamp(sources)
    sets = [(each.number, each.time_s, list(each.frames)) for each in pair(paired)]
    assert sets == [
        (0, 0.1, ["a"]),
        (1, 0.2, ["a", "b"]),
        (2, 0.3, ["a", "b"]),
        (3, 0.4, ["b"]),
        (4, 0.5, ["a", "b"]),
    ]
    assert (paired["b"].first, paired["a"].length) == (1, 4)
    assert "frames 0-4 with gaps" in paired["a"].describe()
    assert [frame.number for frame in paired["b"].frames(2, 4)] == [2, 3]


def test_numbers_of_frames_are_no_stamps(tmp_path: Path) -> None:
    source = camera(tmp_path, "a", [0, 10**16], fps=10.0)
    assert [frame.time_s for frame in source.frames()] == [0.0, 1e15]


def test_cameras_some_microseconds_apart_are_paired(tmp_path: Path) -> None:
    left = [FIRST + k * STEP for k in range(6)]
    right = [stamp + 13_000 for stamp in left]
    del right[2]
    top = [stamp - 7_000 for stamp in left[1:]] + [left[2] + 20_000_000]
    sources = {"left": camera(tmp_path, "l", left), "right": camera(tmp_path, "r", right)}
    sources["top"] = camera(tmp_path, "t", top)
    sets = list(pair(paired_by_stamp(sources)))
    found = [(each.number, "".join(name[0] for name in each.frames)) for each in sets]
    stray = left[2] + 20_000_000
    expected = [(left[0], "lr"), (left[1], "lrt"), (left[2], "lt"), (stray, "t")]
    assert found == [*expected, *((number, "lrt") for number in left[3:])]
    times = [sets[1].frames[name].time_s or 0.0 for name in ("left", "right", "top")]
    assert np.diff(times) * 1e6 == pytest.approx([13, -20], abs=0.5)  # float64 has 0.24 µs there


def test_a_quick_check_tells_that_frames_do_not_pair(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for k in range(40):
        for name in (f"l{k}", f"b{k + 1000}"):
            cv2.imwrite(str(tmp_path / f"{name}.png"), np.zeros((1024, 1280), np.uint8))
    session = tmp_path / "session.toml"
    session.write_text(with_lines(sonar="", sonar_keys=""), encoding="utf-8")
    check_session(CheckRequest(session, quick=True))
    said = capsys.readouterr().out
    assert "sensor 'left': 0 of its 40 frames pair with those of other sensors" in said


def test_times_beyond_all_clocks_pair_too(tmp_path: Path) -> None:
    sources = {}
    for name in ("a", "b"):
        (tmp_path / f"{name}.csv").write_text("time_s,u,v\n0,1,1\n1e305,1,1\n", encoding="utf-8")
        sources[name] = open_source(SourceSpec(name, f"{name}.csv", tmp_path, "camera"))
    assert [len(each.frames) for each in pair(paired_by_stamp(sources))] == [2, 2]


def test_names_that_end_in_seconds_since_1970_are_stamps(tmp_path: Path) -> None:
    names = ["1305031102.9", "1305031103.000019", "1305031103.24"]
    for name in names:
        cv2.imwrite(str(tmp_path / f"{name}.png"), np.zeros((4, 4), np.uint8))
    source = open_source(SourceSpec("left", "*.png", tmp_path, "camera"))
    frames = list(source.frames())
    assert [frame.number for frame in frames] == [
        1305031102_900000000,
        1305031103_000019000,
        1305031103_240000000,
    ]
    assert [frame.time_s for frame in frames] == pytest.approx([float(n) for n in names], abs=1e-6)
    assert source.caution() is None


def test_numbers_that_do_not_go_with_the_names_are_told(tmp_path: Path) -> None:
    for name in ("12-30-58", "12-30-59", "12-31-00"):
        cv2.imwrite(str(tmp_path / f"{name}.png"), np.zeros((4, 4), np.uint8))
    source = open_source(SourceSpec("left", "*.png", tmp_path, "camera"))
    assert str(source.caution()).startswith(
        "12-31-00.png comes before 12-30-58.png, as frames go by the last"
    )


def test_a_number_of_a_camera_before_a_point_is_no_time(tmp_path: Path) -> None:
    for number in range(4):
        path = tmp_path / f"cam_1234567890.{number:04d}.png"
        cv2.imwrite(str(path), np.zeros((4, 4), np.uint8))
    source = open_source(SourceSpec("left", "*.png", tmp_path, "camera", fps=25.0))
    assert [frame.number for frame in source.frames()] == [0, 1, 2, 3]
    assert source.caution() is None
