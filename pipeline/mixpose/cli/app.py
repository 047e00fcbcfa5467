"""Commands and their options.  Each command imports its work when it is called."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Literal, TypeAlias

import typer

from mixpose.cli.help import Command, Commands
from mixpose.cli.request import RunRequest, another_source, any_code, argument, command_for, option
from mixpose.units import Unit

ConvertFormat: TypeAlias = Literal["jsonl", "csv", "tum", "bop", "ros", "rerun", "c3d", "trc"]

session_file = partial(argument, "The session file.", ..., metavar="SESSION.toml")
poses_file = partial(argument, "Estimated poses.", ..., metavar="POSES.jsonl")
instead = partial(option, "Recording of a sensor in place of the session's.", metavar="NAME=PATH")
"""Arguments and options of several commands."""

motion = partial(option, panel="Motion of the body")
images = partial(option, panel="Images")
tables = partial(option, panel="Profiles and tables")
in_view = partial(option, panel="What else is in view")
in_time = partial(option, panel="Time, and sensors that are not as told")
"""Options of ``mixpose simulate``, by their groups."""


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
class ImportRequest:
    """Make a session of the calibration files of other programs."""

    files: list[Path] = argument(
        "Calibrations of OpenCV, Kalibr, ROS, caliscope, aniposelib, pycalib or COLMAP, and "
        "bodies: .csv, .rom, .vsk or .obj.",
        ...,
        metavar="FILE...",
    )
    output: Path = option("The session file, which must be new; or stdout (-).", ...)
    unit: Unit = option("Unit of lengths in the session.", "mm")
    lengths: Unit | None = option("Unit of translations in files whose format does not fix it.")


@dataclass(frozen=True)
class CalibrateRequest:
    """Calibrate sensors from a recording of the body, without matching markers."""

    session: Path = session_file()
    output: Path | None = option(
        "The calibrated session; or stdout (-).", metavar="CALIBRATED.toml"
    )
    poses: Path | None = option(
        "Known poses of the body; else none is known.", metavar="POSES.jsonl"
    )
    free: list[str] | None = option(
        "What is sought: pose, focal, principal_point, distortion, delay, drift, "
        "position, range_bias, of a sensor or, without its name, of all; or body, the marker "
        "coordinates. Repeatable. Else the poses of all cameras but the first and the "
        "positions of range sensors.",
        metavar="SENSOR:WHAT",
    )
    length: str | None = option(
        "A known distance, which gives scale.", metavar="SENSOR:SENSOR=LENGTH"
    )
    world: str | None = option(
        "Whose frame becomes the world; else it stays.", metavar="SENSOR|body@FRAME"
    )
    check: bool = option("Only say whether the calibration still holds.", False)
    report: Path | None = option("A page with pictures; or stdout (-).", metavar="FILE.html")
    source: list[str] | None = instead()
    allow_code: bool = any_code()


@dataclass(frozen=True)
class LearnRequest:
    """Learn the markers of bodies from a recording in which they move."""

    session: Path = session_file()
    output: Path = option(
        "Table of the markers; of several bodies the others go to BODY-2.csv and so on. A single "
        "one may go to stdout (-).",
        ...,
        metavar="BODY.csv",
    )
    axes: str | None = option(
        "Three markers by name: the origin, one on the x axis, one in the x-y plane. Else "
        "the middle of all markers and their principal axes.",
        metavar="ORIGIN,X,Y",
    )
    like: Path | None = option(
        "An older or measured table of the same markers, whose axes and names are kept.",
        metavar="OLD.csv",
    )
    source: list[str] | None = instead()
    allow_code: bool = any_code()


@dataclass(frozen=True)
class DesignRequest:
    """Predict the accuracy of planned systems, side by side, and what would improve them."""

    sessions: list[Path] = argument(
        "One system or several; others are held to the first.", ..., metavar="SESSION.toml"
    )
    poses: Path | None = option("Judge at these poses, not over a volume.", metavar="POSES.jsonl")
    count: int = option("Number of poses in the volume.", 24, min=1, max=2000)
    volume: str | None = option(
        "Sides of the box around [start] or the middle of the view; else twice the body's radius.",
        metavar="X,Y,Z",
    )
    turn: float | None = option(
        "Turn the body by up to so many degrees; else 20 about [start], or 180."
    )
    tip: str | None = option("Judge a point of the body, in its coordinates.", metavar="X,Y,Z")
    noise: list[str] | None = option(
        "What features err by, px or length; SYSTEM:SENSOR=NUMBER for one system, * for "
        "every sensor; else 0.2 of sigma for cameras, sigma for ranges.",
        metavar="SENSOR=NUMBER",
    )
    monte_carlo: int = option("Simulate and estimate so many frames of each system.", 0, min=0)
    seed: int = option("Same seed, same study.", 0, min=0)
    tolerance: float | None = option(
        "Markers of two bodies lie alike within this; else 10 % of the radius.", min=0, max=1e9
    )
    json: Path | None = option("Write all numbers here; or to stdout (-).")
    plot: Path | None = option("Draw it: .png, .svg or .pdf.")
    workers: int = option("How many poses are simulated at a time.", 1, min=1)
    scheduler: str | None = option(
        "Simulate on a dask.distributed cluster: the address of its scheduler, or local "
        "for one on this machine.",
        metavar="ADDRESS",
    )


@dataclass(frozen=True)
class CheckRequest:
    """Read every frame before any run: features found, placement, accuracy to expect."""

    session: Path = session_file()
    quick: bool = option("Look at a few frames of each sensor only.", False)
    source: list[str] | None = another_source()
    allow_code: bool = any_code()


@dataclass(frozen=True)
class InspectRequest:
    """Pictures of one frame: features found, densities, pose, objective; and what to change."""

    session: Path = session_file()
    output: Path = option("Folder for the pictures.", ...)
    frame: int | None = option("Number of the frame; else the recording's first.")
    poses: Path | None = option(
        "Take the pose from a run, not from this frame alone.", metavar="POSES.jsonl"
    )
    source: list[str] | None = instead()
    allow_code: bool = any_code()


@dataclass(frozen=True)
class SimulateRequest:
    """Render a recording with truth.jsonl that `run` can play."""

    session: Path = session_file()
    output: Path = option("New folder for the recording.", ...)
    frames: int = option("Number of frames.", ..., min=1)
    seed: int = option("Same seed, same recording.", 0, min=0)
    fps: float | None = in_time("Frames per second; for poses with times put fps into the session.")
    noise: float = images("Camera noise, grey levels.", 2.0)
    clutter: float = in_view("False features per frame and sensor.", 0.0)
    hidden: float = in_view("Chance that a feature is hidden.", 0.0)
    missing: float = in_time("Chance that a sensor has no frame.", 0.0)
    brightness: float = images("Peak of a spot, grey levels.", 170.0)
    brightness_spread: float = images(
        "Spread of the brightness over the features, as a share.", 0.1
    )
    amplitude_translation: float | None = motion(
        "Largest displacement along each axis, length units.", name="--translation"
    )
    amplitude_rotation_deg: float = motion(
        "Largest turn about each axis, degrees.", 20.0, name="--rotation"
    )
    period_s: float = motion("Seconds in which the motion comes round.", 4.0, name="--period")
    pixel_noise: float = tables("Error of detections in a camera's table, px.", 0.1)
    range_noise: float | None = tables(
        "Error of detections in tables of ranges and of clouds, length units."
    )
    range_snr: float = tables("Height of a profile's peak over its noise.", 30.0)
    deform: bool = in_view("Displace features by the spread the object states.", False)
    readout: float | None = in_time(
        "Seconds from a camera's first row to its last; else the session's."
    )
    exposure: float | None = in_time("Seconds for which a row is lit; else the session's.")
    delay: list[str] | None = in_time(
        "A sensor that is late; else the session's.", metavar="NAME=SECONDS"
    )
    out_of_step: float = in_time("Seconds from the first sensor to the last, in their times.", 0.0)
    lamps: int = in_view("Lamps behind the body.", 0, min=0)
    mirror: float = in_view("Brightness of mirror images in a table below, as a share.", 0.0)
    others: int = in_view("Other bodies with as many markers, beside this one.", 0, min=0)
    occluder: int = in_view("Dark bars that swing before it.", 0, min=0)
    jpeg: int | None = images("Quality of lossy compression.", min=1, max=100)
    bayer: bool = images("Images of a colour sensor, interpolated.", False)
    turned_camera_deg: float = in_time(
        "Degrees by which the last camera was turned meanwhile.", 0.0, name="--turned-camera"
    )
    away_from: int | None = motion("Frames after which the body is gone.", min=0)
    overwrite: bool = option("Replace a recording in the folder.", False)


@dataclass(frozen=True)
class EvaluateRequest:
    """Errors of poses against the truth, modulo the object's symmetries."""

    poses: Path = poses_file()
    truth: Path = argument("True poses.", ..., metavar="TRUTH.jsonl")
    json: bool = option("Print JSON instead of a table.", False)


