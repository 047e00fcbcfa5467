"""``mixpose import``: a session file from those of other programs."""

from __future__ import annotations

from mixpose.checking import key_warnings, with_image_sizes
from mixpose.cli.app_before import ImportRequest
from mixpose.cli.notices import say, warn
from mixpose.errors import SessionError
from mixpose.importing import gather, session_text
from mixpose.session import load_session


def import_files(request: ImportRequest) -> None:
    """Write a session file, and say on standard error what is in it.

    Raises SessionError if a file cannot be read, or the output is there already.
    """
    output, unit = request.output, request.unit
    if output.exists():
        raise SessionError(f"-o {output}: is there already; name a new file")
    if not output.parent.is_dir():
        raise SessionError(f"-o {output}: there is no folder {output.parent}")
    imported = gather(request.files, unit, request.lengths)
    text = session_text(imported, output)
    with output.open("x", encoding="utf-8", newline="\n") as stream:
        stream.write(text)
    session = load_session(output)  # what was written can be read, or this is a defect
    for warning in (*imported.warnings, *key_warnings(with_image_sizes(session, {}))):
        warn(warning)
    if not imported.bodies:
        warn("no file of a body is among them: [object] is an example, put in your markers")
    count = len(imported.cameras)
    names = ", ".join(camera.name for camera in imported.cameras)
    say(
        f"{count} camera{'s' * (count != 1)} ({names}), lengths in {unit} -> {output}; now add the "
        "source of each sensor"
    )
