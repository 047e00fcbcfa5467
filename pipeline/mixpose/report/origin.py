"""The session that poses came from, as far as it can still be read."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path

from mixpose.errors import SessionError
from mixpose.poses.jsonl import PoseFile
from mixpose.session import Session, load_session

_LARGEST = 2_000_000  # bytes; no session file is near it


@dataclass(frozen=True)
class Origin:
    """What is known of the session file."""

    named: str | None = None  # path in the header of the poses
    path: Path | None = None  # where it was found
    text: str | None = None  # its text
    notice: str | None = None  # what is wrong: missing, changed, no session any more
    # only if the file is the very one that the poses were estimated with
    session: Session | None = None


def find_session(poses: PoseFile) -> Origin:
    """Read the session file that the header names, or its like beside the poses.

    A file that is not the one of the run is shown only if it is a session file: a header may name
    any file, and whoever passes the page on should not pass on that.
    """
    named = poses.header.get("session")
    if not isinstance(named, str) or not named:
        return Origin(notice="The poses file names no session file.")
    wanted = poses.header.get("session_sha256")
    found = [
        (path, content)
        for path in (Path(named), poses.path.parent / Path(named).name)
        if (content := _content(path)) is not None
    ]
    if not found:
        return Origin(named, notice=f"The session file {named} is missing or cannot be read.")
    for path, content in found:
        if hashlib.sha256(content).hexdigest() == wanted:
            text = content.decode("utf-8-sig", errors="replace")
            try:
                return Origin(named, path, text, session=load_session(path))
            except SessionError as error:
                return Origin(named, path, text, f"The session cannot be read again: {error}")
    path, content = found[0]
    notice = f"The poses file states no SHA-256, so {path} may have changed since the run."
    if isinstance(wanted, str):
        notice = f"{path} has changed since the run: its SHA-256 is not the one in the poses file."
    try:
        load_session(path)
    except SessionError:
        return Origin(named, path, notice=f"{notice} It is no session file now and is not shown.")
    return Origin(named, path, content.decode("utf-8-sig", errors="replace"), notice)


def _content(path: Path) -> bytes | None:
    try:
        if path.is_file() and path.stat().st_size <= _LARGEST:
            return path.read_bytes()
    except OSError:
        return None
    return None