@dataclass(frozen=True)
class ReportRequest:
    """One page about a run: motion, accuracy, residuals, latency, frames with their poses."""

    poses: Path = poses_file()
    output: Path = option("The page, as report.html; or stdout (-).", ...)
    truth: Path | None = argument("True poses.", metavar="TRUTH.jsonl")


@dataclass(frozen=True)
class ConvertRequest:
    """Write poses in the format of another program."""

    poses: Path = argument("Poses or true poses.", ..., metavar="POSES.jsonl")
    output: Path | None = option("Write here, not to stdout (-).")
    format: ConvertFormat | None = option(
        "Else by the suffix: .jsonl .csv .tum .yaml (ros) .rrd (rerun) .c3d .trc."
    )
    unit: str | None = option("Unit of lengths where POSES does not say: m, cm, mm, um.")
    object: str | None = option("Only the poses of this object.")
    only_ok: bool = option("Leave out ambiguous frames too.", False)
    scene_id: int | None = option("bop: the scene; 0.", min=0)
    obj_id: int | None = option("bop: the object; 1.", min=0)
    relative_to: str | None = option(
        "bop, csv, ros, tum: relative to a camera, or another body of POSES, not the world.",
        metavar="NAME",
    )
    session: Path | None = option("The session of the poses, where they do not lead to it.")
    source: list[str] | None = option(
        "rerun: as for run, else that of the run.", metavar="NAME=PATH"
    )
    measured: bool = option(
        "c3d, trc: leave gaps where a marker was not measured by itself.", False
    )
    fps: float | None = option("c3d, trc: frames a second, in place of times.", min=1e-6, max=1e6)
    allow_code: bool = any_code()


