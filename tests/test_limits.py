"""Inputs that would take all memory or time: one line each, before anything is allocated."""

from __future__ import annotations

import os
import struct
import subprocess
import sys
import time
import zlib
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from session_lines import message_of, with_lines

from mixpose.body import Body, PointFeature
from mixpose.cli.several import sessions_of
from mixpose.errors import RecordingError, SessionError
from mixpose.frames import ALL_NUMBERS, SourceSpec, open_source, read_image
from mixpose.limits import MOST_BYTES, MOST_DETECTIONS, MOST_FEATURES, MOST_OPENED, MOST_PIXELS
from mixpose.poses.jsonl import read_poses, read_unfinished_poses
from mixpose.runner import run
from mixpose.session import load_session

# of a processor that others keep busy; without the limits these take minutes, or all memory
GENEROUS_S = 30.0


@pytest.fixture(autouse=True)
def within_seconds() -> object:
    began = time.process_time()
    yield
    assert time.process_time() - began < GENEROUS_S


def calibrated(folder: Path, yaml: str) -> str:
    (folder / "cam.yml").write_text(yaml, encoding="utf-8")
    return message_of(folder, with_lines(matrix='calibration = "cam.yml"'))


def test_aliases_that_stand_for_gigabytes_are_refused(tmp_path: Path) -> None:
    bomb = "a0: &a0 [1, 2, 3, 4, 5, 6, 7, 8, 9, 0]\n"
    bomb += "".join(f"a{k}: &a{k} [{', '.join(10 * [f'*a{k - 1}'])}]\n" for k in range(1, 9))
    assert len(bomb) < 1000
    assert "its aliases (*name) stand for more than" in calibrated(tmp_path, bomb)
    endless = "cam0: &a\n  intrinsics: *a\n"
    assert "its aliases (*name) stand for more than" in calibrated(tmp_path, endless)
    assert "characters of YAML" in calibrated(tmp_path, "a: [" + "1, " * 300_000 + "]")


def test_aliases_of_a_few_values_are_read(tmp_path: Path) -> None:
    (tmp_path / "cam.yml").write_text(
        "cam0:\n  camera_model: pinhole\n  intrinsics: &f [800, 800, 640, 512]\n"
        "  distortion_model: none\n  resolution: [1280, 1024]\n  again: *f\n",
        encoding="utf-8",
    )
    session = tmp_path / "session.toml"
    session.write_text(with_lines(matrix='calibration = "cam.yml"'), encoding="utf-8")
    assert load_session(session).sensors[0].resolution == (1280, 1024)


def test_a_body_of_too_many_features_is_refused(tmp_path: Path) -> None:
    points = ", ".join(f"[{k}, 0, 1]" for k in range(MOST_FEATURES + 1))
    message = message_of(tmp_path, with_lines(points=f"points = [{points}]"))
    assert f"found {MOST_FEATURES + 1} points" in message
    assert f"allowed: {MOST_FEATURES}" in message
    segments = ", ".join(f"[[{k}, 0, 0], [{k}, 1, 0]]" for k in range(100))
    message = message_of(tmp_path, with_lines(points=f"segments = [{segments}]"))
    assert "100 segments" in message


def test_too_many_samples_are_refused(tmp_path: Path) -> None:
    points = ", ".join(f"[{k}, {k * k % 7}, 1]" for k in range(100))
    lines = with_lines(points=f"points = [{points}]", estimator="[estimator]\nsamples = 1000000")
    message = message_of(tmp_path, lines)
    assert message.startswith("estimator.samples: found 1000000 for 100 features")


def test_a_resolution_that_no_memory_holds_is_refused(tmp_path: Path) -> None:
    message = message_of(tmp_path, with_lines(left_more="resolution = [100000, 100000]"))
    assert f"allowed: at most {MOST_PIXELS} together" in message


@pytest.mark.skipif(not Path("/dev/zero").exists(), reason="needs a device without end")
@pytest.mark.parametrize("path", ["/dev/zero", "fifo", "."])
def test_a_session_reads_through_no_device_pipe_or_folder(path: str, tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "fifo")
    for lines in (
        with_lines(matrix=f'calibration = "{path}"'),
        with_lines(points=f'file = "{path}"', sigma=""),
    ):
        assert "found no file; allowed: no folder, pipe or device" in message_of(tmp_path, lines)


def test_a_file_that_no_session_needs_is_not_read(tmp_path: Path) -> None:
    hole(tmp_path / "cam.yml")
    message = message_of(tmp_path, with_lines(matrix='calibration = "cam.yml"'))
    assert "has 1000000000000 bytes; allowed: at most" in message


def test_lists_that_are_nested_without_end_are_told(tmp_path: Path) -> None:
    message = calibrated(tmp_path, "a: " + 5000 * "[" + 5000 * "]")
    assert message.endswith("cam.yml: lists or tables in it are nested too deeply")
    lines = with_lines(points="points = " + 5000 * "[" + 5000 * "]")
    path = tmp_path / "session.toml"
    path.write_text(lines, encoding="utf-8")
    with pytest.raises(SessionError, match="nested too deeply"):
        load_session(path)


@pytest.mark.parametrize(
    "text",
    [
        "%YAML:1.0\n---\nM1: " + 50_000 * "[" + 50_000 * "]",
        "%YAML:1.0\n---\nM1: " + 50_000 * "{a: " + 50_000 * "}",
        "%YAML:1.0\n---\nM1:\n  " + 50_000 * "- " + "1\n",
        "<?xml version='1.0'?><opencv_storage>" + 50_000 * "<a>" + 50_000 * "</a>",
    ],
    ids=["lists", "maps", "dashes", "tags"],
)
def test_lists_within_lists_do_not_end_the_process_in_opencv(text: str, tmp_path: Path) -> None:
    allowed = f"opening brackets, tags or dashes; allowed: {MOST_OPENED}"
    assert allowed in calibrated(tmp_path, text)


