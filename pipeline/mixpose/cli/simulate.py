"""``mixpose simulate``: render a recording with its true poses."""

from __future__ import annotations

import sys
from dataclasses import fields

from mixpose.cli.app import SimulateRequest
from mixpose.cli.notices import bar, counted, warn
from mixpose.cli.output import refuse_stdout
from mixpose.cli.request import option_name
from mixpose.errors import SessionError
from mixpose.session import load_session
from mixpose.session.values import LONGEST_DELAY_S, as_number
from mixpose.simulation import SimulationOptions, simulate
from mixpose.simulation.session_copy import SESSION_NAME


def delays_of(texts: list[str]) -> dict[str, float]:
    """Return seconds by sensor from texts NAME=SECONDS; SessionError if a text has another form."""
    delays = {}
    for text in texts:
        name, _, seconds = text.rpartition("=")
        delays[name] = as_number(seconds)
        if not name or not abs(delays[name]) <= LONGEST_DELAY_S:
            raise SessionError(
                f"--delay {text}: allowed: NAME=SECONDS, seconds from -1 to 1, like right=0.006"
            )
    return delays


def simulate_session(request: SimulateRequest) -> None:
    """Render the recording of a session into a folder."""
    names = {entry.name for entry in fields(SimulationOptions)} - {"delay"}
    values = {name: value for name, value in vars(request).items() if name in names}
    options = SimulationOptions(**values, delay=delays_of(request.delay or []))
    folder, overwrite = request.output, request.overwrite
    refuse_stdout(folder, "-o", "a recording", "a folder, as -o recording")
    session = load_session(request.session)
    with bar("simulating", options.frames) as tick:
        unused = simulate(
            session, folder, options, overwrite=overwrite, progress=lambda k: tick(completed=k)
        )
    if unused:
        typed = {entry.name: option_name(entry) for entry in fields(SimulateRequest)}
        listed = ", ".join(typed[name] for name in unused)
        warn(f"{listed}: no sensor or body of this session has what that is about")
    count = counted(options.frames, "frame")
    print(
        f"{count} in {folder}; play them with: mixpose run {folder / SESSION_NAME}", file=sys.stderr
    )
