"""From a poses file back to its session."""

from __future__ import annotations

from pathlib import Path

from mixpose.cli.notices import warn
from mixpose.errors import SessionError
from mixpose.poses.jsonl import PoseFile
from mixpose.session import Session, load_session


def session_of(poses: PoseFile, named: Path | None, *, allow_code: bool = False) -> Session:
    """The session that poses were estimated with: the one `named`, or the one of their header.

    Raises SessionError if it is not there or has another unit.
    """
    path = named
    if path is None:
        found = poses.header.get("session")
        if not isinstance(found, str):
            raise SessionError(f"{poses.path}: names no session; add --session SESSION.toml")
        path = Path(found)
        if not path.is_file():
            path = poses.path.parent / found  # as in truth files, beside their session
        if not path.is_file():
            raise SessionError(
                f"{poses.path}: its session {found} is not there; add --session SESSION.toml"
            )
    session = load_session(path, allow_code=allow_code)
    if poses.unit not in (None, session.unit):
        raise SessionError(
            f"--session {path}: lengths in {session.unit}, but {poses.path} has {poses.unit}"
        )
    if poses.header.get("session_sha256") not in (None, session.sha256):
        warn(f"{path} is not as it was when {poses.path} was written")
    return session