def hole(path: Path) -> Path:
    """A file of a terabyte that takes no place on the disk."""
    with path.open("wb") as file:
        file.truncate(10**12)
    return path


def test_an_image_file_that_no_image_needs_is_not_read(tmp_path: Path) -> None:
    path = hole(tmp_path / "l0.png")
    with pytest.raises(RecordingError, match="found 1000000000000 bytes; allowed: a file of at"):
        read_image(path)


@pytest.mark.skipif(not Path("/dev/zero").exists(), reason="needs a device without end")
def test_an_image_is_read_through_no_device() -> None:
    with pytest.raises(RecordingError, match="found no file; allowed: a file of at most"):
        read_image(Path("/dev/zero"))


@pytest.mark.parametrize("read", [read_poses, read_unfinished_poses])
def test_poses_without_the_end_of_a_line_are_not_read_to_theirs(
    read: Callable[[Path], object], tmp_path: Path
) -> None:
    paths = [hole(tmp_path / "poses.jsonl"), Path("/dev/zero")]
    for path in filter(Path.exists, paths):
        with pytest.raises(RecordingError, match=f":1: found more than {MOST_BYTES} bytes in a"):
            read(path)


def test_a_list_of_sessions_has_an_end(tmp_path: Path) -> None:
    with pytest.raises(SessionError, match=f"found more than {MOST_BYTES} bytes"):
        sessions_of([str(hole(tmp_path / "all.txt"))])


def table(folder: Path, *lines: str) -> SourceSpec:
    (folder / "t.csv").write_text("frame,u,v\n" + "".join(lines), encoding="utf-8")
    return SourceSpec("left", "t.csv", folder, "camera")


def test_detections_that_cannot_all_be_features_are_refused(tmp_path: Path) -> None:
    spec = table(tmp_path, "3,1,2\n", "4,1,2\n" * (MOST_DETECTIONS + 100), "5,1,2\n")
    source = open_source(spec)
    source.check_times(ALL_NUMBERS)
    frames = source.frames()
    assert next(frames).number == 3
    with pytest.raises(RecordingError, match=f"line {MOST_DETECTIONS + 3}: found more than"):
        next(frames)


def test_a_line_without_end_is_no_table(tmp_path: Path) -> None:
    spec = table(tmp_path, "3,1," + "2" * 20_000_000)
    with pytest.raises(RecordingError, match="not a CSV file"):
        next(open_source(spec).frames())


def test_an_image_flooded_with_spots_counts_as_dark(tmp_path: Path) -> None:
    grid = np.zeros((800, 800), np.uint8)
    grid[4::8, 4::8] = grid[5::8, 4::8] = grid[4::8, 5::8] = grid[5::8, 5::8] = 255
    cv2.imwrite(str(tmp_path / "l0.png"), grid)
    session = tmp_path / "session.toml"
    lines = with_lines(left_more='[sensor.extract]\nthreshold = 128', beam="", beam_keys="",
                       sonar="", sonar_keys="", sigma="")  # fmt: skip
    session.write_text(lines, encoding="utf-8")
    estimate = next(run(load_session(session)))
    assert estimate.status == "lost"
    assert not estimate.sensors["left"].used


def png_of(width: int, height: int) -> bytes:
    """A PNG of a few hundred bytes that promises an image of any size."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        content = kind + data
        return struct.pack(">I", len(data)) + content + struct.pack(">I", zlib.crc32(content))

    head = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    parts = chunk(b"IHDR", head) + chunk(b"IDAT", zlib.compress(b"\0" * 10_000))
    return b"\x89PNG\r\n\x1a\n" + parts + chunk(b"IEND", b"")


def test_an_image_of_absurd_size_is_refused_before_it_is_decoded(tmp_path: Path) -> None:
    path = tmp_path / "l0.png"
    path.write_bytes(png_of(30_000, 30_000))
    code = (
        "import resource, sys, os; from mixpose.cli import main\n"
        "resource.setrlimit(resource.RLIMIT_AS, (2**31, 2**31))\n"
        f"main(['run', {str(tmp_path / 'session.toml')!r}])"
    )
    lines = with_lines(beam="", beam_keys="", sonar="", sonar_keys="")
    (tmp_path / "session.toml").write_text(lines, encoding="utf-8")
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=False
    )
    assert result.returncode == 3
    assert f"{path}: found more pixels than are allowed, {MOST_PIXELS}" in result.stderr
    assert len(result.stderr.splitlines()) == 1


def test_an_image_of_the_largest_size_is_read(tmp_path: Path) -> None:
    path = tmp_path / "long.png"
    cv2.imwrite(str(path), np.zeros((2, 100_000), np.uint8))
    assert read_image(path).shape == (2, 100_000)


def test_a_body_that_repeats_its_features_takes_neither_all_time_nor_all_memory() -> None:
    repeated = np.concatenate([np.eye(3)] * 200 + [[[0.0, 0.0, 0.0], [1.0, 1.0, 0.2]]])
    body = Body("repeated", tuple(PointFeature(point) for point in 100 * repeated))
    began = time.process_time()
    # the pairs of its steps would be gigabytes, its triples are 200**3
    assert (len(body.symmetries), len(body.grid_steps)) == (1, 0)
    assert time.process_time() - began < 5


def test_a_point_that_is_given_twice_is_refused(tmp_path: Path) -> None:
    twice = "points = [[0, 0, 0], [100, 0, 0], [0, 100, 0], [100, 0, 0]]"
    assert "point 4 is where point 2 is" in message_of(tmp_path, with_lines(points=twice))
