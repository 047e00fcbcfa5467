"""Cameras, streams and pipes as they run: what is read, what is passed over, how they end."""

from __future__ import annotations

import http.server
import os
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from command_line import LONGEST_S, wait_until
from numpy.typing import NDArray

from mixpose.errors import RecordingError, SessionError
from mixpose.frames import SourceSpec, capture, live, open_source, pair
from mixpose.frames.source import Source
from mixpose.records import Moment, PointPattern, RawFrame

SYNTHETIC = Path(__file__).parents[1] / "data" / "synthetic"
NOTHING = PointPattern(np.empty((0, 2)), np.empty(0))
CLIP = SYNTHETIC / "one_camera_video" / "camera.avi"
needs_pipes = pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no named pipes here")


def opened(source: str | Path) -> Source:
    return open_source(SourceSpec("s1", str(source), Path(), "camera"))


def numbered(number: int) -> bytes:
    """A JPEG whose grey value tells its number, up to 24."""
    found, data = cv2.imencode(".jpg", np.full((48, 64), 10 * (number % 25), np.uint8))
    assert found
    return data.tobytes()


def number_in(image: Any) -> int:
    return round(float(np.mean(image)) / 10)


class Camera(http.server.BaseHTTPRequestHandler):
    """Sends `/clip.avi` as a file, and anything else as a camera in the network sends JPEGs."""

    frames = 20
    period_s = 0.03
    sent = 0

    def do_GET(self) -> None:
        self.send_response(200)
        if self.path == "/clip.avi":
            self.end_headers()
            self.wfile.write(CLIP.read_bytes())
            return
        self.send_header("Content-Type", "multipart/x-mixed-replace; boundary=next")
        self.end_headers()
        Camera.sent = 0
        for number in range(self.frames):
            data = numbered(number)
            head = f"--next\r\nContent-Type: image/jpeg\r\nContent-Length: {len(data)}\r\n\r\n"
            try:
                self.wfile.write(head.encode() + data + b"\r\n")
            except ConnectionError:  # the reader has seen enough
                return
            Camera.sent = number + 1
            time.sleep(self.period_s)

    def log_message(self, *_: object) -> None:
        pass


@pytest.fixture
def server() -> Iterator[str]:
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Camera) as running:
        thread = threading.Thread(target=running.serve_forever, args=(0.05,))
        thread.start()
        yield f"http://127.0.0.1:{running.server_address[1]}"
        running.shutdown()
        thread.join()


@pytest.fixture
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    # a busy machine holds up frames for a good part of a second
    monkeypatch.setattr(capture, "PATIENCE_S", 3.0)


@contextmanager
def piped(path: Path, write: Callable[[Any], None]) -> Iterator[Path]:
    """A named pipe that a thread writes to."""
    os.mkfifo(path)

    def work() -> None:
        try:
            with path.open("wb") as stream:
                write(stream)
        except BrokenPipeError:
            pass

    thread = threading.Thread(target=work)
    thread.start()
    yield path
    thread.join()


def images_of(source: Source) -> list[NDArray[np.uint8]]:
    return [np.asarray(frame.data) for frame in source.frames()]


@needs_pipes
def test_pipe_gives_every_frame_of_the_file_sent_through_it(tmp_path: Path) -> None:
    with piped(tmp_path / "left", lambda stream: stream.write(CLIP.read_bytes())) as pipe:
        source = opened(pipe)
        assert source.length is None
        found = []
        for frame in source.frames():
            time.sleep(0.002)  # slower than the frames come
            found.append(np.asarray(frame.data))
    expected = images_of(opened(CLIP))
    assert len(found) == 60
    assert all(np.array_equal(a, b) for a, b in zip(found, expected, strict=True))


@needs_pipes
def test_pipe_of_bare_jpegs_gives_every_frame(tmp_path: Path) -> None:
    def write(stream: Any) -> None:
        for number in range(20):
            stream.write(numbered(number))

    with piped(tmp_path / "left.mjpeg", write) as pipe:
        assert [number_in(image) for image in images_of(opened(pipe))] == list(range(20))


@needs_pipes
def test_descriptors_of_pipes_are_given_back(tmp_path: Path) -> None:
    before = len(list(Path("/dev/fd").iterdir()))
    with piped(tmp_path / "left", lambda stream: stream.write(CLIP.read_bytes())) as pipe:
        images_of(opened(pipe))
    assert len(list(Path("/dev/fd").iterdir())) == before


