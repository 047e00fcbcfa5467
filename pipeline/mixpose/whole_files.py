"""Files that appear whole or not at all."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


def partial_of(path: Path) -> Path:
    """Where a file is written before it is whole: beside it, hidden, with its suffix."""
    return path.with_name(f".{path.stem}.part{path.suffix}")


@contextmanager
def appearing_whole(path: Path) -> Iterator[Path]:
    """A path to write to, moved to `path` at the end; nothing is left of it after an error.

    What stood at `path` stays until then, and its mode and links to it after that.  A device or a
    pipe is written to as it is.  An OSError that names no file, as that of a full disk, gets the
    name of this one.
    """
    if path.exists() and not path.is_file():
        yield path
        return
    path = Path(os.path.realpath(path)) if path.is_symlink() else path
    part = partial_of(path)
    try:
        yield part
        if path.exists():
            shutil.copymode(path, part)
        os.replace(part, path)  # noqa: PTH105 - also where the file exists, on every system
    except OSError as error:
        error.filename = error.filename or str(path)
        raise
    finally:
        part.unlink(missing_ok=True)
