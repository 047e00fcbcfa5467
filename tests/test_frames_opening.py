"""Finding the recording that a session names."""

from __future__ import annotations

import os
from pathlib import Path

import cv2
import numpy as np
import pytest

import mixpose.frames
from mixpose.errors import RecordingError, SessionError
from mixpose.frames import Source, SourceSpec, files_of, open_source


def opened(base: Path, source: str | tuple[str, ...], kind: str = "camera") -> Source:
    spec = SourceSpec("s1", source, base, kind, range_min=0.0, bin_size=1.0)  # type: ignore[arg-type]
    return open_source(spec)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    cv2.imwrite(str(tmp_path / "f1.png"), np.zeros((8, 8), np.uint8))
    (tmp_path / "dots.csv").write_text("frame,u,v\n0,1,2\n")
    (tmp_path / "ranges.csv").write_text("frame,range\n0,1\n")
    (tmp_path / "profile.csv").write_text("1,2,3\n")
    np.save(tmp_path / "profile.npy", np.zeros((2, 3)))
    return tmp_path


@pytest.mark.parametrize(
    ("source", "sensor", "kind"),
    [
        ("f1.png", "camera", "images"),
        ("f*.png", "camera", "images"),
        (("f1.png", "f1.png"), "camera", "images"),
        (("dots.csv",), "camera", "detections"),
        (".", "camera", "images"),
        ("dots.csv", "camera", "detections"),
        ("d*s.csv", "camera", "detections"),
        ("ranges.csv", "lateration", "detections"),
        ("profile.csv", "lateration", "profiles"),
        ("profile.npy", "lateration", "profiles"),
        ("rtsp://camera/1", "camera", "live"),
        ("http://camera/video.mp4", "camera", "video"),
        ("http://camera/video.mjpg", "camera", "live"),
        ("camera:0", "camera", "live"),
    ],
)
def test_kind_of_source_is_recognised(
    folder: Path, source: str | tuple[str, ...], sensor: str, kind: str
) -> None:
    assert opened(folder, source, sensor).kind == kind


@pytest.mark.parametrize("only", ["f*.png", ".", "d*s.csv", "rtsp://camera/1"])
def test_a_list_of_one_is_read_from_the_files_of_what_it_names(folder: Path, only: str) -> None:
    one, several = (SourceSpec("s1", source, folder, "camera") for source in (only, (only,)))
    assert files_of(several) == files_of(one)
    assert open_source(several).kind == open_source(one).kind


@pytest.mark.parametrize(
    ("source", "sensor", "found"),
    [
        ("f1.png", "lateration", "images"),
        ("http://camera/1", "lateration", "live"),
        ("profile.npy", "camera", "profiles"),
    ],
)
def test_source_that_does_not_fit_the_sensor_is_told(
    folder: Path, source: str, sensor: str, found: str
) -> None:
    with pytest.raises(SessionError, match=f"'s1': source: found {found} .*{source}.*reads"):
        opened(folder, source, sensor)


@pytest.mark.parametrize(
    ("source", "found"),
    [
        ("none.png", r"none\.png: no such file"),
        ("g*.png", r"g\*\.png: no such file, and nothing matches"),
        (("f1.png", "f2.png"), r"f2\.png: no such file"),
        ("", "no such file"),
        ("0", "no such file"),
        ("*.csv", "matches 3 files"),
        ("x" * 300 + ".png", "cannot be read: File name too long"),
    ],
)
def test_recording_that_is_not_there_is_told(
    folder: Path, source: str | tuple[str, ...], found: str
) -> None:
    with pytest.raises(RecordingError, match=found) as caught:
        opened(folder, source)
    assert "\n" not in str(caught.value)


def test_empty_list_is_told(folder: Path) -> None:
    with pytest.raises(SessionError, match="empty list"):
        opened(folder, ())


def test_folder_without_images_is_told(folder: Path) -> None:
    (folder / "empty").mkdir()
    with pytest.raises(RecordingError, match="empty: no images in this folder"):
        opened(folder, "empty")


def test_exported_names_are_there() -> None:
    names = {"ALL_NUMBERS", "SensorKind", "Source", "SourceSpec", "files_of", "open_source", "pair"}
    for name in names | {"paired_by_stamp", "prefetch", "read_image"}:
        assert hasattr(mixpose.frames, name)


RECORDINGS = os.environ.get("MIXPOSE_RECORDINGS", "")


@pytest.mark.skipif(not RECORDINGS, reason="MIXPOSE_RECORDINGS names no folder")
@pytest.mark.parametrize(
    ("name", "source", "kind", "text"),
    [
        ("stereo_chessboard", "left*.jpg", "camera", "12 images 640x512, frames 1-12"),
        (
            "disk_effector",
            ("exception-bedref-0.jpg", "try_hard_0005.jpg"),
            "camera",
            "2 images 3280x2464, frames 0-5 with gaps",
        ),
        ("led_tee", "image_10.png", "camera", "1 image 1600x1200, frame 10"),
        ("uwb_trolley", "anchor0.csv", "lateration", "2022 detections, frames 0-673"),
    ],
)
def test_real_recordings_open(
    name: str, source: str | tuple[str, ...], kind: str, text: str
) -> None:
    found = opened(Path(RECORDINGS) / name, source, kind)
    assert found.describe() == text
    assert sum(1 for _ in found.frames()) == found.length
