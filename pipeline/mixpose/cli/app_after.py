"""Commands for existing poses and their options: evaluate, report, convert, smooth and more."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import typer

from mixpose.cli.words import AllowCode, ConvertFormat, PosesFile, Recordings, SessionFile, option

TRUTH = typer.Argument(metavar="TRUTH.jsonl", help="True poses.")


def evaluate(
    poses: PosesFile,
    truth: Annotated[Path, TRUTH],
    json: Annotated[bool, typer.Option("--json", help="Print JSON instead of a table.")] = False,
) -> None:
    """Errors of poses against the truth, modulo the object's symmetries."""
    from json import dumps  # noqa: PLC0415

    from mixpose.cli.notices import warn  # noqa: PLC0415
    from mixpose.poses.evaluate import evaluate as errors_of  # noqa: PLC0415
    from mixpose.poses.jsonl import read_poses  # noqa: PLC0415
    from mixpose.poses.report import as_dict, as_table  # noqa: PLC0415

    files = [read_poses(path) for path in (poses, truth)]
    errors = errors_of(*files)
    for file in files:
        if file.unit is None and errors.unit is not None:
            warn(f"{file.path}: no header says the unit of its lengths; taken for {errors.unit}")
    text = dumps(as_dict(errors), indent=2) if json else as_table(errors)
    sys.stdout.write(text.rstrip("\n") + "\n")


@dataclass(frozen=True)
class ReportRequest:
    """One page about a run: motion, accuracy, residuals, latency, frames with their poses."""

    poses: PosesFile
    output: Path = option("The page, as report.html; or stdout (-).", ...)
    truth: Annotated[Path | None, TRUTH] = None


def schema() -> None:
    """Print the JSON Schema of pose lines."""
    from mixpose.poses.schema import schema_text  # noqa: PLC0415

    typer.echo(schema_text(), nl=False)


@dataclass(frozen=True)
class ConvertRequest:
    """Write poses in the format of another program."""

    poses: Annotated[Path, typer.Argument(metavar="POSES.jsonl", help="Poses or true poses.")]
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
    allow_code: AllowCode = False


@dataclass(frozen=True)
class SmoothRequest:
    """Smooth the poses of a recording, each by all that came before and after."""

    poses: PosesFile
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

    poses: PosesFile
    object: str | None = option("The tool, where there are several bodies.", metavar="OBJECT")
    reference: str | None = option(
        "The tip stays at a point of this body; else of the world.", metavar="OBJECT"
    )
    into: Path | None = option("Write the tip into this session.", metavar="SESSION.toml")


@dataclass(frozen=True)
class AlignRequest:
    """A session in the frame of the floor: bodies, points or a plane that lie on it."""

    session: SessionFile
    floor: list[str] = option(
        "What lies on the floor: poses, or a body in a frame. Repeatable.",
        ...,
        metavar="POSES.jsonl|OBJECT@FRAME",
    )
    output: Path = option("The aligned session; or stdout (-).", ..., metavar="ALIGNED.toml")
    up: Literal["x", "y", "z"] = option("The axis that points up.", "z")
    source: Recordings = None
    allow_code: AllowCode = False