@needs_pipes
@pytest.mark.usefixtures("impatient")
def test_pipe_that_nobody_writes_to_is_told(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "left")
    with pytest.raises(RecordingError, match=r"left: nothing was written to this pipe for 3 s"):
        next(opened(tmp_path / "left").frames())


@needs_pipes
@pytest.mark.usefixtures("impatient")
def test_pipe_whose_writer_falls_silent_is_told_after_the_frames_that_came(tmp_path: Path) -> None:
    enough = threading.Event()

    def write(stream: Any) -> None:
        stream.write(CLIP.read_bytes()[:200_000])
        stream.flush()
        enough.wait(LONGEST_S)

    with piped(tmp_path / "left", write) as pipe:
        found: list[RawFrame] = []
        with pytest.raises(RecordingError, match=r"left: no frame came for 3 s"):
            found.extend(opened(pipe).frames())
        enough.set()
    assert 15 < len(found) < 40  # 200 of 470 kB hold about 25 of the 60 frames


def test_video_file_on_a_server_gives_every_frame(server: str) -> None:
    source = opened(f"{server}/clip.avi")
    assert source.kind == "video"
    assert len(images_of(source)) == 60


def test_live_stream_gives_its_frames_in_order_and_ends_with_the_last(server: str) -> None:
    source = opened(f"{server}/live")
    assert source.kind == "live"
    frames = list(source.frames())
    numbers = [frame.number for frame in frames]
    assert numbers == sorted(set(numbers))
    assert numbers[-1] == Camera.frames - 1
    assert [number_in(frame.data) for frame in frames] == numbers
    times = [frame.time_s for frame in frames if frame.time_s is not None]
    assert len(times) == len(numbers)
    assert all(a < b for a, b in pairwise(times))
    # sent every 30 ms in 0.57 s; the first few come together, when FFmpeg has seen enough
    assert 0.25 < times[-1] - times[0] < 20


def test_slow_consumer_of_a_live_stream_gets_the_newest_frame(server: str) -> None:
    numbers = []
    for frame in opened(f"{server}/live").frames():
        numbers.append(frame.number)
        # ten frames come meanwhile, however slowly they do, or the last
        enough = min(Camera.sent + 10, Camera.frames)
        wait_until(lambda enough=enough: Camera.sent >= enough)  # type: ignore[misc]
        time.sleep(10 * Camera.period_s)  # and arrive
    assert numbers[-1] == Camera.frames - 1
    assert len(numbers) <= 10  # of 20; three or four where the machine is not busy


def test_live_cameras_are_paired_by_arrival_and_end_with_the_last(server: str) -> None:
    sources = {"left": opened(f"{server}/left"), "right": opened(f"{server}/right")}
    sets = list(pair(sources))
    assert [s.number for s in sets] == sorted({s.number for s in sets})
    both = [s for s in sets if set(s.frames) == {"left", "right"}]
    assert both
    assert sets[: len(both)] == both  # where one has ended, the other goes on alone
    for each in both:
        times = [frame.time_s for frame in each.frames.values() if frame.time_s is not None]
        assert abs(times[0] - times[1]) < 0.5  # a frame comes every 0.03 s
        assert {frame.number for frame in each.frames.values()} == {each.number}


def test_selected_frames_of_a_live_stream_end_the_reading(server: str) -> None:
    numbers = [frame.number for frame in pair({"s1": opened(f"{server}/live")}, 2, 9)]
    assert numbers
    assert min(numbers) >= 2
    assert max(numbers) < 9


