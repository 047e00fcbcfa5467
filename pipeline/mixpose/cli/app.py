"""What people type: commands and options.  Each command imports its work when it is called."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from mixpose.cli.app_calibrate import calibrate
from mixpose.cli.app_design import design
from mixpose.cli.app_learn import learn
from mixpose.cli.app_simulate import simulate
from mixpose.cli.app_trajectories import align, pivot, smooth
from mixpose.cli.help import Command, Commands
from mixpose.cli.words import (
    AllowCode,
    ConvertFormat,
    Format,
    LengthUnit,
    PosesFile,
    SessionFile,
    Start,
    Step,
    Stop,
)

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
    named = None if format is None else format.value
    written = (named or "jsonl") if many else format_of(output, named)  # of many: a folder
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


@app.command(cls=Command)
def inspect(
    session: SessionFile,
    output: Annotated[Path, typer.Option("-o", "--output", help="Folder for the pictures.")],
    frame: Annotated[
        int | None, typer.Option(help="Number of the frame; else the recording's first.")
    ] = None,
    poses: Annotated[
        Path | None,
        typer.Option(
            metavar="POSES.jsonl", help="Take the pose from a run, not from this frame alone."
        ),
    ] = None,
    source: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME=PATH", help="Recording of a sensor in place of the session's."),
    ] = None,
    allow_code: AllowCode = False,
) -> None:
    """Pictures of one frame: features found, densities, pose, objective; and what to change."""
    from mixpose.cli.inspect import inspect_frame  # noqa: PLC0415

    inspect_frame(
        session,
        frame,
        output,
        poses=poses,
        sources=tuple(source or ()),
        allow_code=allow_code,
    )


@app.command("import", cls=Command)
def import_(
    files: Annotated[
        list[Path],
        typer.Argument(
            metavar="FILE...",
            help="Calibrations of OpenCV, Kalibr, ROS, caliscope, aniposelib, pycalib or COLMAP, "
            "and bodies: .csv, .rom, .vsk or .obj.",
        ),
    ],
    output: Annotated[
        Path, typer.Option("-o", "--output", help="The session file, which must be new.")
    ],
    unit: Annotated[
        LengthUnit, typer.Option(help="Unit of lengths in the session.")
    ] = LengthUnit.mm,
    lengths: Annotated[
        LengthUnit | None,
        typer.Option(help="Unit of translations in files whose format does not fix it."),
    ] = None,
) -> None:
    """Make a session of the calibration files of other programs."""
    from mixpose.cli.importing import import_files  # noqa: PLC0415

    import_files(files, output, unit=unit.value, lengths=None if lengths is None else lengths.value)


app.command(cls=Command)(simulate)


@app.command(cls=Command)
def evaluate(
    poses: PosesFile,
    truth: Annotated[Path, typer.Argument(metavar="TRUTH.jsonl", help="True poses.")],
    json: Annotated[bool, typer.Option("--json", help="Print JSON instead of a table.")] = False,
) -> None:
    """Errors of poses against the truth, modulo the object's symmetries."""
    from mixpose.cli.evaluate import evaluate_poses  # noqa: PLC0415

    evaluate_poses(poses, truth, as_json=json)


@app.command(cls=Command)
def convert(
    poses: Annotated[Path, typer.Argument(metavar="POSES.jsonl", help="Poses or true poses.")],
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="Write here, not to stdout (-).")
    ] = None,
    format: Annotated[
        ConvertFormat | None,
        typer.Option(
            help="Else by the suffix: .jsonl .csv .tum .yaml (ros) .rrd (rerun) .c3d .trc."
        ),
    ] = None,
    unit: Annotated[
        str | None, typer.Option(help="Unit of lengths where POSES does not say: m, cm, mm, um.")
    ] = None,
    object: Annotated[str | None, typer.Option(help="Only the poses of this object.")] = None,
    only_ok: Annotated[
        bool, typer.Option("--only-ok", help="Leave out ambiguous frames too.")
    ] = False,
    scene_id: Annotated[int | None, typer.Option(min=0, help="bop: the scene; 0.")] = None,
    obj_id: Annotated[int | None, typer.Option(min=0, help="bop: the object; 1.")] = None,
    relative_to: Annotated[
        str | None,
        typer.Option(metavar="SENSOR", help="bop, ros, tum: relative to a camera, not the world."),
    ] = None,
    session: Annotated[
        Path | None, typer.Option(help="The session of the poses, where they do not lead to it.")
    ] = None,
    source: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME=PATH", help="rerun: as for run."),
    ] = None,
    measured: Annotated[
        bool,
        typer.Option(
            "--measured", help="c3d, trc: leave gaps where a marker was not measured by itself."
        ),
    ] = False,
    fps: Annotated[
        float | None,
        typer.Option(min=1e-6, max=1e6, help="c3d, trc: frames a second, in place of times."),
    ] = None,
    allow_code: AllowCode = False,
) -> None:
    """Write poses in the format of another program."""
    from mixpose.cli.convert import ConvertRequest, convert_poses  # noqa: PLC0415
    from mixpose.cli.request import output_of  # noqa: PLC0415

    request = ConvertRequest(
        output=output_of(output),
        format=None if format is None else format.value,
        unit=unit,
        object=object,
        only_ok=only_ok,
        scene_id=scene_id,
        obj_id=obj_id,
        relative_to=relative_to,
        session=session,
        sources=tuple(source or ()),
        allow_code=allow_code,
        measured=measured,
        fps=fps,
    )
    convert_poses(poses, request)


@app.command(cls=Command)
def schema() -> None:
    """Print the JSON Schema of pose lines."""
    from mixpose.poses.schema import schema_text  # noqa: PLC0415

    typer.echo(schema_text(), nl=False)


@app.command(cls=Command)
def report(
    poses: PosesFile,
    output: Annotated[Path, typer.Option("-o", "--output", help="The page, as report.html.")],
    truth: Annotated[Path | None, typer.Argument(metavar="TRUTH.jsonl", help="True poses.")] = None,
) -> None:
    """One page about a run: motion, accuracy, residuals, latency, frames with their poses."""
    from mixpose.cli.report import write_report  # noqa: PLC0415

    write_report(poses, truth, output)


app.command(cls=Command)(calibrate)
app.command(cls=Command)(design)
app.command(cls=Command)(pivot)
app.command(cls=Command)(align)
app.command(cls=Command)(smooth)
app.command(cls=Command)(learn)
