"""Reading the text files that a session consists of."""

from __future__ import annotations

import re
from pathlib import Path

from mixpose.limits import MOST_BYTES
from mixpose.session.messages import BadKeyError

_NO_TEXT = tuple(
    (re.compile(start, re.DOTALL), name)
    for start, name in (
        (rb"\x89PNG|\xff\xd8\xff|BM....\x00\x00|II\*\x00|MM\x00\*|GIF8", "an image"),
        (rb"RIFF....AVI |....ftyp|\x1aE\xdf\xa3", "a video"),
        (rb"%PDF", "a PDF file"),
        (rb"PK\x03\x04|\x1f\x8b", "a packed file"),
    )
)
"""How files begin that are given in place of text by mistake."""


def read_bytes(path: Path) -> bytes:
    """Read a file.

    Raises BadKeyError if there is no such file, it is larger than any session needs, or it cannot
    be read.
    """
    try:
        is_other = path.exists() and not path.is_file()
        size = path.stat().st_size
        content = path.read_bytes() if not is_other and size <= MOST_BYTES else b""
    except FileNotFoundError as error:
        raise BadKeyError(f"no such file: {path}") from error
    except OSError as error:
        raise BadKeyError(f"cannot read {path}: {error.strerror or error}") from error
    except ValueError as error:  # a zero byte in the name
        raise BadKeyError(f"not a file name: {str(path)!r}") from error
    if is_other:
        raise BadKeyError(f"cannot read {path}: found no file; allowed: no folder, pipe or device")
    if size > MOST_BYTES:
        raise BadKeyError(f"{path} has {size} bytes; allowed: at most {MOST_BYTES}")
    return content


def as_text(content: bytes) -> str:
    """Decode UTF-8, with or without the mark that some editors put in front.

    Raises BadKeyError naming what it is in place of text, or the line that is not UTF-8.
    """
    kind = next((name for start, name in _NO_TEXT if start.match(content)), None)
    if kind is not None:
        raise BadKeyError(f"found {kind}; allowed: a text file in UTF-8")
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = content[: error.start].count(b"\n") + 1
        raise BadKeyError(f"not UTF-8 text at line {line}; save the file as UTF-8") from error
