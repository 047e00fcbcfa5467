"""A file of lines that always ends with a complete line, even if the disk is full."""

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
"""How long to wait for another run, which may be about to end."""


def note_path(poses: Path) -> Path:
    """Return the path of the note about a poses file, from which a run resumes."""
    return poses.with_name(f".{poses.name}.state")


class LineFile:
    """A text stream for the writers of poses.

    Text written between two flushes reaches the file in one call or not at all. Old content is
    removed (`afresh`), or stays until `rewind` says where to continue; messages name `shown`, if
    given. The file is locked against other runs, as far as the system can. Raises SessionError if
    it cannot be opened, or another run writes to it.
    """

    def __init__(self, path: Path, *, afresh: bool = True, shown: Path | None = None) -> None:
        self._path = shown or path
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
        """Cut the file down to its first `size` bytes, of this CRC-32, and continue there."""
        os.ftruncate(self._file, size)
        os.lseek(self._file, size, os.SEEK_SET)
        self.size, self.checksum = size, checksum

    def write(self, text: str) -> int:
        """Keep text to be written by the next `flush`."""
        self._due.append(text)
        return len(text)

    def flush(self) -> None:
        """Write the text since the last flush, or none of it: SessionError, or BrokenPipeError."""
        data = "".join(self._due).encode("utf-8")
        self._due = []
        remaining = memoryview(data)
        try:
            while remaining:
                remaining = remaining[os.write(self._file, remaining) :]
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
        """Close the file without a flush."""
        os.close(self._file)


@contextmanager
def locked_folder(folder: Path, shown: Path) -> Iterator[None]:
    """Lock a folder against other runs, as far as the system can; SessionError if it is locked."""
    if sys.platform == "win32":  # where folders cannot be opened
        yield
        return
    file = os.open(folder, os.O_RDONLY)
    try:
        _lock(file, shown)
        yield
    finally:
        os.close(file)


def _lock(file: int, path: Path) -> None:
    """Lock a file against other runs until it is closed or this process ends."""
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
