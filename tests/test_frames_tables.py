"""Tables of detections: columns, order, and cells that are not as they should be."""

from __future__ import annotations

import random
import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from mixpose.errors import RecordingError
from mixpose.frames import Source, SourceSpec, open_source
from mixpose.records import PointPattern, RawFrame


def table(folder: Path, text: str, kind: str = "camera", **options: object) -> Source:
    (folder / "dots.csv").write_text(text, encoding="utf-8")
    return open_source(SourceSpec("left", "dots.csv", folder, kind, **options))  # type: ignore[arg-type]


def pattern(frame: RawFrame) -> PointPattern:
    assert isinstance(frame.data, PointPattern)
    return frame.data


def test_rows_of_a_frame_become_its_points(tmp_path: Path) -> None:
    source = table(tmp_path, "frame,u,v\n3,1.5,2\n3,4,5\n7,6,7\n")
    frames = list(source.frames())
    assert [(frame.number, frame.time_s) for frame in frames] == [(3, None), (7, None)]
    np.testing.assert_array_equal(pattern(frames[0]).points, [[1.5, 2], [4, 5]])
    np.testing.assert_array_equal(pattern(frames[0]).weights, [1, 1])
    assert source.describe() == "3 detections, frames 3-7 with gaps"
    assert (source.first, source.length) == (3, 2)


def test_columns_may_come_in_any_order_and_spelling(tmp_path: Path) -> None:
    text = "\ufeffV, Weight ,U,Frame\r\n2,0.5, 1 ,0\r\n\r\n4,2,3,0\r\n"
    (frame,) = table(tmp_path, text).frames()
    np.testing.assert_array_equal(pattern(frame).points, [[1, 2], [3, 4]])
    np.testing.assert_array_equal(pattern(frame).weights, [0.5, 2])


def test_ranges_are_points_of_one_coordinate(tmp_path: Path) -> None:
    (frame,) = table(
        tmp_path, "frame,time_s,range\n0,1.5,4.06\n0,1.25,3.9\n", "lateration"
    ).frames()
    np.testing.assert_array_equal(pattern(frame).points, [[4.06], [3.9]])
    assert frame.time_s == 1.25  # of the earliest detection


def test_times_alone_number_the_frames(tmp_path: Path) -> None:
    source = table(tmp_path, "time_s,u,v\n0.5,1,1\n0.5,2,2\n0.75,3,3\n2,4,4\n")
    frames = list(source.frames(start=1))
    assert [(frame.number, frame.time_s) for frame in frames] == [(1, 0.75), (2, 2.0)]
    assert source.describe() == "4 detections, frames 0-2"


@pytest.mark.parametrize("header", ["frame,time_s,u,v", "time_s,u,v"])
def test_shuffled_rows_give_the_same_frames(tmp_path: Path, header: str) -> None:
    rows = [f"{n},{n / 10},{n + k},{k}" for n in range(20) for k in range(3)]
    if not header.startswith("frame"):
        rows = [row.partition(",")[2] for row in rows]
    ordered = list(table(tmp_path, "\n".join([header, *rows])).frames(2, 18, 3))
    random.Random(0).shuffle(rows)
    source = table(tmp_path, "\n".join([header, *rows]))
    assert source.describe() == "60 detections, frames 0-19"
    shuffled = list(source.frames(2, 18, 3))
    assert [(f.number, f.time_s) for f in shuffled] == [(f.number, f.time_s) for f in ordered]
    for left, right in zip(shuffled, ordered, strict=True):
        points = sorted(map(tuple, pattern(left).points))
        assert points == sorted(map(tuple, pattern(right).points))


def test_row_of_weight_zero_says_that_its_frame_exists(tmp_path: Path) -> None:
    (frame,) = table(tmp_path, "frame,u,v,weight\n4,0,0,0\n").frames()
    assert frame.number == 4
    assert pattern(frame).points.shape == (0, 2)


def test_table_without_rows_has_no_frames(tmp_path: Path) -> None:
    source = table(tmp_path, "frame,u,v\n")
    assert list(source.frames()) == []
    assert (source.first, source.length, source.describe()) == (None, 0, "0 detections")


def test_times_of_the_session_override_those_of_the_table(tmp_path: Path) -> None:
    (frame,) = table(tmp_path, "frame,time_s,u,v\n5,9,0,0\n", fps=10.0).frames()
    assert frame.time_s == 0.5


