"""What people type: commands and options.  Each command imports its work when it is called."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from mixpose.cli import app_after
from mixpose.cli.app_before import CalibrateRequest, DesignRequest, ImportRequest, LearnRequest
from mixpose.cli.app_simulate import SimulateRequest
from mixpose.cli.help import Command, Commands
from mixpose.cli.request import RunRequest, Sources
from mixpose.cli.words import AllowCode, Recordings, SessionFile, option, taking

app = typer.Typer(
    name="mixpose",
    cls=Commands,
    help="6-D poses of a known rigid body from frames of calibrated sensors, "
    "without matching markers. --debug after any command shows tracebacks.",
    add_completion=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)


def _version(wanted: bool) -> None:
    if wanted:
        from mixpose import __version__  # noqa: PLC0415

        typer.echo(f"mixpose {__version__}")
        raise typer.Exit


@app.callback()
def _common(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    pass


@dataclass(frozen=True)
class CheckRequest:
    """Read every frame before any run: features found, placement, accuracy to expect."""

    session: SessionFile
    quick: bool = option(False, "Look at a few frames of each sensor only.")
    source: Sources = None
    allow_code: AllowCode = False


@dataclass(frozen=True)
class InspectRequest:
    """Pictures of one frame: features found, densities, pose, objective; and what to change."""

    session: SessionFile
    output: Path = option(..., "Folder for the pictures.", "-o", "--output")
    frame: int | None = option(None, "Number of the frame; else the recording's first.")
    poses: Path | None = option(
        None, "Take the pose from a run, not from this frame alone.", metavar="POSES.jsonl"
    )
    source: Recordings = None
    allow_code: AllowCode = False


_COMMANDS: dict[str, Callable[..., None]] = {
    "run": taking(RunRequest, "several:run"),
    "check": taking(CheckRequest, "check:check_session"),
    "inspect": taking(InspectRequest, "inspect:inspect_frame"),
    "import": taking(ImportRequest, "importing:import_files"),
    "simulate": taking(SimulateRequest, "simulate:simulate_session"),
    "evaluate": app_after.evaluate,
    "convert": taking(app_after.ConvertRequest, "convert:convert_poses"),
    "schema": app_after.schema,
    "report": taking(app_after.ReportRequest, "report:write_report"),
    "calibrate": taking(CalibrateRequest, "calibrate:calibrate_session"),
    "design": taking(DesignRequest, "design:design_sessions"),
    "pivot": taking(app_after.PivotRequest, "pivot:pivot_poses"),
    "align": taking(app_after.AlignRequest, "align:align_session"),
    "smooth": taking(app_after.SmoothRequest, "smooth:smooth_poses"),
    "learn": taking(LearnRequest, "learn:learn_session"),
}
for name, command in _COMMANDS.items():
    app.command(name, cls=Command)(command)
