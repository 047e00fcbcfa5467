"""Open, advance and convert captures of OpenCV, with errors of one line."""

from __future__ import annotations

import contextlib
import os
import select
import stat
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import cast

import cv2
import numpy as np

from mixpose.errors import RecordingError
from mixpose.frames.containers import container_of
from mixpose.records import Image

PATIENCE_S = 10.0  # longest time for a stream to open, and to deliver its next frame
_PIPE_BYTES = 2**20  # holds a raw frame; else writer and reader alternate every 64 kB
_GREY_FORMATS = (b"Y800", b"Y1\x00\x10")  # tags of FFmpeg for grey videos of 8 and 16 bits


class NotOpenedError(RecordingError):
    """OpenCV cannot open the source."""


class SilentError(RecordingError):
    """A source delivered no frame for too long, and has not ended."""


def is_pipe(address: str) -> bool:
    """Test whether a path leads to a named pipe, or to a standard input that is a pipe."""
    return _has_mode(stat.S_ISFIFO, address)


def is_device(address: str) -> bool:
    """Test whether a path leads to a device, as ``/dev/video0``."""
    return _has_mode(stat.S_ISCHR, address)


def is_stream(address: str) -> bool:
    """Test whether frames come from a stream, pipe or device, and not from a file."""
    return "://" in address or is_pipe(address) or is_device(address)


def _has_mode(kind: Callable[[int], bool], address: str) -> bool:
    with contextlib.suppress(OSError, ValueError):
        return kind(Path(address).stat().st_mode)
    return False


@contextmanager
def opened(address: str | int) -> Iterator[cv2.VideoCapture]:
    """Open a file, pipe, device, address (with ``://``) or camera by index, as a context.

    Grey videos keep their depth. Raises RecordingError if it does not open; a stream or a pipe has
    `PATIENCE_S` for it.
    """
    quieten_opencv()
    with contextlib.ExitStack() as stack:
        capture = _capture(address, stack)
        stack.callback(capture.release)
        if not capture.isOpened():
            raise NotOpenedError(f"{name_of(address)}: does not open")
        tag = np.int32(capture.get(cv2.CAP_PROP_CODEC_PIXEL_FORMAT)).tobytes()
        if tag in _GREY_FORMATS:
            capture.set(cv2.CAP_PROP_CONVERT_RGB, 0)
        yield capture


def _capture(address: str | int, stack: contextlib.ExitStack) -> cv2.VideoCapture:
    if isinstance(address, int):
        return cv2.VideoCapture(address)
    if is_pipe(address):
        address = f"pipe:{_reading_end(address, stack)}"
    elif "://" not in address:
        return cv2.VideoCapture(address, _backend_for(address))
    patience_ms = int(1000 * PATIENCE_S)
    limits = [cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, patience_ms]
    limits += [cv2.CAP_PROP_READ_TIMEOUT_MSEC, patience_ms]
    return cv2.VideoCapture(address, cv2.CAP_FFMPEG, limits)


def _backend_for(address: str) -> int:
    """Return the backend for a file: FFmpeg for AVI, as OpenCV's own reader prints faults."""
    has_ffmpeg = cv2.videoio_registry.hasBackend(cv2.CAP_FFMPEG)
    with contextlib.suppress(OSError):
        if has_ffmpeg and Path(address).is_file() and container_of(Path(address)) == "avi":
            return int(cv2.CAP_FFMPEG)
    return int(cv2.CAP_ANY)


def _reading_end(path: str, stack: contextlib.ExitStack) -> int:
    """Return the descriptor of a pipe that has a writer; it is closed with the stack."""
    # not blocking, so that the time limits of FFmpeg hold if the writer falls silent
    end = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
    stack.callback(os.close, end)
    with contextlib.suppress(ImportError, AttributeError, OSError):  # if pipes cannot be widened
        import fcntl  # noqa: PLC0415 - not on every system

        fcntl.fcntl(end, fcntl.F_SETPIPE_SZ, _PIPE_BYTES)
    # a pipe without a writer reads as ended, but is not readable
    if not select.select([end], [], [], PATIENCE_S)[0]:
        raise RecordingError(f"{path}: nothing was written to this pipe for {PATIENCE_S:g} s")
    return end


def grab(capture: cv2.VideoCapture, address: str | int) -> bool:
    """Go to the next frame; return False at the end; SilentError if a stream falls silent."""
    began = time.monotonic()
    grabbed = capture.grab()
    silence = time.monotonic() - began
    # after that time FFmpeg delivers an incomplete frame
    if silence > 0.9 * PATIENCE_S and (isinstance(address, int) or is_stream(address)):
        raise SilentError(f"{name_of(address)}: no frame came for {PATIENCE_S:g} s")
    return bool(grabbed)


@dataclass
class ColourRoom:
    """The image reused for coloured frames: to allocate one, OpenCV waits for the interpreter."""

    image: cv2.typing.MatLike | None = None  # (H, W, 3 or 4), the last coloured frame


def retrieve(
    capture: cv2.VideoCapture,
    address: str | int,
    number: int,
    expected: tuple[int, int] | None,
    room: ColourRoom | None = None,
) -> Image:
    """Convert the grabbed frame to grey values (H, W), reusing `room`; or raise RecordingError."""
    is_decoded, image = capture.retrieve() if room is None else capture.retrieve(room.image)
    if not is_decoded or image is None:
        raise RecordingError(f"{name_of(address)}: frame {number} cannot be decoded")
    if image.ndim == 3 and image.shape[2] == 1:
        image = image[:, :, 0]
    elif image.ndim == 3:
        if room is not None:
            room.image = image
        code = cv2.COLOR_BGRA2GRAY if image.shape[2] == 4 else cv2.COLOR_BGR2GRAY
        image = cv2.cvtColor(image, code, np.empty(image.shape[:2], image.dtype))
    height, width = image.shape
    if expected is not None and (width, height) != expected:
        raise RecordingError(
            f"{name_of(address)}: frame {number} has {width}x{height} pixels, "
            f"allowed is {expected[0]}x{expected[1]}"
        )
    return cast(Image, image)


def name_of(address: str | int) -> str:
    """Return the name of a source of frames for messages."""
    return f"camera:{address}" if isinstance(address, int) else address


def quieten_opencv() -> None:
    """Silence OpenCV and its FFmpeg, which hide mixpose's lines, unless the user set levels."""
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    if "OPENCV_LOG_LEVEL" not in os.environ:
        cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