@pytest.mark.parametrize(
    ("header", "found"),
    [
        ("", "file is empty"),
        ("frame,u", "'v' is missing"),
        ("u,v", "neither frame nor time_s"),
        ("frame,u,v,wieght", "'wieght'"),
        ("frame,u,v,u", "twice"),
        ("0,1,2", "column '0'"),
        ("frame;u;v", "column 'frame;u;v'; columns are parted by commas, 'frame,u,v'"),
        ("frame\tu\tv", "columns are parted by commas, 'frame,u,v'"),
        ("frame;u;v", "'frame;u;v'"),
        ("frame,range", "'range'"),
    ],
)
def test_bad_header_is_told(tmp_path: Path, header: str, found: str) -> None:
    with pytest.raises(RecordingError, match=rf"dots\.csv, line 1: .*{found}.*u,v.*weight"):
        table(tmp_path, header + "\n")


@pytest.mark.parametrize(
    ("row", "found"),
    [
        ("2,x,0,1", "u: found 'x'"),
        ("2,nan,0,1", "u: found 'nan'"),
        ("2,0,inf,1", "v: found 'inf'"),
        ("2,1_0,0,1", "u: found '1_0'"),
        ("2,0,0,1_0", "weight: found '1_0'"),
        ("1_0,0,0,1", "frame: found '1_0'"),
        ("2,0,,1", "v: found an empty cell"),
        ("2,0,0,-1", "weight: found -1"),
        ("2.5,0,0,1", "frame: found '2.5'"),
        ("nan,0,0,1", "frame: found 'nan'"),
        ("2,0,0", "found 3 cells"),
        ("2,0,0,1,9", "found 5 cells"),
    ],
)
def test_bad_cell_is_told_after_the_frames_before_it(tmp_path: Path, row: str, found: str) -> None:
    source = table(tmp_path, f"frame,u,v,weight\n0,1,1,1\n1,2,2,1\n\n{row}\n3,0,0,1\n")
    stream = source.frames()
    assert next(stream).number == 0
    with pytest.raises(RecordingError, match=rf"dots\.csv, line 5: {found}") as caught:
        list(stream)
    assert "\n" not in str(caught.value)


def test_file_that_is_no_text_is_told(tmp_path: Path) -> None:
    (tmp_path / "dots.csv").write_bytes(b"frame,u,v\n0,\xff\xfe,1\n")
    with pytest.raises(RecordingError, match=r"dots\.csv: not a text file"):
        open_source(SourceSpec("left", "dots.csv", tmp_path, "camera"))


def test_long_table_is_not_held_in_memory(tmp_path: Path) -> None:
    rows = "".join(f"{n},{n % 7},{n % 5}\n" * 4 for n in range(5000))
    source = table(tmp_path, "frame,u,v\n" + rows)
    tracemalloc.start()
    count = sum(1 for _ in source.frames())
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert count == 5000
    assert peak < 200_000  # 20000 rows held as lists of cells would take 5 MB


@pytest.mark.parametrize(
    ("row", "fault"),
    [
        ("0,1e300,2,1", "u: found 1e.300, allowed is at most 1e.12"),
        ("0,1,2,1e308", "weight: found 1e.308, allowed is at most 1e.12"),
        ("0,1,2,1e-320", "weight: found 9.99.*e-321, allowed is 0, or at least 1e-12"),
        ("0,1,2,-1", "weight: found -1, allowed is 0 or more"),
    ],
)
def test_numbers_that_cannot_be_reckoned_with_are_told(
    tmp_path: Path, row: str, fault: str
) -> None:
    with pytest.raises(RecordingError, match=f"line 2: {fault}"):
        list(table(tmp_path, f"frame,u,v,weight\n{row}\n").frames())


def test_frames_may_be_numbered_by_nanoseconds(tmp_path: Path) -> None:
    (frame,) = table(tmp_path, "frame,u,v\n1700000000000000000,1,2\n").frames()
    assert frame.number == 1_700_000_000_000_000_000


def test_times_of_a_table_without_numbers_stand_for_a_rate(tmp_path: Path) -> None:
    text = "time_s,u,v\n0.5,1,1\n0.75,3,3\n2,4,4\n"
    source = table(tmp_path, text, fps=25.0)
    assert [frame.time_s for frame in source.frames()] == [0.5, 0.75, 2.0]
    assert "which they go by, and not by fps" in str(source.caution())
    numbered = table(tmp_path, "frame,u,v\n0,1,1\n5,3,3\n", fps=25.0)
    assert [frame.time_s for frame in numbered.frames()] == [0.0, 0.2]
    assert numbered.caution() is None
