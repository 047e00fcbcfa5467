"""Write files that appear complete or not at all."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


def partial_of(path: Path) -> Path:
    """Return the path of a file while it is written: beside it, hidden, with its suffix."""
    return path.with_name(f".{path.stem}.part{path.suffix}")


@contextmanager
def appearing_whole(path: Path) -> Iterator[Path]:
    """Yield a path to write to, moved to `path` at the end and deleted after an error.

    An old file at `path` stays until then; its mode and symbolic links to it are kept.  A device or
    a pipe is written to directly.  An OSError without a file name, as for a full disk, gets that of
    `path`.
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
        os.replace(part, path)  # noqa: PTH105 - replaces an existing file on every system
    except OSError as error:
        error.filename = error.filename or str(path)
        raise
    finally:
        part.unlink(missing_ok=True)
