"""Test whether a video file is whole: the sizes that its outermost parts state must fit into it.

A decoder reports the end of a truncated file like any other, and the number of frames in a
container may be an estimate.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import BinaryIO, Literal, TypeAlias

Container: TypeAlias = Literal["avi", "mp4", "matroska"]

_MP4_BOXES = frozenset(
    b"ftyp moov mdat free skip wide moof mfra sidx styp uuid meta udta pnot prft emsg PICT".split()
)
_EBML_HEADER = b"\x1a\x45\xdf\xa3"
_SLACK_BYTES = 8  # writers pad and count differently; frames are never this small


def container_of(path: Path) -> Container | None:
    """Return the kind of container by content, or None; OSError if it cannot be read."""
    with path.open("rb") as file:
        head = file.read(12)
    if head[:4] == b"RIFF" and head[8:] == b"AVI ":
        return "avi"
    if head[4:8] in _MP4_BOXES:
        return "mp4"
    return "matroska" if head[:4] == _EBML_HEADER else None


def missing_bytes(path: Path) -> int:
    """Return how many bytes a video file lacks, 0 if unknown; OSError if it cannot be read."""
    container = container_of(path)
    if container is None:
        return 0
    with path.open("rb") as file:
        size = file.seek(0, os.SEEK_END)
        if container == "matroska":
            missing = _matroska_end(file) - size
        else:
            length_of, offset = _riff_length if container == "avi" else _mp4_length, 0
            while offset + 8 <= size:
                file.seek(offset)
                if not (length := length_of(file.read(16))):
                    break
                offset += length
            missing = offset - size
    return missing if missing > _SLACK_BYTES else 0


def _riff_length(head: bytes) -> int:
    """Return the length of a RIFF part, of which long AVI files have several (OpenDML), or 0."""
    length = int.from_bytes(head[4:8], "little")
    # interrupted recorders leave a size of 0, streams one of all ones
    is_known = head[:4] == b"RIFF" and length not in (0, 2**32 - 1)
    return 8 + length + length % 2 if is_known else 0


def _mp4_length(head: bytes) -> int:
    """Return the length of a box (ISO/IEC 14496-12, section 4.2); 0 for padding."""
    length = int.from_bytes(head[:4])
    if length == 1:
        length = int.from_bytes(head[8:])
    # 0 means up to the end of the file
    return length if head[4:8] in _MP4_BOXES and length >= 8 else 0


def _matroska_end(file: BinaryIO) -> int:
    """Return the end of the segment behind the EBML header (RFC 8794); 0 if its size is unknown."""
    offset = 0
    for _ in ("header", "segment"):
        file.seek(offset)
        head = file.read(12)
        if len(head) < 5 or head[4] == 0:
            return 0
        width = 9 - head[4].bit_length()
        mask = (1 << 7 * width) - 1
        length = int.from_bytes(head[4 : 4 + width]) & mask
        if length == mask:
            return 0
        offset += 4 + width + length
    return offset
