"""``mixpose simulate``: a recording with its truth."""

from __future__ import annotations

import sys
from pathlib import Path

from mixpose.errors import SessionError
from mixpose.session import load_session
from mixpose.session.values import LONGEST_DELAY_S
from mixpose.simulation import SimulationOptions, simulate
from mixpose.simulation.session_copy import SESSION_NAME


def delays_of(given: list[str]) -> dict[str, float]:
    """Seconds by sensor, of texts NAME=SECONDS. Raises SessionError if a text is not like that."""
    delays = {}
    for text in given:
        name, _, seconds = text.rpartition("=")
        try:
            delays[name] = float(seconds)
        except ValueError:
            name = ""
        if not name or not abs(delays[name]) <= LONGEST_DELAY_S:
            raise SessionError(
                f"--delay {text}: allowed: NAME=SECONDS, seconds from -1 to 1, like right=0.006"
            )
    return delays


def simulate_session(
    path: Path, folder: Path, options: SimulationOptions, *, overwrite: bool
) -> None:
    """Render the recording of a session into a folder.

    Raises SessionError if the session or the options are wrong, or the folder holds a recording
    already.
    """
    session = load_session(path)
    if not sys.stderr.isatty():
        simulate(session, folder, options, overwrite=overwrite)
    else:
        from rich.console import Console  # noqa: PLC0415 - only where it is shown
        from rich.progress import Progress  # noqa: PLC0415

        with Progress(console=Console(stderr=True), transient=True) as progress:
            task = progress.add_task("simulating", total=options.frames)
            simulate(
                session,
                folder,
                options,
                overwrite=overwrite,
                progress=lambda done: progress.update(task, completed=done),
            )
    count = f"{options.frames} frame{'s' * (options.frames != 1)}"
    print(
        f"{count} in {folder}; play them with: mixpose run {folder / SESSION_NAME}",
        file=sys.stderr,
    )