@dataclass(frozen=True)
class SmoothRequest:
    """Smooth the poses of a recording, each by all that came before and after."""

    poses: Path = poses_file()
    output: Path | None = option("Write here, not to stdout (-).", metavar="SMOOTH.jsonl")
    fill: float = option(
        "Fill gaps of at most so long, marked; else none.", 0.0, min=0, metavar="SECONDS"
    )
    motion: Literal["acceleration", "jerk", "snap", "crackle"] | None = option(
        "Which derivative of the motion takes white noise; else the likeliest."
    )


@dataclass(frozen=True)
class PivotRequest:
    """The tip of a tool, from poses while it turns about its tip."""

    poses: Path = poses_file()
    object: str | None = option("The tool, where there are several bodies.", metavar="OBJECT")
    reference: str | None = option(
        "The tip stays at a point of this body; else of the world.", metavar="OBJECT"
    )
    into: Path | None = option("Write the tip into this session.", metavar="SESSION.toml")


@dataclass(frozen=True)
class AlignRequest:
    """A session in the frame of the floor: bodies, points or a plane that lie on it."""

    session: Path = session_file()
    floor: list[str] = option(
        "What lies on the floor: poses, or a body in a frame. Repeatable.",
        ...,
        metavar="POSES.jsonl|OBJECT@FRAME",
    )
    output: Path = option("The aligned session; or stdout (-).", ..., metavar="ALIGNED.toml")
    up: Literal["x", "y", "z"] = option("The axis that points up.", "z")
    source: list[str] | None = instead()
    allow_code: bool = any_code()


def _schema() -> None:
    """Print the JSON Schema of pose lines."""
    from mixpose.poses.schema import schema_text  # noqa: PLC0415

    typer.echo(schema_text(), nl=False)


_COMMANDS: dict[str, Callable[..., None]] = {
    "run": command_for(RunRequest, "several:run"),
    "check": command_for(CheckRequest, "check:check_session"),
    "inspect": command_for(InspectRequest, "inspect:inspect_frame"),
    "import": command_for(ImportRequest, "importing:import_files"),
    "simulate": command_for(SimulateRequest, "simulate:simulate_session"),
    "evaluate": command_for(EvaluateRequest, "report:evaluate_poses"),
    "convert": command_for(ConvertRequest, "convert:convert_poses"),
    "schema": _schema,
    "report": command_for(ReportRequest, "report:write_report"),
    "calibrate": command_for(CalibrateRequest, "calibrate:calibrate_session"),
    "design": command_for(DesignRequest, "design:design_sessions"),
    "pivot": command_for(PivotRequest, "pivot:pivot_poses"),
    "align": command_for(AlignRequest, "align:align_session"),
    "smooth": command_for(SmoothRequest, "smooth:smooth_poses"),
    "learn": command_for(LearnRequest, "learn:learn_session"),
}
for name, command in _COMMANDS.items():
    app.command(name, cls=Command)(command)
