"""``mixpose simulate``: its options, and what is called."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from mixpose.cli.words import SessionFile, taking

MOTION, IMAGES, TABLES = "Motion of the body", "Images", "Profiles and tables"
IN_VIEW, TIME = "What else is in view", "Time, and sensors that are not as told"


@dataclass(frozen=True)
class SimulateRequest:
    """What was asked for; most of it are fields of `mixpose.simulation.SimulationOptions`."""

    session: SessionFile
    output: Annotated[Path, typer.Option("-o", "--output", help="New folder for the recording.")]
    frames: Annotated[int, typer.Option(min=1, help="Number of frames.")]
    seed: Annotated[int, typer.Option(min=0, help="Same seed, same recording.")] = 0
    fps: Annotated[
        float | None,
        typer.Option(
            rich_help_panel=TIME,
            help="Frames per second; for poses with times put fps into the session.",
        ),
    ] = None
    noise: Annotated[
        float, typer.Option(rich_help_panel=IMAGES, help="Camera noise, grey levels.")
    ] = 2.0
    clutter: Annotated[
        float, typer.Option(rich_help_panel=IN_VIEW, help="False features per frame and sensor.")
    ] = 0.0
    hidden: Annotated[
        float, typer.Option(rich_help_panel=IN_VIEW, help="Chance that a feature is hidden.")
    ] = 0.0
    missing: Annotated[
        float, typer.Option(rich_help_panel=TIME, help="Chance that a sensor has no frame.")
    ] = 0.0
    brightness: Annotated[
        float, typer.Option(rich_help_panel=IMAGES, help="Peak of a spot, grey levels.")
    ] = 170.0
    brightness_spread: Annotated[
        float,
        typer.Option(
            rich_help_panel=IMAGES, help="Spread of the brightness over the features, as a share."
        ),
    ] = 0.1
    amplitude_translation: Annotated[
        float | None,
        typer.Option(
            "--translation",
            rich_help_panel=MOTION,
            help="Largest displacement along each axis, length units.",
        ),
    ] = None
    amplitude_rotation_deg: Annotated[
        float,
        typer.Option(
            "--rotation", rich_help_panel=MOTION, help="Largest turn about each axis, degrees."
        ),
    ] = 20.0
    period_s: Annotated[
        float,
        typer.Option(
            "--period", rich_help_panel=MOTION, help="Seconds in which the motion comes round."
        ),
    ] = 4.0
    pixel_noise: Annotated[
        float,
        typer.Option(rich_help_panel=TABLES, help="Error of detections in a camera's table, px."),
    ] = 0.1
    range_noise: Annotated[
        float | None,
        typer.Option(
            rich_help_panel=TABLES,
            help="Error of detections in tables of ranges and of clouds, length units.",
        ),
    ] = None
    range_snr: Annotated[
        float,
        typer.Option(rich_help_panel=TABLES, help="Height of a profile's peak over its noise."),
    ] = 30.0
    deform: Annotated[
        bool,
        typer.Option(
            "--deform",
            rich_help_panel=IN_VIEW,
            help="Displace features by the spread the object states.",
        ),
    ] = False
    readout: Annotated[
        float | None,
        typer.Option(
            rich_help_panel=TIME,
            help="Seconds from a camera's first row to its last; else the session's.",
        ),
    ] = None
    exposure: Annotated[
        float | None,
        typer.Option(
            rich_help_panel=TIME, help="Seconds for which a row is lit; else the session's."
        ),
    ] = None
    delay: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME=SECONDS",
            rich_help_panel=TIME,
            help="A sensor that is late; else the session's.",
        ),
    ] = None
    out_of_step: Annotated[
        float,
        typer.Option(
            rich_help_panel=TIME, help="Seconds from the first sensor to the last, in their times."
        ),
    ] = 0.0
    lamps: Annotated[
        int, typer.Option(min=0, rich_help_panel=IN_VIEW, help="Lamps behind the body.")
    ] = 0
    mirror: Annotated[
        float,
        typer.Option(
            rich_help_panel=IN_VIEW,
            help="Brightness of mirror images in a table below, as a share.",
        ),
    ] = 0.0
    others: Annotated[
        int,
        typer.Option(
            min=0,
            rich_help_panel=IN_VIEW,
            help="Other bodies with as many markers, beside this one.",
        ),
    ] = 0
    occluder: Annotated[
        int, typer.Option(min=0, rich_help_panel=IN_VIEW, help="Dark bars that swing before it.")
    ] = 0
    jpeg: Annotated[
        int | None,
        typer.Option(min=1, max=100, rich_help_panel=IMAGES, help="Quality of lossy compression."),
    ] = None
    bayer: Annotated[
        bool,
        typer.Option(
            "--bayer", rich_help_panel=IMAGES, help="Images of a colour sensor, interpolated."
        ),
    ] = False
    turned_camera_deg: Annotated[
        float,
        typer.Option(
            "--turned-camera",
            rich_help_panel=TIME,
            help="Degrees by which the last camera was turned meanwhile.",
        ),
    ] = 0.0
    away_from: Annotated[
        int | None,
        typer.Option(min=0, rich_help_panel=MOTION, help="Frames after which the body is gone."),
    ] = None
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace a recording in the folder.")
    ] = False


@taking(SimulateRequest)
def simulate(request: SimulateRequest) -> None:
    """Render a recording with truth.jsonl that `run` can play."""
    from mixpose.cli.simulate import simulate_session  # noqa: PLC0415

    simulate_session(request)
