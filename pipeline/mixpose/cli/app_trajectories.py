"""What people type: ``mixpose smooth``, ``pivot`` and ``align``."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from mixpose.cli.words import PosesFile, SessionFile


class Motion(StrEnum):
    """Derivatives of a pose that may take white noise."""

    acceleration = "acceleration"
    jerk = "jerk"
    snap = "snap"
    crackle = "crackle"


class Up(StrEnum):
    """Axes of a frame."""

    x = "x"
    y = "y"
    z = "z"


def smooth(
    poses: PosesFile,
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", metavar="SMOOTH.jsonl", help="Write here, not to stdout."),
    ] = None,
    fill: Annotated[
        float,
        typer.Option(
            min=0, metavar="SECONDS", help="Fill gaps of at most so long, marked; else none."
        ),
    ] = 0.0,
    motion: Annotated[
        Motion | None,
        typer.Option(help="Which derivative of the motion takes white noise; else the likeliest."),
    ] = None,
) -> None:
    """Smooth the poses of a recording, each by all that came before and after."""
    from mixpose.cli.smooth import smooth_poses  # noqa: PLC0415

    smooth_poses(poses, output, fill_s=fill, motion=None if motion is None else motion.value)


def pivot(
    poses: PosesFile,
    object: Annotated[
        str | None, typer.Option(metavar="OBJECT", help="The tool, where there are several bodies.")
    ] = None,
    reference: Annotated[
        str | None,
        typer.Option(
            metavar="OBJECT", help="The tip stays at a point of this body; else of the world."
        ),
    ] = None,
    into: Annotated[
        Path | None,
        typer.Option(metavar="SESSION.toml", help="Write the tip into this session."),
    ] = None,
) -> None:
    """The tip of a tool, from poses while it turns about its tip."""
    from mixpose.cli.pivot import PivotRequest, pivot_poses  # noqa: PLC0415

    pivot_poses(poses, PivotRequest(object, reference, into))


def align(
    session: SessionFile,
    floor: Annotated[
        list[str],
        typer.Option(
            metavar="POSES.jsonl|OBJECT@FRAME",
            help="What lies on the floor: poses, or a body in a frame. Repeatable.",
        ),
    ],
    output: Annotated[
        Path, typer.Option("-o", "--output", metavar="ALIGNED.toml", help="The aligned session.")
    ],
    up: Annotated[Up, typer.Option(help="The axis that points up.")] = Up.z,
    source: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME=PATH", help="Recording of a sensor in place of the session's."),
    ] = None,
) -> None:
    """A session in the frame of the floor: bodies, points or a plane that lie on it."""
    from mixpose.cli.align import AlignRequest, align_session  # noqa: PLC0415

    align_session(session, AlignRequest(tuple(floor), output, up.value, tuple(source or ())))
