"""Sign pictures and videos, so that mixpose overwrites only files that it wrote."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import cv2
import numpy as np

from mixpose.errors import SessionError, reporting
from mixpose.pictures.canvas import Picture
from mixpose.whole_files import appearing_whole

SIGNATURE = b"mixpose picture"
_PNG_HEAD = 33  # bytes of a PNG's signature and its first chunk
_LOOK_AT = 1024  # bytes at either end of a file that are searched for the signature


def write_png(path: Path, picture: Picture) -> None:
    """Write a picture (H, W, 3) as a PNG with the signature, or raise a `SessionError`."""
    encoded, data = cv2.imencode(".png", picture, [cv2.IMWRITE_PNG_COMPRESSION, 3])
    if not encoded:
        raise SessionError(f"{path}: a picture of {picture.shape} cannot be made a PNG")
    with reporting(SessionError, f"{path}: cannot be written"), appearing_whole(path) as part:
        part.write_bytes(_signed(np.asarray(data).tobytes()))


def sign_figure(path: Path) -> None:
    """Put the signature into a PNG, or in a comment after the end of an SVG or a PDF."""
    content, suffix = path.read_bytes(), path.suffix.casefold()
    if suffix == ".png":
        path.write_bytes(_signed(content))
    else:
        comment = {".svg": b"<!-- " + SIGNATURE + b" -->\n", ".pdf": b"% " + SIGNATURE + b"\n"}
        path.write_bytes(content + comment[suffix])


def _signed(png: bytes) -> bytes:
    """Insert the signature into a PNG as its second chunk."""
    body = b"tEXt" + b"Software\0" + SIGNATURE
    chunk = struct.pack(">I", len(body) - 4) + body + struct.pack(">I", zlib.crc32(body))
    return png[:_PNG_HEAD] + chunk + png[_PNG_HEAD:]


def sign_video(path: Path) -> None:
    """Append the signature to a video in an element that its container lets players skip."""
    text = SIGNATURE + b" " * (len(SIGNATURE) % 2)
    elements = {
        ".mp4": struct.pack(">I4s", 8 + len(text), b"free") + text,
        ".avi": b"JUNK" + struct.pack("<I", len(text)) + text,
        ".mkv": b"\xec" + bytes([0x80 | len(text)]) + text,
    }
    with path.open("ab") as stream:
        stream.write(elements[path.suffix.casefold()])


def is_ours(path: Path) -> bool:
    """Test whether a file is empty or has the signature."""
    with path.open("rb") as stream:
        beginning = stream.read(_LOOK_AT)
        size = stream.seek(0, 2)
        stream.seek(max(size - _LOOK_AT, 0))
        end = stream.read(_LOOK_AT)
    return size == 0 or SIGNATURE in beginning or SIGNATURE in end


def refuse_foreign(path: Path, option: str) -> None:
    """Raise a `SessionError` if the path is a folder, or a file that mixpose did not write."""
    if path.is_dir():
        raise SessionError(f"{option}: {path} is a folder where a file is to be written")
    if path.is_file() and not is_ours(path):
        raise SessionError(
            f"{option}: {path} holds something that mixpose did not write; name another place"
        )
