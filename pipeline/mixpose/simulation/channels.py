"""What a recording needs to know of each sensor: its view of the body and its writer."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from math import ceil
from pathlib import Path

import numpy as np

from mixpose.body import Body
from mixpose.errors import SessionError
from mixpose.records import Floats
from mixpose.session import SensorSetup, Session
from mixpose.simulation.motion import Motion, Shutter
from mixpose.simulation.naming import SourceFiles
from mixpose.simulation.options import Purpose, SimulationOptions, generator
from mixpose.simulation.render import ImageFormat, ProfileFormat
from mixpose.simulation.scenery import Scenery
from mixpose.simulation.visible_spots import View, brightness_levels
from mixpose.simulation.writers import (
    DetectionWriter,
    ImageWriter,
    ProfileWriter,
    SensorWriter,
    VideoWriter,
)

_LINE_SPACING = 0.7  # of a spot's standard deviation: a line of spots looks even
_CLOUD_NOISE = 0.2  # of sigma, which is a tolerance
_TABLE_SPACING_PX = 2.0
_SPOT_SIGMA_PX = 1.6
_OPTICS_PX = 0.7  # standard deviation by which optics blur markers that have a size themselves
_PEAK_BINS = 1.5  # standard deviation of a peak, where nothing says it
_PEAK_REACH = 5.0  # standard deviations of a peak that still fit into a profile


@dataclass(frozen=True)
class Channel:
    """One sensor of a recording."""

    files: SourceFiles
    view: View
    options: SimulationOptions  # as they hold for this sensor
    open: Callable[[Path], SensorWriter]  # takes the recording's folder and starts to write there
    # seconds by which its frames are later than those of the first sensor, as its times say
    step_s: float = 0.0


def check_setup(session: Session) -> None:
    """Raise a `SessionError` for a camera without a resolution, or that looks for no spots."""
    for setup in session.sensors:
        where = f"{session.path}: sensor {setup.name!r}"
        if setup.extract.method == "corners":
            raise SessionError(
                f'{where}: extract.method: found "corners"; simulate draws spots, which "blobs", '
                '"log" and "intensity" find'
            )
        if setup.sensor.dimension == 2 and setup.resolution is None:
            raise SessionError(
                f"{where}: resolution: missing; simulate needs [width, height] in px"
            )


def plan_channel(
    setup: SensorSetup,
    files: SourceFiles,
    body: Body,
    motion: Motion,
    options: SimulationOptions,
    *,
    fps: float,
    index: int,
    scenery: Scenery = Scenery(),
    step_s: float = 0.0,
) -> Channel:
    """Prepare one sensor of a session that `check_setup` has passed.

    Its place in the session, `index`, keys its random numbers; it is `step_s` later than the first,
    and says so; cameras see `scenery`, too. A `SessionError` if it cannot be simulated.
    """
    shutter = shutter_of(setup, options, step_s)
    if setup.sensor.dimension == 1:
        channel = _range_channel(setup, files, body, motion, options, index)
        return replace(channel, view=replace(channel.view, shutter=shutter), step_s=step_s)
    if setup.sensor.dimension == 3:
        channel = _cloud_channel(setup, files, body, motion, options)
        return replace(channel, view=replace(channel.view, shutter=shutter), step_s=step_s)
    assert setup.resolution is not None, "check_setup refuses this"
    channel = _camera_channel(setup, files, body, options, setup.resolution, fps, index)
    if files.kind == "detections":  # a detection is where the middle of a streak is
        shutter = replace(shutter, exposure_s=0.0)
    view = replace(channel.view, shutter=shutter, scenery=scenery)
    return replace(channel, view=view, step_s=step_s)


def shutter_of(setup: SensorSetup, options: SimulationOptions, step_s: float) -> Shutter:
    """When a sensor sees what: as the session states, but for what the options say."""
    stated = setup.delay if isinstance(setup.delay, float) else 0.0
    readout = setup.readout if options.readout is None else options.readout
    exposure = setup.exposure if options.exposure is None else options.exposure
    late = options.delay.get(setup.name, stated) + step_s
    if setup.resolution is None:
        return Shutter(late)
    return Shutter(late, readout, exposure, setup.resolution[1])


def _camera_channel(
    setup: SensorSetup,
    files: SourceFiles,
    body: Body,
    options: SimulationOptions,
    resolution: tuple[int, int],
    fps: float,
    index: int,
) -> Channel:
    sensor, count = setup.sensor, len(body)
    if files.kind == "detections":
        view = View(sensor, sensor.lower, sensor.upper, np.ones(count), _TABLE_SPACING_PX)
        noise, coordinates = options.pixel_noise, ("u", "v")
        return Channel(
            files,
            view,
            replace(options, brightness_spread=0.0),
            lambda folder: DetectionWriter(files, folder, noise=noise, coordinates=coordinates),
        )
    optics = _SPOT_SIGMA_PX if body.radii is None else _OPTICS_PX
    spot_sigma = options.spot_sigma or setup.extract.spot_sigma or optics
    spacing = _LINE_SPACING * spot_sigma
    view = View(
        sensor,
        sensor.lower,
        sensor.upper,
        _levels(count, options, index),
        spacing,
        _ridge(spot_sigma, spacing),
    )

    form = ImageFormat(resolution, spot_sigma, setup.extract.polarity)

    def start(folder: Path) -> SensorWriter:
        if files.kind == "images":
            return ImageWriter(files, folder, options, form)
        return VideoWriter(files, folder, options, form, fps)

    return Channel(files, view, options, start)


def _range_channel(
    setup: SensorSetup,
    files: SourceFiles,
    body: Body,
    motion: Motion,
    options: SimulationOptions,
    index: int,
) -> Channel:
    nearest, farthest = _ranges(setup, body, motion, options)
    range_min, bin_size = setup.range_min, setup.bin_size
    if files.kind == "detections" or range_min is None or bin_size is None:
        noise = setup.extract.sigma if options.range_noise is None else options.range_noise
        # lines become detections about as far apart as these are exact
        view = View(setup.sensor, nearest, farthest, np.ones(len(body)), setup.extract.sigma)
        return Channel(
            files,
            view,
            replace(options, brightness_spread=0.0),
            lambda folder: DetectionWriter(files, folder, noise=noise, coordinates=("range",)),
        )
    width = options.range_width or setup.extract.spot_sigma or _PEAK_BINS * bin_size
    bins = ceil((farthest[0] + _PEAK_REACH * width - range_min) / bin_size) + 1
    if farthest[0] < range_min:
        raise SessionError(
            f"sensor {setup.name!r}: range_min: found {range_min:g}; the object is at "
            f"ranges from {nearest[0]:g} to {farthest[0]:g}"
        )
    spacing = _LINE_SPACING * width
    view = View(
        setup.sensor,
        np.maximum(nearest, range_min),
        farthest,
        _levels(len(body), options, index),
        spacing,
        _ridge(width, spacing),
    )
    form = ProfileFormat(bins, range_min, bin_size, width)
    return Channel(files, view, options, lambda folder: ProfileWriter(files, folder, options, form))


def _cloud_channel(
    setup: SensorSetup, files: SourceFiles, body: Body, motion: Motion, options: SimulationOptions
) -> Channel:
    nearest, farthest = _around(setup, body, motion, options)
    noise = options.range_noise
    if noise is None:
        noise = _CLOUD_NOISE * setup.extract.sigma
    view = View(setup.sensor, nearest, farthest, np.ones(len(body)), setup.extract.sigma)
    return Channel(
        files,
        view,
        replace(options, brightness_spread=0.0),
        lambda folder: DetectionWriter(files, folder, noise=noise, coordinates=("x", "y", "z")),
    )


def _ranges(
    setup: SensorSetup, body: Body, motion: Motion, options: SimulationOptions
) -> tuple[Floats, Floats]:
    """Bounds (1,), (1,) of the ranges that the moving body can have."""
    nearest, farthest = _around(setup, body, motion, options)
    return np.maximum(nearest, 0.0), farthest


def _around(
    setup: SensorSetup, body: Body, motion: Motion, options: SimulationOptions
) -> tuple[Floats, Floats]:
    """Bounds (m,), (m,) of lengths along the axes of a sensor that the moving body can have."""
    pivot_world = motion.T_world_object[:3, :3] @ motion.pivot + motion.T_world_object[:3, 3]
    middle, _ = setup.sensor.project(pivot_world)
    reach = motion.reach + np.linalg.norm(body.nodes.points - motion.pivot, axis=1).max()
    reach += 4 * body.spread if options.deform else 0.0
    return middle - reach, middle + reach


def _levels(count: int, options: SimulationOptions, index: int) -> Floats:
    """Brightness of the features, the same throughout a recording."""
    rng = generator(options.seed, Purpose.BRIGHTNESS, index)
    return brightness_levels(count, options.brightness_spread, rng)


def _ridge(sigma: float, spacing: float) -> float:
    """Brightness of spots this far apart that together are as bright as one spot alone."""
    return float(spacing / (np.sqrt(2 * np.pi) * sigma))
