"""What people type before there are poses: ``mixpose import``, calibrate, learn and design."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from mixpose.cli.words import AllowCode, Recordings, SessionFile, option
from mixpose.units import Unit


@dataclass(frozen=True)
class ImportRequest:
    """Make a session of the calibration files of other programs."""

    files: Annotated[
        list[Path],
        typer.Argument(
            metavar="FILE...",
            help="Calibrations of OpenCV, Kalibr, ROS, caliscope, aniposelib, pycalib or COLMAP, "
            "and bodies: .csv, .rom, .vsk or .obj.",
        ),
    ]
    output: Path = option(
        ..., "The session file, which must be new; or stdout (-).", "-o", "--output"
    )
    unit: Unit = option("mm", "Unit of lengths in the session.")
    lengths: Unit | None = option(
        None, "Unit of translations in files whose format does not fix it."
    )


@dataclass(frozen=True)
class CalibrateRequest:
    """Calibrate sensors from a recording of the body, without matching markers."""

    session: SessionFile
    output: Path | None = option(
        None, "The calibrated session; or stdout (-).", "-o", "--output", metavar="CALIBRATED.toml"
    )
    poses: Path | None = option(
        None, "Known poses of the body; else none is known.", metavar="POSES.jsonl"
    )
    free: list[str] | None = option(
        None,
        "What is sought: pose, focal, principal_point, distortion, delay, drift, "
        "position, range_bias, of a sensor or, without its name, of all; or body, the marker "
        "coordinates. Repeatable. Else the poses of all cameras but the first and the "
        "positions of range sensors.",
        metavar="SENSOR:WHAT",
    )
    length: str | None = option(
        None, "A known distance, which gives scale.", metavar="SENSOR:SENSOR=LENGTH"
    )
    world: str | None = option(
        None, "Whose frame becomes the world; else it stays.", metavar="SENSOR|body@FRAME"
    )
    check: bool = option(False, "Only say whether the calibration still holds.")
    report: Path | None = option(None, "A page with pictures; or stdout (-).", metavar="FILE.html")
    source: Recordings = None
    allow_code: AllowCode = False


@dataclass(frozen=True)
class LearnRequest:
    """Learn the markers of bodies from a recording in which they move."""

    session: SessionFile
    output: Path = option(
        ...,
        "Table of the markers; of several bodies the others go to BODY-2.csv and so on. A single "
        "one may go to stdout (-).",
        "-o",
        "--output",
        metavar="BODY.csv",
    )
    axes: str | None = option(
        None,
        "Three markers by name: the origin, one on the x axis, one in the x-y plane. Else "
        "the middle of all markers and their principal axes.",
        metavar="ORIGIN,X,Y",
    )
    like: Path | None = option(
        None,
        "An older or measured table of the same markers, whose axes and names are kept.",
        metavar="OLD.csv",
    )
    source: Recordings = None
    allow_code: AllowCode = False


@dataclass(frozen=True)
class DesignRequest:
    """Predict the accuracy of planned systems, side by side, and what would improve them."""

    sessions: Annotated[
        list[Path],
        typer.Argument(
            metavar="SESSION.toml", help="One system or several; others are held to the first."
        ),
    ]
    poses: Path | None = option(
        None, "Judge at these poses, not over a volume.", metavar="POSES.jsonl"
    )
    count: int = option(24, "Number of poses in the volume.", min=1, max=2000)
    volume: str | None = option(
        None,
        "Sides of the box around [start] or the middle of the view; else twice the body's radius.",
        metavar="X,Y,Z",
    )
    turn: float | None = option(
        None, "Turn the body by up to so many degrees; else 20 about [start], or 180."
    )
    tip: str | None = option(
        None, "Judge a point of the body, in its coordinates.", metavar="X,Y,Z"
    )
    noise: list[str] | None = option(
        None,
        "What features err by, px or length; SYSTEM:SENSOR=NUMBER for one system, * for "
        "every sensor; else 0.2 of sigma for cameras, sigma for ranges.",
        metavar="SENSOR=NUMBER",
    )
    monte_carlo: int = option(0, "Simulate and estimate so many frames of each system.", min=0)
    seed: int = option(0, "Same seed, same study.", min=0)
    tolerance: float | None = option(
        None,
        "Markers of two bodies lie alike within this; else 10 % of the radius.",
        min=0,
        max=1e9,
    )
    json: Path | None = option(None, "Write all numbers here; or to stdout (-).")
    plot: Path | None = option(None, "Draw it: .png, .svg or .pdf.")
    workers: int = option(1, "How many poses are simulated at a time.", min=1)
    scheduler: str | None = option(
        None,
        "Simulate on a dask.distributed cluster: the address of its scheduler, or local "
        "for one on this machine.",
        metavar="ADDRESS",
    )
