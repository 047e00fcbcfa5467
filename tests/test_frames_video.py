"""Video sources: numbers, times, and files that end before they should."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from mixpose.errors import RecordingError
from mixpose.frames import Source, SourceSpec, open_source
from mixpose.frames.containers import missing_bytes
from mixpose.records import RawFrame

COUNT = 30
FPS = 25.0
CONTAINERS = [("clip.avi", "MJPG"), ("clip.mp4", "mp4v"), ("clip.mkv", "FFV1")]


def write_video(path: Path, codec: str, count: int = COUNT) -> Path:
    """Frame n is of grey level 4 n, with some noise so that frames are of a real size."""
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*codec), FPS, (96, 64))
    noise = np.random.default_rng(0).integers(0, 40, (64, 96, 1), dtype=np.uint8)
    for number in range(count):
        writer.write(np.repeat(noise + np.uint8(4 * number), 3, axis=2))
    writer.release()
    return path


def video(path: Path, **options: object) -> Source:
    return open_source(SourceSpec("left", path.name, path.parent, "camera", **options))  # type: ignore[arg-type]


def pixels(frame: RawFrame) -> NDArray[np.number[Any]]:
    assert isinstance(frame.data, np.ndarray)
    return frame.data


def read(path: Path) -> tuple[list[RawFrame], str]:
    """Frames that come before the error, and the error."""
    frames: list[RawFrame] = []
    try:
        for frame in video(path).frames():
            frames.append(frame)
    except RecordingError as error:
        return frames, str(error)
    return frames, ""


def truncate(path: Path, kept: float) -> None:
    data = path.read_bytes()
    path.write_bytes(data[: int(kept * len(data))])


def boxes(data: bytes) -> dict[bytes, bytes]:
    """Outermost boxes of an MP4 file."""
    found, at = {}, 0
    while at < len(data):
        size = int.from_bytes(data[at : at + 4])
        found[data[at + 4 : at + 8]] = data[at : at + size]
        at += size
    return found


def index_first(data: bytes) -> bytes:
    """Move the index of an MP4 file to its front, as for the web."""
    parts = boxes(data)
    index = bytearray(parts.pop(b"moov"))
    at = index.find(b"stco")
    for entry in range(int.from_bytes(index[at + 8 : at + 12])):
        place = slice(at + 12 + 4 * entry, at + 16 + 4 * entry)
        index[place] = (int.from_bytes(index[place]) + len(index)).to_bytes(4)
    return parts.pop(b"ftyp") + bytes(index) + b"".join(parts.values())


@pytest.mark.parametrize(("name", "codec"), CONTAINERS)
def test_whole_video_is_read_to_its_end(tmp_path: Path, name: str, codec: str) -> None:
    path = write_video(tmp_path / name, codec)
    frames, error = read(path)
    assert error == ""
    assert [frame.number for frame in frames] == list(range(COUNT))
    for frame in frames:
        assert frame.time_s == pytest.approx(frame.number / FPS, abs=1e-3)
        # Frame n is 4 n brighter than the first; lossy codecs keep that to a grey level.
        brighter = pixels(frame).mean() - pixels(frames[0]).mean()
        assert brighter == pytest.approx(4 * frame.number, abs=1)
    assert pixels(frames[0]).shape == (64, 96)
    assert video(path).describe() == "video 96x64, frames 0-29"


@pytest.mark.parametrize(("name", "codec"), CONTAINERS)
def test_skipped_frames_keep_the_numbers_of_the_others(
    tmp_path: Path, name: str, codec: str
) -> None:
    path = write_video(tmp_path / name, codec)
    frames = list(video(path).frames(4, 20, 7))
    assert [frame.number for frame in frames] == [4, 11, 18]
    every = list(video(path).frames())
    for frame in frames:
        assert frame.time_s == every[frame.number].time_s
        np.testing.assert_array_equal(pixels(frame), pixels(every[frame.number]))


@pytest.mark.parametrize(("name", "codec"), [CONTAINERS[0], CONTAINERS[2]])
@pytest.mark.parametrize("kept", [0.3, 0.6, 0.9])
def test_truncated_video_is_told_after_its_whole_frames(
    tmp_path: Path, name: str, codec: str, kept: float
) -> None:
    path = write_video(tmp_path / name, codec)
    truth, _ = read(path)
    truncate(path, kept)
    frames, error = read(path)
    # The frames are of about equal size, so that `kept` of the bytes hold about as many frames.
    assert abs(len(frames) - kept * COUNT) <= 4
    assert f"{name}: cut short" in error
    assert f"frames 0-{len(frames) - 1} of the {COUNT}" in error
    assert "\n" not in error
    for frame, true in zip(frames, truth, strict=False):
        np.testing.assert_array_equal(pixels(frame), pixels(true))


def test_stop_before_the_cut_is_no_error(tmp_path: Path) -> None:
    path = write_video(tmp_path / "clip.avi", "MJPG")
    truncate(path, 0.6)
    assert [frame.number for frame in video(path).frames(stop=10)] == list(range(10))


def test_truncated_mp4_without_its_index_is_told_when_opened(tmp_path: Path) -> None:
    path = write_video(tmp_path / "clip.mp4", "mp4v")
    truncate(path, 0.6)
    with pytest.raises(RecordingError, match=r"clip\.mp4: cut short.*frame 0"):
        video(path)


def test_truncated_mp4_with_its_index_first_is_read_as_far_as_it_goes(tmp_path: Path) -> None:
    path = write_video(tmp_path / "clip.mp4", "mp4v")
    path.write_bytes(index_first(path.read_bytes()))
    frames, error = read(path)
    assert (len(frames), error) == (COUNT, "")
    truncate(path, 0.6)
    frames, error = read(path)
    assert 5 < len(frames) < 25
    assert "clip.mp4: cut short" in error


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no named pipes here")
@pytest.mark.parametrize("first", [True, False])
def test_an_mp4_in_a_pipe_is_read_or_refused_by_where_its_index_is(
    first: bool, tmp_path: Path
) -> None:
    data = write_video(tmp_path / "clip.mp4", "mp4v").read_bytes()
    # more than a decoder holds: it cannot go back to frames before an index at the end
    parts = boxes(data)
    spare = (8 + 2**17).to_bytes(4) + b"free" + bytes(2**17)
    assert list(parts)[-1] == b"moov"
    data = index_first(data) if first else data.replace(parts[b"moov"], spare + parts[b"moov"])
    os.mkfifo(tmp_path / "pipe")

    def write() -> None:
        with contextlib.suppress(BrokenPipeError):
            (tmp_path / "pipe").write_bytes(data)

    writer = threading.Thread(target=write, daemon=True)
    writer.start()
    frames, error = read(tmp_path / "pipe")
    writer.join()
    assert len(frames) == (COUNT if first else 0)
    assert ("has its index at its end" in error) != first


def test_trimmed_mp4_is_whole_though_it_counts_hidden_frames(tmp_path: Path) -> None:
    path = write_video(tmp_path / "clip.mp4", "mp4v")
    data = bytearray(path.read_bytes())
    ticks = data.find(b"mdhd") + 16
    hidden = round(10 / FPS * int.from_bytes(data[ticks : ticks + 4]))
    start = data.find(b"elst") + 16
    data[start : start + 4] = hidden.to_bytes(4)
    path.write_bytes(data)
    frames, error = read(path)
    assert (len(frames), error) == (20, "")


def test_frames_lost_in_the_middle_of_an_avi_are_told(tmp_path: Path) -> None:
    path = write_video(tmp_path / "clip.avi", "MJPG")
    data = bytearray(path.read_bytes())
    middle = len(data) // 2
    data[middle : middle + 12000] = bytes(12000)
    path.write_bytes(data)
    frames, error = read(path)
    assert 10 < len(frames) < COUNT
    assert f"damaged or cut short; only frames 0-{len(frames) - 1}" in error


def test_the_last_frame_of_an_avi_is_missed_though_it_alone_is_lost(tmp_path: Path) -> None:
    path = write_video(tmp_path / "clip.avi", "MJPG")
    data = bytearray(path.read_bytes())
    index = data.rfind(b"idx1")
    last = data.rfind(b"00dc", 0, index)
    data[last:index] = bytes(index - last)
    path.write_bytes(data)
    frames, error = read(path)
    assert len(frames) == COUNT - 1
    assert f"cut short; only frames 0-{COUNT - 2} of the {COUNT} that it promises" in error


def test_file_that_is_no_video_is_told(tmp_path: Path) -> None:
    path = tmp_path / "clip.mov"
    path.write_text("not a video")
    with pytest.raises(RecordingError, match=r"clip\.mov: opens neither as an image nor"):
        video(path)


def test_resolution_of_a_video_must_be_the_sensors(tmp_path: Path) -> None:
    path = write_video(tmp_path / "clip.avi", "MJPG", count=2)
    with pytest.raises(RecordingError, match=r"found 96x64 .* 640x480"):
        video(path, resolution=(640, 480))


def test_rate_of_the_session_overrides_the_times_of_the_video(tmp_path: Path) -> None:
    path = write_video(tmp_path / "clip.avi", "MJPG", count=3)
    assert [frame.time_s for frame in video(path, fps=100.0).frames()] == [0.0, 0.01, 0.02]


def test_sixteen_bit_video_keeps_its_depth(tmp_path: Path) -> None:
    path = tmp_path / "deep.mkv"
    deep = (np.arange(64 * 48).reshape(48, 64) * 20).astype(np.uint16)
    options = [cv2.VIDEOWRITER_PROP_DEPTH, cv2.CV_16U, cv2.VIDEOWRITER_PROP_IS_COLOR, 0]
    codec = cv2.VideoWriter.fourcc(*"FFV1")
    writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, codec, FPS, (64, 48), options)
    writer.write(deep)
    writer.release()
    (frame,) = video(path).frames()
    np.testing.assert_array_equal(pixels(frame), deep)


def test_source_can_be_read_again(tmp_path: Path) -> None:
    source = video(write_video(tmp_path / "clip.avi", "MJPG", count=4))
    assert [len(list(source.frames())) for _ in range(2)] == [4, 4]


def test_address_of_a_stream_is_left_to_the_decoder(tmp_path: Path) -> None:
    path = write_video(tmp_path / "clip.avi", "MJPG", count=3)
    address = path.as_uri()
    source = open_source(SourceSpec("left", address, Path("elsewhere"), "camera"))
    assert source.length is None
    assert source.describe() == f"video stream {address}"
    assert [frame.number for frame in source.frames()] == [0, 1, 2]


def test_structure_of_whole_and_unfinished_files_promises_no_more(tmp_path: Path) -> None:
    for name, codec in CONTAINERS:
        path = write_video(tmp_path / name, codec, count=3)
        assert missing_bytes(path) == 0
        path.write_bytes(path.read_bytes() + bytes(1000))
        assert missing_bytes(path) == 0
    unfinished = bytearray((tmp_path / "clip.avi").read_bytes())
    for size in (bytes(4), b"\xff" * 4):  # of a recorder that was cut off, and of a stream
        unfinished[4:8] = size
        (tmp_path / "unfinished.avi").write_bytes(unfinished)
        assert missing_bytes(tmp_path / "unfinished.avi") == 0


def test_decoders_print_nothing_about_broken_files(tmp_path: Path) -> None:
    videos = [write_video(tmp_path / name, codec) for name, codec in CONTAINERS]
    for path in videos:
        truncate(path, 0.6)
    (tmp_path / "stub.avi").write_bytes(videos[0].read_bytes()[:300])  # within its headers
    videos.append(tmp_path / "stub.avi")
    images = [tmp_path / "f1.png", tmp_path / "f2.jpg", tmp_path / "f3.bmp"]
    for path in images:
        cv2.imwrite(str(path), np.zeros((90, 90), np.uint8))
        truncate(path, 0.6)
    script = (
        "import sys\n"
        "from pathlib import Path\n"
        "from mixpose.errors import RecordingError\n"
        "from mixpose.frames import SourceSpec, open_source\n"
        "for name in sys.argv[1:]:\n"
        "    try:\n"
        "        list(open_source(SourceSpec('left', name, Path(), 'camera')).frames())\n"
        "    except RecordingError:\n"
        "        print('told')\n"
    )
    files = [str(path) for path in videos + images]
    done = subprocess.run(
        [sys.executable, "-c", script, *files],
        capture_output=True,
        text=True,
        check=True,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
    )
    assert done.stdout.split() == ["told"] * len(files)
    assert done.stderr == ""


@pytest.mark.parametrize(
    ("bgr", "grey"), [((0, 0, 200), 60), ((0, 200, 0), 117), ((200, 0, 0), 23)]
)
def test_colours_of_a_video_become_as_grey_as_they_look(
    tmp_path: Path, bgr: tuple[int, int, int], grey: int
) -> None:
    path = tmp_path / "clip.mkv"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"FFV1"), FPS, (96, 64))
    for _ in range(3):
        writer.write(np.full((64, 96, 3), bgr, np.uint8))
    writer.release()
    (frame, *_), error = read(path)
    assert error == ""
    # 0.299 of red, 0.587 of green and 0.114 of blue; the codec's colours round by a grey level
    np.testing.assert_allclose(pixels(frame), grey, atol=2)
