"""Copy the session file of a recording, to be stored with its frames.

It is copied byte for byte, with the files other than frames that it names.  Only paths that lead
out of its folder are changed, as the recording must contain everything.
"""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path, PurePath
from typing import Any

import tomlkit

from mixpose.errors import SessionError, reporting
from mixpose.session import Session
from mixpose.session.rewriting import paths_in

SESSION_NAME = "session.toml"


@dataclass(frozen=True)
class SessionCopy:
    """A session file and the files that it names."""

    content: bytes  # the session file
    sources: tuple[str | tuple[str, ...], ...]  # sources of the sensors in `content`, in order
    times: Mapping[str, str]  # tables of frame times, with the first sensor that names each
    # marker and calibration files and Python modules: present paths, and paths in the recording
    files: tuple[tuple[Path, str], ...]

    def write(self, folder: Path) -> None:
        """Write the session file and the files that it names into a folder."""
        for origin, name in self.files:
            target = folder / name
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(origin, target)
        (folder / SESSION_NAME).write_bytes(self.content)


def copy_session(session: Session) -> SessionCopy:
    """Read a session file for a recording; a `SessionError` if its files cannot be copied."""
    with reporting(SessionError, f"{session.path}: cannot be read"):
        content = session.path.read_bytes()
    try:
        document = tomlkit.parse(content.decode("utf-8-sig"))
    except ValueError as error:
        raise SessionError(f"{session.path}: changed since it was read; try again") from error
    moved = _moved(session, document)
    files: dict[str, Path] = {}
    times: dict[str, str] = {}
    for container, key, role, owner in paths_in(document):
        old = str(container[key])
        new = moved.get(old, old)
        if old in moved:
            container[key] = new
        if role == "file":
            files[new] = session.folder / old
        elif role == "times":
            times.setdefault(new, owner)
    # Python modules beside the session file that ``method = "module:function"`` names
    methods = {setup.extract.method for setup in session.sensors}
    names = [f"{m.partition(':')[0].replace('.', '/')}.py" for m in sorted(methods) if ":" in m]
    files |= {n: session.folder / n for n in names if (session.folder / n).is_file()}
    if moved:
        content = str(tomlkit.dumps(document)).encode()
    sources = [sensor.get("source", "") for sensor in document.unwrap()["sensor"]]
    sources = [f"camera:{s}" if isinstance(s, int) else s for s in sources]
    listed = tuple(tuple(s) if isinstance(s, list) else s for s in sources)
    origins = tuple((origin, name) for name, origin in files.items())
    return SessionCopy(content, listed, times, origins)


def _moved(session: Session, document: Any) -> dict[str, str]:
    """Return new paths for those that lead out of the session's folder."""
    moved: dict[str, str] = {}
    for container, key, role, owner in paths_in(document):
        old = str(container[key])
        path = PurePath(old)
        leads_out = path.is_absolute() or ".." in path.parts
        # a stream's address is no path; it is refused when files are chosen
        if not leads_out or (role == "source" and "://" in old) or old in moved:
            continue
        new = f"{owner}/{path.name}"
        if new in moved.values():
            raise SessionError(
                f"{session.path}: {role}: found {old!r}, which would be {new} in the recording, "
                "as another file would; use paths inside the session's folder"
            )
        moved[old] = new
    return moved
