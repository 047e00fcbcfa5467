"""What people type: commands and options.  Each command imports its work when it is called."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from mixpose.cli.app_after import align, convert, evaluate, pivot, report, schema, smooth
from mixpose.cli.app_before import calibrate, design, import_, learn
from mixpose.cli.app_simulate import simulate
from mixpose.cli.help import Command, Commands
from mixpose.cli.words import AllowCode, Format, Recordings, SessionFile, Start, Step, Stop, taking

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


Sessions = Annotated[
    list[str],
    typer.Argument(
        metavar="SESSION.toml...",
        help="One session file or several, patterns such as 'day*/session.toml', or text files "
        "(.txt) with one to a line.",
    ),
]
RunOutput = Annotated[
    Path | None,
    typer.Option(
        "-o",
        "--output",
        help="Write poses here, not to stdout (-), in the format that the suffix tells. With "
        "several sessions, a folder in which each gets its own for poses, log and status; what "
        "is done there already is not done again.",
    ),
]
RunFormat = Annotated[
    Format | None,
    typer.Option(help="Else by the suffix: .jsonl .csv .tum .yaml (ros) .bop.csv; jsonl without."),
]
Sources = Annotated[
    list[str] | None,
    typer.Option(
        metavar="NAME=PATH",
        help="Another recording of a sensor, relative to the working folder, or the number of a "
        "camera; repeatable.",
    ),
]
Resume = Annotated[bool, typer.Option("--resume", help="Go on after the last frame in the output.")]
Workers = Annotated[int, typer.Option(min=1, help="How many sessions are run at a time.")]
Overlay = Annotated[
    Path | None,
    typer.Option(help="Draw each pose on its frames: a video (.mp4, .mkv, .avi) or a folder."),
]
Labels = Annotated[
    bool,
    typer.Option(
        "--labels",
        help="Say in each pose line which detection is which feature, and where features are in "
        "space by these alone; .jsonl only.",
    ),
]
View = Annotated[
    str | None,
    typer.Option(
        metavar="[PORT]",
        help="Show the run on a page in the browser, at 127.0.0.1:8080 or this port; HOST:PORT "
        "opens it to others who have the address with its token.",
    ),
]
Pause = Annotated[
    bool,
    typer.Option("--pause", help="With --view, on files: begin paused, to go on from the page."),
]
Scheduler = Annotated[
    str | None,
    typer.Option(
        metavar="ADDRESS",
        help="Run the sessions on a dask.distributed cluster: the address of its scheduler, or "
        "local for one on this machine.",
    ),
]
Publish = Annotated[
    list[str] | None,
    typer.Option(
        metavar="URL",
        help="Send each pose to another program too: udp://host:port, tcp://host:port, "
        "ws://host:port, osc://host:port, lsl://name, mqtt://host/topic, ros2://topic; with "
        "'?only=ok' none but those that are ok; repeatable.",
    ),
]
Predict = Annotated[
    float | None,
    typer.Option(
        metavar="SECONDS", help="Publish where the body will be so much after each frame."
    ),
]


@app.command(cls=Command)
def run(
    context: typer.Context,
    sessions: Sessions,
    output: RunOutput = None,
    format: RunFormat = None,
    source: Sources = None,
    start: Start = None,
    stop: Stop = None,
    step: Step = 1,
    resume: Resume = False,
    workers: Workers = 1,
    overlay: Overlay = None,
    view: View = None,
    pause: Pause = False,
    scheduler: Scheduler = None,
    labels: Labels = False,
    publish: Publish = None,
    predict: Predict = None,
    allow_code: AllowCode = False,
) -> None:
    """Estimate a pose per frame."""
    from mixpose.cli.request import RunRequest, format_of, output_of  # noqa: PLC0415
    from mixpose.cli.several import are_many, run_sessions, sessions_of  # noqa: PLC0415
    from mixpose.errors import SessionError  # noqa: PLC0415
    from mixpose.selection import Selection  # noqa: PLC0415

    selection, output = Selection(start, stop, step), output_of(output)
    sources, debug = tuple(source or ()), bool(context.obj)
    many = are_many(sessions, scheduler)
    written = (format or "jsonl") if many else format_of(output, format)  # of many: a folder
    request = RunRequest(
        output,
        written,
        sources,
        selection,
        resume,
        overlay,
        debug,
        allow_code,
        scheduler,
        labels,
        tuple(publish or ()),
        predict,
        view,
        pause,
    )
    if labels and written != "jsonl":
        raise SessionError(f"--labels: found --format {written}; allowed: jsonl, which has room")
    if many and (publish or predict is not None):
        raise SessionError(
            "--publish: found several sessions; allowed is one, whose poses receivers take for one "
            "recording"
        )
    if many:
        raise typer.Exit(run_sessions(sessions_of(sessions), request, workers))
    from mixpose.cli.notices import warn  # noqa: PLC0415
    from mixpose.cli.run import run_session  # noqa: PLC0415

    if workers > 1:
        warn(f"--workers {workers}: one session is one process, frames follow each other")
    run_session(Path(sessions[0]), request)


@app.command(cls=Command)
def check(
    session: SessionFile,
    quick: Annotated[
        bool, typer.Option("--quick", help="Look at a few frames of each sensor only.")
    ] = False,
    source: Sources = None,
    allow_code: AllowCode = False,
) -> None:
    """Read every frame before any run: features found, placement, accuracy to expect."""
    from mixpose.cli.check import check_session  # noqa: PLC0415

    check_session(session, quick=quick, sources=tuple(source or ()), allow_code=allow_code)


@dataclass(frozen=True)
class InspectRequest:
    """What was asked for."""

    session: SessionFile
    output: Annotated[Path, typer.Option("-o", "--output", help="Folder for the pictures.")]
    frame: Annotated[
        int | None, typer.Option(help="Number of the frame; else the recording's first.")
    ] = None
    poses: Annotated[
        Path | None,
        typer.Option(
            metavar="POSES.jsonl", help="Take the pose from a run, not from this frame alone."
        ),
    ] = None
    source: Recordings = None
    allow_code: AllowCode = False


@app.command(cls=Command)
@taking(InspectRequest)
def inspect(request: InspectRequest) -> None:
    """Pictures of one frame: features found, densities, pose, objective; and what to change."""
    from mixpose.cli.inspect import inspect_frame  # noqa: PLC0415

    inspect_frame(request)


_COMMANDS: dict[str, Callable[..., None]] = {
    "import": import_,
    "simulate": simulate,
    "evaluate": evaluate,
    "convert": convert,
    "schema": schema,
    "report": report,
    "calibrate": calibrate,
    "design": design,
    "pivot": pivot,
    "align": align,
    "smooth": smooth,
    "learn": learn,
}
for name, command in _COMMANDS.items():
    app.command(name, cls=Command)(command)
