"""``mixpose simulate``: its options, and what is called."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path
from typing import Annotated

import typer

from mixpose.cli.words import SessionFile

Output = Annotated[Path, typer.Option("-o", "--output", help="New folder for the recording.")]
Frames = Annotated[int, typer.Option(min=1, help="Number of frames.")]
Seed = Annotated[int, typer.Option(min=0, help="Same seed, same recording.")]
Fps = Annotated[
    float | None,
    typer.Option(help="Frames per second; for poses with times put fps into the session."),
]
Noise = Annotated[float, typer.Option(help="Camera noise, grey levels.")]
Clutter = Annotated[float, typer.Option(help="False features per frame and sensor.")]
Hidden = Annotated[float, typer.Option(help="Chance that a feature is hidden.")]
Missing = Annotated[float, typer.Option(help="Chance that a sensor has no frame.")]
Brightness = Annotated[float, typer.Option(help="Peak of a spot, grey levels.")]
BrightnessSpread = Annotated[
    float, typer.Option(help="Spread of the brightness over the features, as a share.")
]
Translation = Annotated[
    float | None,
    typer.Option("--translation", help="Largest displacement along each axis, length units."),
]
Rotation = Annotated[
    float, typer.Option("--rotation", help="Largest turn about each axis, degrees.")
]
Period = Annotated[float, typer.Option("--period", help="Seconds in which the motion comes round.")]
PixelNoise = Annotated[float, typer.Option(help="Error of detections in a camera's table, px.")]
RangeNoise = Annotated[
    float | None,
    typer.Option(help="Error of detections in tables of ranges and of clouds, length units."),
]
RangeSnr = Annotated[float, typer.Option(help="Height of a profile's peak over its noise.")]
Deform = Annotated[
    bool, typer.Option("--deform", help="Displace features by the spread the object states.")
]
Readout = Annotated[
    float | None,
    typer.Option(help="Seconds from a camera's first row to its last; else the session's."),
]
Exposure = Annotated[
    float | None, typer.Option(help="Seconds for which a row is lit; else the session's.")
]
Delay = Annotated[
    list[str] | None,
    typer.Option(metavar="NAME=SECONDS", help="A sensor that is late; else the session's."),
]
OutOfStep = Annotated[
    float, typer.Option(help="Seconds from the first sensor to the last, in their times.")
]
Lamps = Annotated[int, typer.Option(min=0, help="Lamps behind the body.")]
Mirror = Annotated[
    float, typer.Option(help="Brightness of mirror images in a table below, as a share.")
]
Others = Annotated[
    int, typer.Option(min=0, help="Other bodies with as many markers, beside this one.")
]
Occluder = Annotated[int, typer.Option(min=0, help="Dark bars that swing before it.")]
Jpeg = Annotated[int | None, typer.Option(min=1, max=100, help="Quality of lossy compression.")]
Bayer = Annotated[bool, typer.Option("--bayer", help="Images of a colour sensor, interpolated.")]
TurnedCamera = Annotated[
    float,
    typer.Option("--turned-camera", help="Degrees by which the last camera was turned meanwhile."),
]
AwayFrom = Annotated[int | None, typer.Option(min=0, help="Frames after which the body is gone.")]
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
