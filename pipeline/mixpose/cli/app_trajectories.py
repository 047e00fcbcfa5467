"""What people type: ``mixpose smooth``, ``pivot`` and ``align``."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from mixpose.cli.words import PosesFile


class Motion(StrEnum):
    """Derivatives of a pose that may take white noise."""

    acceleration = "acceleration"
    jerk = "jerk"
    snap = "snap"
    crackle = "crackle"


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
