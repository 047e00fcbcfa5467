"""``mixpose simulate``: its options, and what is called."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path
from typing import Annotated

import typer

from mixpose.cli.words import SessionFile

MOTION, IMAGES, TABLES = "Motion of the body", "Images", "Profiles and tables"
IN_VIEW, TIME = "What else is in view", "Time, and sensors that are not as told"

Output = Annotated[Path, typer.Option("-o", "--output", help="New folder for the recording.")]
Frames = Annotated[int, typer.Option(min=1, help="Number of frames.")]
Seed = Annotated[int, typer.Option(min=0, help="Same seed, same recording.")]
Fps = Annotated[
    float | None,
    typer.Option(
        rich_help_panel=TIME,
        help="Frames per second; for poses with times put fps into the session.",
    ),
]
Noise = Annotated[float, typer.Option(rich_help_panel=IMAGES, help="Camera noise, grey levels.")]
Clutter = Annotated[
    float, typer.Option(rich_help_panel=IN_VIEW, help="False features per frame and sensor.")
]
Hidden = Annotated[
    float, typer.Option(rich_help_panel=IN_VIEW, help="Chance that a feature is hidden.")
]
Missing = Annotated[
    float, typer.Option(rich_help_panel=TIME, help="Chance that a sensor has no frame.")
]
Brightness = Annotated[
    float, typer.Option(rich_help_panel=IMAGES, help="Peak of a spot, grey levels.")
]
BrightnessSpread = Annotated[
    float,
    typer.Option(
        rich_help_panel=IMAGES, help="Spread of the brightness over the features, as a share."
    ),
]
Translation = Annotated[
    float | None,
    typer.Option(
        "--translation",
        rich_help_panel=MOTION,
        help="Largest displacement along each axis, length units.",
    ),
]
Rotation = Annotated[
    float,
    typer.Option(
        "--rotation", rich_help_panel=MOTION, help="Largest turn about each axis, degrees."
    ),
]
Period = Annotated[
    float,
    typer.Option(
        "--period", rich_help_panel=MOTION, help="Seconds in which the motion comes round."
    ),
]
PixelNoise = Annotated[
    float, typer.Option(rich_help_panel=TABLES, help="Error of detections in a camera's table, px.")
]
RangeNoise = Annotated[
    float | None,
    typer.Option(
        rich_help_panel=TABLES,
        help="Error of detections in tables of ranges and of clouds, length units.",
    ),
]
RangeSnr = Annotated[
    float, typer.Option(rich_help_panel=TABLES, help="Height of a profile's peak over its noise.")
]
Deform = Annotated[
    bool,
    typer.Option(
        "--deform",
        rich_help_panel=IN_VIEW,
        help="Displace features by the spread the object states.",
    ),
]
Readout = Annotated[
    float | None,
    typer.Option(
        rich_help_panel=TIME,
        help="Seconds from a camera's first row to its last; else the session's.",
    ),
]
Exposure = Annotated[
    float | None,
    typer.Option(rich_help_panel=TIME, help="Seconds for which a row is lit; else the session's."),
]
Delay = Annotated[
    list[str] | None,
    typer.Option(
        metavar="NAME=SECONDS",
        rich_help_panel=TIME,
        help="A sensor that is late; else the session's.",
    ),
]
OutOfStep = Annotated[
    float,
    typer.Option(
        rich_help_panel=TIME, help="Seconds from the first sensor to the last, in their times."
    ),
]
Lamps = Annotated[int, typer.Option(min=0, rich_help_panel=IN_VIEW, help="Lamps behind the body.")]
Mirror = Annotated[
    float,
    typer.Option(
        rich_help_panel=IN_VIEW, help="Brightness of mirror images in a table below, as a share."
    ),
]
Others = Annotated[
    int,
    typer.Option(
        min=0, rich_help_panel=IN_VIEW, help="Other bodies with as many markers, beside this one."
    ),
]
Occluder = Annotated[
    int, typer.Option(min=0, rich_help_panel=IN_VIEW, help="Dark bars that swing before it.")
]
Jpeg = Annotated[
    int | None,
    typer.Option(min=1, max=100, rich_help_panel=IMAGES, help="Quality of lossy compression."),
]
Bayer = Annotated[
    bool,
    typer.Option(
        "--bayer", rich_help_panel=IMAGES, help="Images of a colour sensor, interpolated."
    ),
]
TurnedCamera = Annotated[
    float,
    typer.Option(
        "--turned-camera",
        rich_help_panel=TIME,
        help="Degrees by which the last camera was turned meanwhile.",
    ),
]
AwayFrom = Annotated[
    int | None,
    typer.Option(min=0, rich_help_panel=MOTION, help="Frames after which the body is gone."),
]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace a recording in the folder.")]


def simulate(
    context: typer.Context,
    session: SessionFile,
    output: Output,
    frames: Frames,
    seed: Seed = 0,
    fps: Fps = None,
    noise: Noise = 2.0,
    clutter: Clutter = 0.0,
    hidden: Hidden = 0.0,
    missing: Missing = 0.0,
    brightness: Brightness = 170.0,
    brightness_spread: BrightnessSpread = 0.1,
    amplitude_translation: Translation = None,
    amplitude_rotation_deg: Rotation = 20.0,
    period_s: Period = 4.0,
    pixel_noise: PixelNoise = 0.1,
    range_noise: RangeNoise = None,
    range_snr: RangeSnr = 30.0,
    deform: Deform = False,
    readout: Readout = None,
    exposure: Exposure = None,
    delay: Delay = None,
    out_of_step: OutOfStep = 0.0,
    lamps: Lamps = 0,
    mirror: Mirror = 0.0,
    others: Others = 0,
    occluder: Occluder = 0,
    jpeg: Jpeg = None,
    bayer: Bayer = False,
    turned_camera_deg: TurnedCamera = 0.0,
    away_from: AwayFrom = None,
    overwrite: Overwrite = False,
) -> None:
    """Render a recording with truth.jsonl that `run` can play."""
    from mixpose.cli.simulate import delays_of, simulate_session  # noqa: PLC0415
    from mixpose.simulation import SimulationOptions  # noqa: PLC0415

    names = {one.name for one in fields(SimulationOptions)} - {"delay"}
    given = {name: value for name, value in context.params.items() if name in names}
    options = SimulationOptions(**given, delay=delays_of(delay or []))
    simulate_session(session, output, options, overwrite=overwrite)
