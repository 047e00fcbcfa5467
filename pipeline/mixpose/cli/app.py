"""What people type: commands and options.  Each command imports its work when it is called."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated

import typer

from mixpose.cli import app_after
from mixpose.cli.app_before import CalibrateRequest, DesignRequest, ImportRequest, LearnRequest
from mixpose.cli.app_simulate import SimulateRequest
from mixpose.cli.help import Command, Commands
from mixpose.cli.words import AllowCode, Format, Recordings, SessionFile, option, taking

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


Sources = Annotated[
    list[str] | None,
    typer.Option(
        metavar="NAME=PATH",
        help="Another recording of a sensor, relative to the working folder, or the number of a "
        "camera; repeatable.",
    ),
]


@dataclass(frozen=True)
class RunWords:
    """Estimate a pose per frame."""

    context: typer.Context
    sessions: Annotated[
        list[str],
        typer.Argument(
            metavar="SESSION.toml...",
            help="One session file or several, patterns such as 'day*/session.toml', or text files "
            "(.txt) with one to a line.",
        ),
    ]
    output: Path | None = option(
        None,
        "Write poses here, not to stdout (-), in the format that the suffix tells. With "
        "several sessions, a folder in which each gets its own for poses, log and status; what "
        "is done there already is not done again.",
        "-o",
        "--output",
    )
    format: Format | None = option(
        None, "Else by the suffix: .jsonl .csv .tum .yaml (ros) .bop.csv; jsonl without."
    )
    source: Sources = None
    start: int | None = option(None, "First frame number.")
    stop: int | None = option(None, "Frame number to stop before.")
    step: int = option(1, "Take every N-th frame number.", min=1)
    resume: bool = option(False, "Go on after the last frame in the output.")
    workers: int = option(1, "How many sessions are run at a time.", min=1)
    overlay: Path | None = option(
        None, "Draw each pose on its frames: a video (.mp4, .mkv, .avi) or a folder."
    )
    view: str | None = option(
        None,
        "Show the run on a page in the browser, at 127.0.0.1:8080 or this port; HOST:PORT "
        "opens it to others who have the address with its token.",
        metavar="[PORT]",
    )
    pause: bool = option(False, "With --view, on files: begin paused, to go on from the page.")
    scheduler: str | None = option(
        None,
        "Run the sessions on a dask.distributed cluster: the address of its scheduler, or "
        "local for one on this machine.",
        metavar="ADDRESS",
    )
    labels: bool = option(
        False,
        "Say in each pose line which detection is which feature, and where features are in "
        "space by these alone; .jsonl only.",
    )
    publish: list[str] | None = option(
        None,
        "Send each pose to another program too: udp://host:port, tcp://host:port, "
        "ws://host:port, osc://host:port, lsl://name, mqtt://host/topic, ros2://topic; with "
        "'?only=ok' none but those that are ok; repeatable.",
        metavar="URL",
    )
    predict: float | None = option(
        None, "Publish where the body will be so much after each frame.", metavar="SECONDS"
    )
    allow_code: AllowCode = False


def run(words: RunWords) -> None:
    """Run one session here, or many in processes of their own, as was asked for."""
    from mixpose.cli.request import RunRequest, format_of, output_of  # noqa: PLC0415
    from mixpose.cli.several import are_many, run_sessions, sessions_of  # noqa: PLC0415
    from mixpose.errors import SessionError  # noqa: PLC0415
    from mixpose.selection import Selection  # noqa: PLC0415

    sessions, output = words.sessions, output_of(words.output)
    many = are_many(sessions, words.scheduler)
    # of many: a folder
    written = (words.format or "jsonl") if many else format_of(output, words.format)
    shared = {one.name for one in fields(RunRequest)}
    given = {
        **{name: value for name, value in vars(words).items() if name in shared},
        "output": output,
        "format": written,
        "sources": tuple(words.source or ()),
        "selection": Selection(words.start, words.stop, words.step),
        "publish": tuple(words.publish or ()),
        "debug": bool(words.context.obj),
    }
    request = RunRequest(**given)
    if words.labels and written != "jsonl":
        raise SessionError(f"--labels: found --format {written}; allowed: jsonl, which has room")
    if many and (words.publish or words.predict is not None):
        raise SessionError(
            "--publish: found several sessions; allowed is one, whose poses receivers take for one "
            "recording"
        )
    if many:
        raise typer.Exit(run_sessions(sessions_of(sessions), request, words.workers))
    from mixpose.cli.notices import warn  # noqa: PLC0415
    from mixpose.cli.run import run_session  # noqa: PLC0415

    if words.workers > 1:
        warn(f"--workers {words.workers}: one session is one process, frames follow each other")
    run_session(Path(sessions[0]), request)


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
    "run": taking(RunWords, run),
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
