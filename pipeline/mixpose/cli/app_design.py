"""``mixpose design``: its options, and what is called."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

Sessions = Annotated[
    list[Path],
    typer.Argument(
        metavar="SESSION.toml", help="One system or several; others are held to the first."
    ),
]
Poses = Annotated[
    Path | None,
    typer.Option(metavar="POSES.jsonl", help="Judge at these poses, not over a volume."),
]
Count = Annotated[int, typer.Option(min=1, max=2000, help="Number of poses in the volume.")]
Volume = Annotated[
    str | None,
    typer.Option(
        metavar="X,Y,Z",
        help="Sides of the box around [start] or the middle of the view; else twice the "
        "body's radius.",
    ),
]
Turn = Annotated[
    float | None,
    typer.Option(help="Turn the body by up to so many degrees; else 20 about [start], or 180."),
]
Tip = Annotated[
    str | None,
    typer.Option(metavar="X,Y,Z", help="Judge a point of the body, in its coordinates."),
]
Noise = Annotated[
    list[str] | None,
    typer.Option(
        metavar="SENSOR=NUMBER",
        help="What features err by, px or length; SYSTEM:SENSOR=NUMBER for one system, * for "
        "every sensor; else 0.2 of sigma for cameras, sigma for ranges.",
    ),
]
MonteCarlo = Annotated[
    int, typer.Option(min=0, help="Simulate and estimate so many frames of each system.")
]
Seed = Annotated[int, typer.Option(min=0, help="Same seed, same study.")]
Tolerance = Annotated[
    float | None,
    typer.Option(help="Markers of two bodies lie alike within this; else 10 % of the radius."),
]
JsonFile = Annotated[Path | None, typer.Option(help="Write all numbers here.")]
PlotFile = Annotated[Path | None, typer.Option(help="Draw it: .png, .svg or .pdf.")]
Workers = Annotated[int, typer.Option(min=1, help="How many poses are simulated at a time.")]
Scheduler = Annotated[
    str | None,
    typer.Option(
        metavar="ADDRESS",
        help="Simulate on a dask.distributed cluster: the address of its scheduler, or local for "
        "one on this machine.",
    ),
]


def design(
    sessions: Sessions,
    poses: Poses = None,
    count: Count = 24,
    volume: Volume = None,
    turn: Turn = None,
    tip: Tip = None,
    noise: Noise = None,
    monte_carlo: MonteCarlo = 0,
    seed: Seed = 0,
    tolerance: Tolerance = None,
    json: JsonFile = None,
    plot: PlotFile = None,
    workers: Workers = 1,
    scheduler: Scheduler = None,
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
        workers=workers,
        scheduler=scheduler,
    )
    design_sessions(sessions, request)
