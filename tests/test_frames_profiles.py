"""Range profiles from .npy and .csv files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mixpose.errors import RecordingError, SessionError
from mixpose.frames import Source, SourceSpec, open_source
from mixpose.records import GridPattern

SIGNAL = np.random.default_rng(0).random((6, 10))


def profiles(folder: Path, name: str, **options: object) -> Source:
    given: dict[str, object] = {"range_min": 2.0, "bin_size": 0.5, **options}
    return open_source(SourceSpec("radar", name, folder, "lateration", **given))  # type: ignore[arg-type]


def save(folder: Path, name: str, signal: np.ndarray = SIGNAL) -> None:
    if name.endswith(".npy"):
        np.save(folder / name, signal)
    else:
        np.savetxt(folder / name, signal, delimiter=",")


@pytest.mark.parametrize("name", ["p.npy", "p.csv"])
def test_each_row_is_a_frame(tmp_path: Path, name: str) -> None:
    save(tmp_path, name)
    source = profiles(tmp_path, name, fps=10.0)
    frames = list(source.frames())
    assert [(frame.number, frame.time_s) for frame in frames] == [(n, n / 10) for n in range(6)]
    for frame, row in zip(frames, SIGNAL, strict=True):
        assert isinstance(frame.data, GridPattern)
        assert frame.data.values.dtype == np.float32
        np.testing.assert_allclose(frame.data.values, row[None], rtol=1e-6)
        np.testing.assert_array_equal(frame.data.origin, [2.0])
        assert frame.data.step == 0.5
    assert source.describe() == "6 range profiles of 10 bins from 2 to 6.5, frames 0-5"
    assert (source.first, source.length) == (0, 6)


@pytest.mark.parametrize("name", ["p.npy", "p.csv"])
def test_selection_counts_rows(tmp_path: Path, name: str) -> None:
    save(tmp_path, name)
    source = profiles(tmp_path, name)
    assert [frame.number for frame in source.frames(1, 6, 2)] == [1, 3, 5]
    assert [frame.number for frame in source.frames(-2)] == [0, 1, 2, 3, 4, 5]
    assert [frame.number for frame in source.frames(50)] == []


@pytest.mark.parametrize("name", ["p.npy", "p.csv"])
def test_nan_is_told_after_the_profiles_before_it(tmp_path: Path, name: str) -> None:
    signal = SIGNAL.copy()
    signal[2, 7] = np.nan
    save(tmp_path, name, signal)
    stream = profiles(tmp_path, name).frames()
    assert [next(stream).number, next(stream).number] == [0, 1]
    with pytest.raises(RecordingError, match=r"p\.\w+.*bin 7: found '?nan"):
        next(stream)


@pytest.mark.parametrize("name", ["p.npy", "p.csv"])
def test_nan_in_a_skipped_profile_does_not_matter(tmp_path: Path, name: str) -> None:
    signal = SIGNAL.copy()
    signal[1] = np.nan
    save(tmp_path, name, signal)
    assert len(list(profiles(tmp_path, name).frames(0, None, 2))) == 3


def test_value_beyond_float32_is_told(tmp_path: Path) -> None:
    save(tmp_path, "p.npy", SIGNAL * 1e300)
    with pytest.raises(RecordingError, match="frame 0, bin 0"):
        list(profiles(tmp_path, "p.npy").frames())


def test_truncated_array_is_read_as_far_as_it_goes(tmp_path: Path) -> None:
    save(tmp_path, "p.npy")
    path = tmp_path / "p.npy"
    path.write_bytes(path.read_bytes()[:-100])  # a row has 80 bytes
    stream = profiles(tmp_path, "p.npy").frames()
    assert [next(stream).number for _ in range(4)] == [0, 1, 2, 3]
    with pytest.raises(RecordingError, match=r"p\.npy: cut short: 4 of the 6"):
        next(stream)


@pytest.mark.parametrize(
    "array",
    [
        np.zeros(5),
        np.zeros((2, 1, 5)),
        np.zeros((2, 5), complex),
        np.zeros((0, 5)),
        np.asfortranarray(SIGNAL),
        np.array([["a", "b"]]),
    ],
)
def test_array_of_another_form_is_told(tmp_path: Path, array: np.ndarray) -> None:
    np.save(tmp_path / "p.npy", array)
    with pytest.raises(RecordingError, match=r"p\.npy: found .*\(frames, bins\)"):
        profiles(tmp_path, "p.npy")


def test_an_array_with_the_long_header_is_read(tmp_path: Path) -> None:
    with (tmp_path / "p.npy").open("wb") as file:
        np.lib.format.write_array(file, SIGNAL, version=(2, 0))
    (first, *_) = profiles(tmp_path, "p.npy").frames()
    assert isinstance(first.data, GridPattern)
    np.testing.assert_allclose(first.data.values[0], SIGNAL[0], rtol=1e-6)


def test_file_that_is_no_array_is_told(tmp_path: Path) -> None:
    (tmp_path / "p.npy").write_bytes(b"\x93NUMPY\x01")
    with pytest.raises(RecordingError, match=r"p\.npy: not a \.npy file"):
        profiles(tmp_path, "p.npy")


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("1,2\n3\n", "line 2: found 1 cells"),
        ("1,2\n3,x\n", "line 2: bin 1: found 'x'"),
        ("1,2\n\n3,4\n", "line 2: blank"),
    ],
)
def test_bad_row_is_told(tmp_path: Path, text: str, found: str) -> None:
    (tmp_path / "p.csv").write_text(text)
    with pytest.raises(RecordingError, match=rf"p\.csv, {found}"):
        list(profiles(tmp_path, "p.csv").frames())


@pytest.mark.parametrize(
    ("options", "found"),
    [
        ({"range_min": None}, "range_min is missing"),
        ({"bin_size": None}, "bin_size is missing"),
        ({"bin_size": 0.0}, "bin_size: found 0"),
        ({"range_min": float("nan")}, "range_min: found nan"),
    ],
)
def test_profiles_need_their_grid(tmp_path: Path, options: dict[str, object], found: str) -> None:
    save(tmp_path, "p.npy")
    with pytest.raises(SessionError, match=f"'radar': {found}"):
        profiles(tmp_path, "p.npy", **options)


def test_values_whose_squares_cannot_be_added_up_are_one_line(tmp_path: Path) -> None:
    path = tmp_path / "p.csv"
    path.write_text("0,1,2\n0,1e30,2\n")
    with pytest.raises(RecordingError, match=r"frame 1, bin 1: found 1e\+30, allowed .* 1e\+15"):
        list(profiles(tmp_path, "p.csv").frames())


@pytest.mark.parametrize(
    "shape", ["(-3, 200)", "(3, -200)", "(True, True)", "(3,!J@", "(3, 10**9)"]
)
def test_a_header_that_says_nonsense_is_told(tmp_path: Path, shape: str) -> None:
    header = f"{{'descr': '<f4', 'fortran_order': False, 'shape': {shape}, }}".ljust(117) + "\n"
    beginning = b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little")
    (tmp_path / "p.npy").write_bytes(beginning + header.encode() + bytes(2400))
    with pytest.raises(RecordingError, match=r"p\.npy: (not a|found float32 of|cut short)"):
        list(profiles(tmp_path, "p.npy").frames())
