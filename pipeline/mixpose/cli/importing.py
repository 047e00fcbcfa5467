"""``mixpose import``: make a session file from files of other programs."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory

from mixpose.checking import key_warnings, with_image_sizes
from mixpose.cli.app import ImportRequest
from mixpose.cli.notices import counted, say, warn
from mixpose.cli.output import is_stdout, shown, write_text
from mixpose.errors import SessionError
from mixpose.importing import Imported, gather, session_text
from mixpose.session import Session, load_session


def import_files(request: ImportRequest) -> None:
    """Write a session file, which must be new, and print a summary on standard error."""
    output, unit = request.output, request.unit
    if output.exists() and not is_stdout(output):
        raise SessionError(f"-o {output}: is there already; name a new file")
    if not output.parent.is_dir():
        raise SessionError(f"-o {output}: there is no folder {output.parent}")
    imported = gather(request.files, unit, request.lengths)
    session = _written(imported, output)
    for warning in (*imported.warnings, *key_warnings(with_image_sizes(session, {}))):
        warn(warning)
    if not imported.bodies:
        warn("no file of a body is among them: [object] is an example, put in your markers")
    cameras = counted(len(imported.cameras), "camera")
    names = ", ".join(camera.name for camera in imported.cameras)
    say(
        f"{cameras} ({names}), lengths in {unit} -> {shown(output)}; now "
        "add the source of each sensor"
    )


def _written(imported: Imported, output: Path) -> Session:
    """Write the session and load it; a file that cannot be loaded is removed."""
    if is_stdout(output):
        with TemporaryDirectory() as folder:
            copy = Path(folder) / "session.toml"
            copy.write_text(session_text(imported, copy), encoding="utf-8")
            session = load_session(copy)
        write_text(output, session_text(imported, output), "-o")
        return session
    with output.open("x", encoding="utf-8", newline="\n") as stream:
        stream.write(session_text(imported, output))
    try:
        return load_session(output)
    except SessionError:
        output.unlink()  # or the next attempt would be refused
        raise
