"""What people type: ``mixpose calibrate``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from mixpose.cli.words import SessionFile

Output = Annotated[
    Path | None,
    typer.Option("-o", "--output", metavar="CALIBRATED.toml", help="The calibrated session."),
]
Poses = Annotated[
    Path | None,
    typer.Option(metavar="POSES.jsonl", help="Known poses of the body; else none is known."),
]
Free = Annotated[
    list[str] | None,
    typer.Option(
        metavar="SENSOR:WHAT",
        help="What is sought: pose, focal, principal_point, distortion, delay, drift, "
        "position, range_bias, of a sensor or, without its name, of all; or body, the marker "
        "coordinates. Repeatable. Else the poses of all cameras but the first and the "
        "positions of range sensors.",
    ),
]
Length = Annotated[
    str | None,
    typer.Option(metavar="SENSOR:SENSOR=LENGTH", help="A known distance, which gives scale."),
]
World = Annotated[
    str | None,
    typer.Option(metavar="SENSOR|body@FRAME", help="Whose frame becomes the world; else it stays."),
]
Check = Annotated[
    bool, typer.Option("--check", help="Only say whether the calibration still holds.")
]
Report = Annotated[Path | None, typer.Option(metavar="FILE.html", help="A page with pictures.")]
Sources = Annotated[
    list[str] | None,
    typer.Option(metavar="NAME=PATH", help="Recording of a sensor in place of the session's."),
]


def calibrate(
    session: SessionFile,
    output: Output = None,
    poses: Poses = None,
    free: Free = None,
    length: Length = None,
    world: World = None,
    check: Check = False,
    report: Report = None,
    source: Sources = None,
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
        report=report,
        check=check,
        length=length,
        world=world,
    )
    calibrate_session(session, request)
