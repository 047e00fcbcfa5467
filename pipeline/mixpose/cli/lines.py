"""A file that grows line by line and always ends at a whole one, whatever happens to the disk."""

from __future__ import annotations

import os
import sys
import time
import zlib
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from mixpose.errors import SessionError

PATIENCE_S = 10.0
"""How long another run, which may be about to end, is waited for."""


def note_path(poses: Path) -> Path:
    """Where the note about a poses file lies."""
    return poses.with_name(f".{poses.name}.state")


class LineFile:
    """What the writers of poses take for a text stream.

    What is written between two flushes reaches the file in one call or not at all. What was there
    goes (`afresh`), or stays until `rewind` says where to go on; messages call the file `called`.
    No two runs write to one file: it is locked, as far as the system can. Raises SessionError if it
    cannot be opened, or another run writes to it.
    """

    def __init__(self, path: Path, *, afresh: bool = True, called: Path | None = None) -> None:
        self._path = called or path
        self._due: list[str] = []
        self.size = self.checksum = 0
        try:
            self._file = os.open(path, os.O_WRONLY | os.O_CREAT | getattr(os, "O_BINARY", 0), 0o666)
        except OSError as error:
            raise SessionError(f"-o {self._path}: cannot be written: {error.strerror}") from error
        try:
            _lock(self._file, self._path)
            if afresh and path.is_file():
                self.rewind(0, 0)
        except BaseException:
            os.close(self._file)
            raise

    def rewind(self, size: int, checksum: int) -> None:
        """Cut the file down to its first bytes, of this CRC-32, and go on there."""
        os.ftruncate(self._file, size)
        os.lseek(self._file, size, os.SEEK_SET)
        self.size, self.checksum = size, checksum

    def write(self, text: str) -> int:
        """Take text, to be written by the next `flush`."""
        self._due.append(text)
        return len(text)

    def flush(self) -> None:
        """Write what is due.

        Raises SessionError if it cannot be written; the file is then as it was before. Raises
        BrokenPipeError if nobody reads a pipe any more.
        """
        data = "".join(self._due).encode("utf-8")
        self._due = []
        left = memoryview(data)
        try:
            while left:
                left = left[os.write(self._file, left) :]
        except BrokenPipeError:
            raise
        except OSError as error:
            with suppress(OSError):
                os.ftruncate(self._file, self.size)
            raise SessionError(
                f"-o {self._path}: cannot be written: {error.strerror}; the lines before are whole"
            ) from error
        self.size += len(data)
        self.checksum = zlib.crc32(data, self.checksum)

    def close(self) -> None:
        """Let go of the file; what is due is not written."""
        os.close(self._file)


@contextmanager
def held(folder: Path, called: Path) -> Iterator[None]:
    """Keep other runs from a folder, as far as the system can; SessionError if one holds it."""
    if sys.platform == "win32":  # which opens no folder
        yield
        return
    file = os.open(folder, os.O_RDONLY)
    try:
        _lock(file, called)
        yield
    finally:
        os.close(file)


def _lock(file: int, path: Path) -> None:
    """Keep other runs from a file until it is closed; the lock ends with the process."""
    try:
        import fcntl  # noqa: PLC0415 - POSIX only
    except ImportError:
        return
    deadline = time.monotonic() + PATIENCE_S
    while True:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            if time.monotonic() > deadline:
                raise SessionError(
                    f"-o {path}: another run is writing there; wait for it, or name another place"
                ) from error
            time.sleep(0.05)
        except OSError:
            return  # a file system without locks
        else:
            return
