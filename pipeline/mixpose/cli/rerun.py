"""``mixpose convert --format rerun``: the poses with the recording that they come from."""

from __future__ import annotations

from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path

from mixpose.cli.run import named_sources
from mixpose.cli.session_of_poses import session_of
from mixpose.errors import SessionError
from mixpose.poses.jsonl import PoseFile
from mixpose.poses.poseline import PoseLine
from mixpose.runner import open_sources
from mixpose.whole_files import appearing_whole


def write_rerun(
    poses: PoseFile,
    lines: Sequence[PoseLine],
    output: Path | None,
    session_file: Path | None,
    sources: Sequence[str],
    *,
    allow_code: bool = False,
) -> None:
    """Write poses and the recording of their session as an ``.rrd`` file.

    Raises SessionError if the viewer's package is missing, or the session is not found or not that
    of the poses. Raises RecordingError if the recording cannot be read.
    """
    if output is None:
        raise SessionError("--format rerun: needs -o FILE.rrd, it is no text")
    if find_spec("rerun") is None:
        raise SessionError(
            "--format rerun: needs the package rerun-sdk; install it with: "
            "python -m pip install 'mixpose[rerun]'"
        )
    session = session_of(poses, session_file, allow_code=allow_code)
    opened = open_sources(session, named_sources(sources))
    for name, source in opened.items():
        if source.kind == "live":
            raise SessionError(
                f"sensor {name!r} is live, so its frames are gone; name a recording of them "
                f"with --source {name}=PATH"
            )
    from mixpose.rerun_file import write_rerun_file  # noqa: PLC0415 - not everybody has it

    with appearing_whole(output) as part:
        write_rerun_file(part, session, opened, lines)
