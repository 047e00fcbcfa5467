"""What people type: ``mixpose learn``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from mixpose.cli.words import AllowCode, SessionFile

Output = Annotated[
    Path,
    typer.Option(
        "-o",
        "--output",
        metavar="BODY.csv",
        help="Table of the markers; of several bodies the others go to BODY-2.csv and so on.",
    ),
]
Axes = Annotated[
    str | None,
    typer.Option(
        metavar="ORIGIN,X,Y",
        help="Three markers by name: the origin, one on the x axis, one in the x-y plane. Else the "
        "middle of all markers and their principal axes.",
    ),
]
Like = Annotated[
    Path | None,
    typer.Option(
        metavar="OLD.csv",
        help="An older or measured table of the same markers, whose axes and names are kept.",
    ),
]
Sources = Annotated[
    list[str] | None,
    typer.Option(metavar="NAME=PATH", help="Recording of a sensor in place of the session's."),
]


def learn(
    session: SessionFile,
    output: Output,
    axes: Axes = None,
    like: Like = None,
    source: Sources = None,
    allow_code: AllowCode = False,
) -> None:
    """Learn the markers of bodies from a recording in which they move."""
    from mixpose.cli.learn import LearnRequest, learn_session  # noqa: PLC0415

    request = LearnRequest(
        output=output, axes=axes, like=like, sources=tuple(source or ()), allow_code=allow_code
    )
    learn_session(session, request)
