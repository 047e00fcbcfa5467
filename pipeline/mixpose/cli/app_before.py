"""What people type before there are poses: ``mixpose import``, calibrate, learn and design."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from mixpose.cli.words import AllowCode, LengthUnit, Recordings, SessionFile, taking


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
    unit: Annotated[LengthUnit, typer.Option(help="Unit of lengths in the session.")] = "mm",
    lengths: Annotated[
        LengthUnit | None,
        typer.Option(help="Unit of translations in files whose format does not fix it."),
    ] = None,
) -> None:
    """Make a session of the calibration files of other programs."""
    from mixpose.cli.importing import import_files  # noqa: PLC0415

    import_files(files, output, unit=unit, lengths=lengths)


@dataclass(frozen=True)
class CalibrateRequest:
    """What was asked for."""

    session: SessionFile
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", metavar="CALIBRATED.toml", help="The calibrated session."),
    ] = None
    poses: Annotated[
        Path | None,
        typer.Option(metavar="POSES.jsonl", help="Known poses of the body; else none is known."),
    ] = None
    free: Annotated[
        list[str] | None,
        typer.Option(
            metavar="SENSOR:WHAT",
            help="What is sought: pose, focal, principal_point, distortion, delay, drift, "
            "position, range_bias, of a sensor or, without its name, of all; or body, the marker "
            "coordinates. Repeatable. Else the poses of all cameras but the first and the "
            "positions of range sensors.",
        ),
    ] = None
    length: Annotated[
        str | None,
        typer.Option(metavar="SENSOR:SENSOR=LENGTH", help="A known distance, which gives scale."),
    ] = None
    world: Annotated[
        str | None,
        typer.Option(
            metavar="SENSOR|body@FRAME", help="Whose frame becomes the world; else it stays."
        ),
    ] = None
    check: Annotated[
        bool, typer.Option("--check", help="Only say whether the calibration still holds.")
    ] = False
    report: Annotated[
        Path | None, typer.Option(metavar="FILE.html", help="A page with pictures.")
    ] = None
    source: Recordings = None


@taking(CalibrateRequest)
def calibrate(request: CalibrateRequest) -> None:
    """Calibrate sensors from a recording of the body, without matching markers."""
    from mixpose.cli.calibrate import calibrate_session  # noqa: PLC0415

    calibrate_session(request)


@dataclass(frozen=True)
class LearnRequest:
    """What was asked for."""

    session: SessionFile
    output: Annotated[
        Path,
        typer.Option(
            "-o",
            "--output",
            metavar="BODY.csv",
            help="Table of the markers; of several bodies the others go to BODY-2.csv and so on.",
        ),
    ]
    axes: Annotated[
        str | None,
        typer.Option(
            metavar="ORIGIN,X,Y",
            help="Three markers by name: the origin, one on the x axis, one in the x-y plane. Else "
            "the middle of all markers and their principal axes.",
        ),
    ] = None
    like: Annotated[
        Path | None,
        typer.Option(
            metavar="OLD.csv",
            help="An older or measured table of the same markers, whose axes and names are kept.",
        ),
    ] = None
    source: Recordings = None
    allow_code: AllowCode = False


@taking(LearnRequest)
def learn(request: LearnRequest) -> None:
    """Learn the markers of bodies from a recording in which they move."""
    from mixpose.cli.learn import learn_session  # noqa: PLC0415

    learn_session(request)


@dataclass(frozen=True)
class DesignRequest:
    """What was asked for."""

    sessions: Annotated[
        list[Path],
        typer.Argument(
            metavar="SESSION.toml", help="One system or several; others are held to the first."
        ),
    ]
    poses: Annotated[
        Path | None,
        typer.Option(metavar="POSES.jsonl", help="Judge at these poses, not over a volume."),
    ] = None
    count: Annotated[int, typer.Option(min=1, max=2000, help="Number of poses in the volume.")] = 24
    volume: Annotated[
        str | None,
        typer.Option(
            metavar="X,Y,Z",
            help="Sides of the box around [start] or the middle of the view; else twice the "
            "body's radius.",
        ),
    ] = None
    turn: Annotated[
        float | None,
        typer.Option(help="Turn the body by up to so many degrees; else 20 about [start], or 180."),
    ] = None
    tip: Annotated[
        str | None,
        typer.Option(metavar="X,Y,Z", help="Judge a point of the body, in its coordinates."),
    ] = None
    noise: Annotated[
        list[str] | None,
        typer.Option(
            metavar="SENSOR=NUMBER",
            help="What features err by, px or length; SYSTEM:SENSOR=NUMBER for one system, * for "
            "every sensor; else 0.2 of sigma for cameras, sigma for ranges.",
        ),
    ] = None
    monte_carlo: Annotated[
        int, typer.Option(min=0, help="Simulate and estimate so many frames of each system.")
    ] = 0
    seed: Annotated[int, typer.Option(min=0, help="Same seed, same study.")] = 0
    tolerance: Annotated[
        float | None,
        typer.Option(help="Markers of two bodies lie alike within this; else 10 % of the radius."),
    ] = None
    json: Annotated[Path | None, typer.Option(help="Write all numbers here.")] = None
    plot: Annotated[Path | None, typer.Option(help="Draw it: .png, .svg or .pdf.")] = None
    workers: Annotated[int, typer.Option(min=1, help="How many poses are simulated at a time.")] = 1
    scheduler: Annotated[
        str | None,
        typer.Option(
            metavar="ADDRESS",
            help="Simulate on a dask.distributed cluster: the address of its scheduler, or local "
            "for one on this machine.",
        ),
    ] = None


@taking(DesignRequest)
def design(request: DesignRequest) -> None:
    """Predict the accuracy of planned systems, side by side, and what would improve them."""
    from mixpose.cli.design import design_sessions  # noqa: PLC0415

    design_sessions(request)
