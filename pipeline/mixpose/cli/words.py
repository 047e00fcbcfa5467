"""Arguments and options that several commands share, and the words that they allow."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

SessionFile = Annotated[Path, typer.Argument(metavar="SESSION.toml", help="The session file.")]
AllowCode = Annotated[
    bool,
    typer.Option(
        "--allow-code",
        help='Run functions that the session names: method = "module:function".',
    ),
]


class Format(StrEnum):
    """Formats of poses."""

    jsonl = "jsonl"
    csv = "csv"
    tum = "tum"
    bop = "bop"
    ros = "ros"


class LengthUnit(StrEnum):
    """Units of length."""

    m = "m"
    cm = "cm"
    mm = "mm"
    um = "um"


class ConvertFormat(StrEnum):
    """Formats that poses are converted to."""

    jsonl = "jsonl"
    csv = "csv"
    tum = "tum"
    bop = "bop"
    ros = "ros"
    rerun = "rerun"
    c3d = "c3d"
    trc = "trc"


Step = Annotated[int, typer.Option(min=1, help="Take every N-th frame number.")]
Start = Annotated[int | None, typer.Option(help="First frame number.")]
Stop = Annotated[int | None, typer.Option(help="Frame number to stop before.")]
PosesFile = Annotated[Path, typer.Argument(metavar="POSES.jsonl", help="Estimated poses.")]
