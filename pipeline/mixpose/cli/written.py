"""Texts that a command writes, whole or not at all."""

from __future__ import annotations

from pathlib import Path

from mixpose.errors import SessionError
from mixpose.whole_files import appearing_whole


def write_text(path: Path, text: str, option: str) -> None:
    """Write a text to the file that an option names.

    Raises SessionError if it cannot be written.
    """
    try:
        with appearing_whole(path) as part:
            part.write_text(text, encoding="utf-8", newline="\n")
    except OSError as error:
        raise SessionError(f"{option} {path}: cannot be written: {error.strerror}") from error