def test_no_frame_is_waited_for_after_the_last_that_is_wanted(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    class Reader(nullcontext[Any]):
        has_ended = False

        def wait(self, after: int, _: object) -> None:
            assert after < 2

        def newer_than(self, number: int) -> list[RawFrame]:
            return [RawFrame(number + 1, 0.0, NOTHING, Moment(0.0, "arrival"))]

    monkeypatch.setattr(Reader, "__enter__", lambda self: self)
    monkeypatch.setattr(live, "_Reader", lambda *_: Reader())
    source = opened("http://127.0.0.1:9/live")
    assert [frame.number for frame in source.frames(1, 3)] == [1, 2]


def test_live_source_beside_a_recording_is_refused(server: str) -> None:
    with pytest.raises(SessionError, match="'b' is live and 'a' is a recording"):
        pair({"a": opened(CLIP), "b": opened(f"{server}/live")})


@pytest.mark.usefixtures("impatient")
@pytest.mark.parametrize("source", ["http://127.0.0.1:9/live", "udp://127.0.0.1:9", "camera:97"])
def test_live_source_that_does_not_open_is_told_in_time(source: str) -> None:
    began = time.monotonic()
    with pytest.raises(RecordingError, match=f"^{source}: does not open$"):
        next(opened(source).frames())
    assert time.monotonic() - began < 20  # OpenCV left to itself waits for 30 s


class Stalling(Camera):
    """Sends six frames to each who asks, then nothing: the connection stays, as of a hung camera.

    `/gone` sends them to the first only.  Frames go on where the one before ended.
    """

    frames = 6
    sent = 0
    over = threading.Event()

    def do_GET(self) -> None:
        if self.path == "/steady":
            self.frames = Camera.frames
            Camera.do_GET(self)
            return
        if self.path == "/gone" and Stalling.sent:
            self.send_error(503)
            return
        self.send_response(200)
        self.send_header("Content-Type", "multipart/x-mixed-replace; boundary=next")
        self.end_headers()
        for number in range(Stalling.sent, Stalling.sent + self.frames):
            data = numbered(number)
            head = f"--next\r\nContent-Type: image/jpeg\r\nContent-Length: {len(data)}\r\n\r\n"
            self.wfile.write(head.encode() + data + b"\r\n")
            Stalling.sent += 1
            time.sleep(self.period_s)
        if Stalling.sent < 3 * self.frames:
            self.over.wait(LONGEST_S)


@pytest.fixture
def stalling() -> Iterator[str]:
    Stalling.sent = 0
    Stalling.over.clear()
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Stalling) as running:
        thread = threading.Thread(target=running.serve_forever, args=(0.05,))
        thread.start()
        yield f"http://127.0.0.1:{running.server_address[1]}"
        Stalling.over.set()
        running.shutdown()
        thread.join()


@pytest.mark.usefixtures("impatient")
def test_stream_that_stalls_is_opened_again_and_its_frames_count_on(stalling: str) -> None:
    frames = list(opened(f"{stalling}/live").frames())
    numbers = [frame.number for frame in frames]
    assert numbers == sorted(set(numbers))
    # of 18 frames that were sent in three parts; the last of a part may be lost with it
    assert 12 < numbers[-1] < 18
    assert number_in(frames[-1].data) == 17


@pytest.mark.usefixtures("impatient")
def test_stream_that_stays_away_ends_the_reading_with_its_reason(
    stalling: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(live, "RETURN_S", 3.0)
    found: list[RawFrame] = []
    with pytest.raises(RecordingError, match=r"/gone: (does not open|no frame came for 3 s)$"):
        found.extend(opened(f"{stalling}/gone").frames())
    assert found


@pytest.mark.usefixtures("impatient")
def test_camera_goes_on_while_another_one_stalls(
    stalling: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(live, "STALLED_S", 0.2)
    monkeypatch.setattr(Camera, "frames", 300)
    sources = {"hung": opened(f"{stalling}/live"), "steady": opened(f"{stalling}/steady")}
    alone = 0
    for each in pair(sources):
        alone = alone + 1 if set(each.frames) == {"steady"} else 0
        if alone == 3:
            break
    assert alone == 3


class Device:
    """Stands for a camera on the machine: four frames, then its cable is pulled."""

    def __init__(self, index: int) -> None:
        assert index == 3
        self.count = -1

    def isOpened(self) -> bool:
        return True

    def get(self, _: int) -> float:
        return 0.0

    def grab(self) -> bool:
        self.count += 1
        time.sleep(0.03)
        return self.count < 4

    def retrieve(self) -> tuple[bool, NDArray[np.uint8]]:
        return True, np.full((48, 64, 3), 10 * self.count, np.uint8)

    def release(self) -> None:
        pass


def test_camera_is_read_by_its_number_until_it_is_pulled(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cv2, "VideoCapture", Device)
    found: list[RawFrame] = []
    with pytest.raises(RecordingError, match=r"^camera:3: gives no frames any more$"):
        found.extend(opened("camera:3").frames())
    assert [number_in(frame.data) for frame in found] == [frame.number for frame in found]
    assert found[-1].number == 3
