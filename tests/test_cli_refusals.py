"""What the command line refuses, in one line: sessions, recordings, options and outputs."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import pytest
from checked import copied
from command_line import assert_one_line, command, lines_of, mixpose

SYNTHETIC = Path(__file__).parents[1] / "data" / "synthetic"


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    """Eight frames of the two-camera recording, free to be spoilt."""
    folder = tmp_path / "recording"
    folder.mkdir()
    return copied(folder)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("sigma", "sigmaa", ["sigmaa", "sigma"]),
        ("camera_matrix = [[", "camera_matrix = [[nan, 0, 0], [", ["camera_matrix"]),
        ('model = "pinhole"', 'model = "pinhol"', ["pinhol", "pinhole"]),
        ("[object]", "[object]\nsigma = -1.0", ["sigma", "-1"]),
        ("[start]", "[begin]", ["begin", "start"]),
        ('method = "blobs"', 'method = "blob"', ["extract.method", "blobs"]),
    ],
)
def test_a_mistake_in_the_session_is_one_line(
    recording: Path, old: str, new: str, words: Sequence[str]
) -> None:
    session = recording / "session.toml"
    text = session.read_text(encoding="utf-8")
    if old == "sigma" and "sigma" not in text:
        text = text.replace("[[sensor]]", "[extract]\nsigma = 1.5\n\n[[sensor]]", 1)
    assert old in text
    session.write_text(text.replace(old, new, 1), encoding="utf-8")
    assert_one_line(command("run", session), 2, "session.toml", *words)


def test_an_object_with_too_few_features_is_told(recording: Path) -> None:
    session = recording / "session.toml"
    text = session.read_text(encoding="utf-8")
    head, _, rest = text.partition("points = [")
    tail = rest.partition("\n]")[2] if "\n]" in rest else rest.partition("]]")[2]
    session.write_text(head + "points = [[0, 0, 0], [10, 0, 0]]" + tail, encoding="utf-8")
    assert_one_line(command("check", session), 2, "points", "found 2", "three")


def test_missing_files_are_told(recording: Path) -> None:
    assert_one_line(mixpose("run", recording / "no.toml"), 2, "no.toml")
    for path in recording.glob("left*.png"):
        path.unlink()
    assert_one_line(command("run", recording / "session.toml"), 3, "left*.png")


def test_wrong_options_are_one_line() -> None:
    assert_one_line(command("run", "x.toml", "--steps", "3"), 2, "--step")
    assert_one_line(command("rum", "x.toml"), 2, "run")
    assert_one_line(command("run", "x.toml", "--format", "xml"), 2, "jsonl")


def test_an_unwritable_output_is_told(recording: Path) -> None:
    result = command("run", recording / "session.toml", "-o", recording / "no" / "poses.jsonl")
    assert_one_line(result, 2, "poses.jsonl")


@pytest.mark.parametrize("name", ["session.toml", "left0003.png"])
def test_an_input_is_never_overwritten(recording: Path, name: str) -> None:
    before = (recording / name).read_bytes()
    result = command("run", recording / "session.toml", "-o", recording / name)
    assert_one_line(result, 2, name, "input")
    assert (recording / name).read_bytes() == before


def test_a_file_of_another_origin_is_never_overwritten(recording: Path) -> None:
    shutil.copy(SYNTHETIC / "two_cameras" / "truth.jsonl", recording)
    (recording / "notes.txt").write_text("measured on Monday\n", encoding="utf-8")
    for name in ("truth.jsonl", "notes.txt"):
        before = (recording / name).read_bytes()
        assert_one_line(command("run", recording / "session.toml", "-o", recording / name), 2, name)
        assert (recording / name).read_bytes() == before


def test_a_run_that_fails_before_its_first_frame_leaves_earlier_poses(recording: Path) -> None:
    poses = recording / "poses.jsonl"
    assert command("run", recording / "session.toml", "-o", poses, "--stop", "2").returncode == 0
    before = poses.read_bytes()
    (recording / "left0000.png").write_bytes(b"")
    assert_one_line(command("run", recording / "session.toml", "-o", poses), 3, "left0000.png")
    assert poses.read_bytes() == before


def test_a_stray_file_among_numbered_ones_is_told(recording: Path) -> None:
    shutil.copy(recording / "left0000.png", recording / "left_test.png")
    result = command("run", recording / "session.toml", "--stop", "1")
    assert "warning" in result.stderr
    assert "left_test.png" in result.stderr


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs a device that is always full")
def test_a_full_disk_is_one_line() -> None:
    session = SYNTHETIC / "two_cameras" / "session.toml"
    result = mixpose("run", session, "-o", "/dev/full", "--stop", "1")
    assert_one_line(result, 2, "No space left")


def test_debug_shows_the_traceback(recording: Path) -> None:
    result = command("run", recording / "no.toml", "--debug")
    assert "Traceback" in result.stderr


def test_an_unreadable_image_keeps_the_frames_before_it(recording: Path) -> None:
    (recording / "left0005.png").write_bytes(b"this is no image")
    poses = recording / "poses.jsonl"
    result = command("run", recording / "session.toml", "-o", poses)
    assert_one_line(result, 3, "left0005.png")
    assert [pose["frame"] for pose in lines_of(poses.read_text())[1:]] == list(range(5))


def test_a_truncated_image_is_told(recording: Path) -> None:
    path = recording / "right0002.png"
    path.write_bytes(path.read_bytes()[:-400])
    assert_one_line(command("run", recording / "session.toml"), 3, "right0002.png")


def test_an_image_of_the_wrong_size_is_told(recording: Path) -> None:
    cv2.imwrite(str(recording / "left0001.png"), np.zeros((100, 120), dtype=np.uint8))
    assert_one_line(command("run", recording / "session.toml"), 3, "left0001.png", "120", "640")


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("mydata.tum", "1 2 3\n"),
        ("other.tum", "0.0 1 2 3 0 0 0 1\n"),  # of another program
        ("table.csv", "1\n2\n"),
        ("notes.yaml", "# frame grabber settings\nexposure: 3\n"),
        ("times.tum", "# time is the frame number, as always\n1 2\n"),
    ],
)
def test_files_of_others_that_begin_like_poses_are_kept(
    name: str, text: str, tmp_path: Path
) -> None:
    path = tmp_path / name
    path.write_text(text, encoding="utf-8")
    truth = SYNTHETIC / "two_cameras" / "truth.jsonl"
    assert_one_line(command("convert", truth, "-o", path), 2, name, "mixpose did not write")
    assert path.read_text(encoding="utf-8") == text


@pytest.mark.parametrize("format_name", ["c3d", "trc"])
def test_markers_go_into_no_file_that_only_speaks_of_mixpose(
    format_name: str, recording: Path
) -> None:
    if format_name == "c3d":
        pytest.importorskip("ezc3d")
    shutil.copy(SYNTHETIC / "two_cameras" / "truth.jsonl", recording)
    text = "# Calibrated by mixpose 1.0 from session.toml\n"
    (recording / "cal.toml").write_text(text, encoding="utf-8")
    options = ("convert", "truth.jsonl", "--format", format_name, "-o")
    result = command(*options, "cal.toml", cwd=recording)
    assert_one_line(result, 2, "cal.toml", "mixpose did not write")
    assert (recording / "cal.toml").read_text(encoding="utf-8") == text
    result = command(*options, "session.toml", cwd=recording)
    assert_one_line(result, 2, "session.toml", "is an input of this run")


def test_a_pattern_with_two_stars_in_a_name_is_run_again(recording: Path) -> None:
    session = recording / "session.toml"
    text = session.read_text(encoding="utf-8")
    assert '"left*.png"' in text
    session.write_text(text.replace('"left*.png"', '"left**.png"'), encoding="utf-8")
    for _ in range(2):  # the second time over its own
        result = command("run", session, "--stop", "1", "-o", recording / "poses.jsonl")
        assert result.returncode == 0, result.stderr
    result = command("run", session, "-o", recording / "left0000.png", "--format", "csv")
    assert_one_line(result, 2, "left0000.png", "is an input of this run")
