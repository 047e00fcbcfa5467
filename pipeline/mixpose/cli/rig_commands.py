"""Commands that build and judge a rig before poses are estimated: options, and what is called."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer


class LengthUnit(StrEnum):
    """Units of length."""

    m = "m"
    cm = "cm"
    mm = "mm"
    um = "um"


def import_(
    files: Annotated[
        list[Path],
        typer.Argument(
            metavar="FILE...",
            help="Calibrations of OpenCV, Kalibr, ROS, caliscope, aniposelib, pycalib or COLMAP, "
            "and at most one body: .csv, .rom, .vsk or .obj.",
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


def calibrate(
    session: Annotated[Path, typer.Argument(metavar="SESSION.toml", help="The session file.")],
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", metavar="CALIBRATED.toml", help="The calibrated session."),
    ] = None,
    poses: Annotated[
        Path | None,
        typer.Option(metavar="POSES.jsonl", help="Known poses of the body; else none is known."),
    ] = None,
    free: Annotated[
        list[str] | None,
        typer.Option(
            metavar="SENSOR:WHAT",
            help="What is sought: pose, focal, principal_point, distortion, delay, drift, "
            "position, range_bias, of a sensor or, without its name, of all; or body, the marker "
            "coordinates. Repeatable. Else the poses of all cameras but the first and the "
            "positions of range sensors.",
        ),
    ] = None,
    source: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME=PATH", help="Recording of a sensor in place of the session's."),
    ] = None,
) -> None:
    """Calibrate sensors from a recording of the body, without matching markers."""
    from mixpose.cli.calibrate import (  # noqa: PLC0415
        CalibrateRequest,
        calibrate_session,
        parse_free,
    )

    request = CalibrateRequest(
        output=output,
        poses=poses,
        free=parse_free(free or ()),
        sources=tuple(source or ()),
        report=None,
    )
    calibrate_session(session, request)


def design(
    sessions: Annotated[
        list[Path],
        typer.Argument(
            metavar="SESSION.toml", help="One system or several; others are held to the first."
        ),
    ],
    poses: Annotated[
        Path | None,
        typer.Option(metavar="POSES.jsonl", help="Judge at these poses, not over a volume."),
    ] = None,
    count: Annotated[
        int, typer.Option(min=1, max=2000, help="Number of poses in the volume.")
    ] = 24,
    volume: Annotated[
        str | None,
        typer.Option(
            metavar="X,Y,Z",
            help="Sides of the box around [start] or the middle of the view; else twice the "
            "body's radius.",
        ),
    ] = None,
    turn: Annotated[
        float | None,
        typer.Option(help="Turn the body by up to so many degrees; else 20 about [start], or 180."),
    ] = None,
    tip: Annotated[
        str | None,
        typer.Option(metavar="X,Y,Z", help="Judge a point of the body, in its coordinates."),
    ] = None,
    noise: Annotated[
        list[str] | None,
        typer.Option(
            metavar="SENSOR=NUMBER",
            help="What features err by, px or length; SYSTEM:SENSOR=NUMBER for one system, * for "
            "every sensor; else 0.2 of sigma for cameras, sigma for ranges.",
        ),
    ] = None,
    monte_carlo: Annotated[
        int, typer.Option(min=0, help="Simulate and estimate so many frames of each system.")
    ] = 0,
    seed: Annotated[int, typer.Option(min=0, help="Same seed, same study.")] = 0,
    tolerance: Annotated[
        float | None,
        typer.Option(help="Markers of two bodies lie alike within this; else 10 % of the radius."),
    ] = None,
    json: Annotated[Path | None, typer.Option(help="Write all numbers here.")] = None,
    plot: Annotated[Path | None, typer.Option(help="Draw it: .png, .svg or .pdf.")] = None,
) -> None:
    """Predict the accuracy of planned systems, side by side, and what would improve them."""
    from mixpose.cli.design import DesignRequest, design_sessions  # noqa: PLC0415

    request = DesignRequest(
        poses=poses,
        count=count,
        volume=volume,
        turn=turn,
        tip=tip,
        noise=tuple(noise or ()),
        runs=monte_carlo,
        seed=seed,
        tolerance=tolerance,
        json=json,
        plot=plot,
    )
    design_sessions(sessions, request)
