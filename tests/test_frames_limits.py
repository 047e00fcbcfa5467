"""Recordings that are larger than allowed, of unknown kinds, or not whole: told in one line."""

from __future__ import annotations

from pathlib import Path
from typing import Any
from unittest.mock import MagicMock

import cv2
import numpy as np
import pytest

from mixpose.errors import RecordingError
from mixpose.frames import Source, SourceSpec, capture, images, open_source, profiles, tables, video

CLIP = Path(__file__).parents[1] / "data" / "synthetic" / "one_camera_video" / "camera.avi"


def opened(path: Path, kind: str = "camera", **options: Any) -> Source:
    return open_source(SourceSpec("left", path.name, path.parent, kind, **options))  # type: ignore[arg-type]


def test_an_image_of_more_pixels_than_allowed_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "a0.png"
    cv2.imwrite(str(path), np.zeros((10, 12), np.uint8))
    assert next(opened(path).frames()).number == 0
    monkeypatch.setattr(images, "MOST_PIXELS", 119)
    with pytest.raises(RecordingError, match=r"a0\.png: found more pixels than are allowed"):
        next(opened(path).frames())


def test_an_image_of_a_type_that_no_camera_has_is_told(tmp_path: Path) -> None:
    path = tmp_path / "a0.tiff"
    cv2.imwrite(str(path), np.zeros((10, 12), np.int16))
    with pytest.raises(RecordingError, match=r"a0\.tiff: found pixels of type int16, allowed are"):
        next(opened(path).frames())


def test_a_video_of_more_pixels_than_allowed_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(video, "MOST_PIXELS", 640 * 480 - 1)
    with pytest.raises(RecordingError, match="found 640x480 pixels, allowed are 307199 together"):
        opened(CLIP)


@pytest.mark.parametrize("suffix", [".npy", ".csv"])
def test_profiles_of_more_bins_than_allowed_are_told(
    suffix: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / f"p{suffix}"
    signal = np.ones((3, 7))
    if suffix == ".npy":
        np.save(path, signal)
    else:
        np.savetxt(path, signal, delimiter=",")
    grid = {"range_min": 0.0, "bin_size": 1.0}
    monkeypatch.setattr(profiles, "MOST_BINS", 7)
    assert opened(path, "lateration", **grid).length == 3
    monkeypatch.setattr(profiles, "MOST_BINS", 6)
    with pytest.raises(RecordingError, match="found 7 bins in a profile, allowed are 6"):
        opened(path, "lateration", **grid)


def test_an_array_without_a_whole_profile_is_told(tmp_path: Path) -> None:
    path = tmp_path / "p.npy"
    np.save(path, np.ones((3, 7)))
    path.write_bytes(path.read_bytes()[: -3 * 7 * 8 + 55])  # of 56 bytes
    with pytest.raises(RecordingError, match="cut short: profile 0 is not whole"):
        opened(path, "lateration", range_min=0.0, bin_size=1.0)


def test_rows_without_order_are_sorted_as_far_as_memory_is_allowed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "dots.csv"
    path.write_text("frame,u,v\n2,1,1\n0,2,2\n1,3,3\n", encoding="utf-8")
    monkeypatch.setattr(tables, "MOST_UNSORTED_ROWS", 3)
    assert [frame.number for frame in opened(path).frames()] == [0, 1, 2]
    monkeypatch.setattr(tables, "MOST_UNSORTED_ROWS", 2)
    with pytest.raises(RecordingError, match="found more than 2 rows, which are not in the order"):
        list(opened(path).frames())


def test_a_frame_of_more_detections_than_allowed_is_told_with_its_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "dots.csv"
    path.write_text("frame,u,v\n0,1,1\n1,2,2\n1,3,3\n1,4,4\n", encoding="utf-8")
    monkeypatch.setattr(tables, "MOST_DETECTIONS", 3)
    assert len(list(opened(path).frames())) == 2
    monkeypatch.setattr(tables, "MOST_DETECTIONS", 2)
    frames = opened(path).frames()
    assert next(frames).number == 0
    with pytest.raises(RecordingError, match="line 5: found more than 2 detections in frame 1"):
        next(frames)


def test_a_frame_that_changes_its_size_or_is_damaged_is_told() -> None:
    held = MagicMock()
    held.retrieve.return_value = True, np.zeros((10, 12, 1), np.uint8)
    assert capture.retrieve(held, "clip.avi", 4, (12, 10)).shape == (10, 12)
    with pytest.raises(RecordingError, match="frame 4 has 12x10 pixels, allowed is 10x12"):
        capture.retrieve(held, "clip.avi", 4, (10, 12))
    for answer in ((False, np.zeros((10, 12), np.uint8)), (True, None)):
        held.retrieve.return_value = answer
        with pytest.raises(RecordingError, match="frame 4 cannot be decoded"):
            capture.retrieve(held, "clip.avi", 4, None)
