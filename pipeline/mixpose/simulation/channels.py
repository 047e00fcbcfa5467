"""Prepare each sensor of a recording: its view of the body and its writer."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from functools import partial
from math import ceil
from pathlib import Path

import numpy as np

from mixpose.body import Body
from mixpose.errors import SessionError
from mixpose.records import Floats
from mixpose.session import SensorSetup, Session
from mixpose.simulation import render
from mixpose.simulation.motion import Motion, Shutter
from mixpose.simulation.naming import SourceFiles
from mixpose.simulation.options import Output, Purpose, SimulationOptions, generator
from mixpose.simulation.scenery import Scenery
from mixpose.simulation.visible_spots import View, brightness_levels

_LINE_SPACING = 0.7  # of a spot's standard deviation: a line of spots looks even
_CLOUD_NOISE = 0.2  # of sigma, which is a tolerance and not the noise
_TABLE_SPACING_PX = 2.0
_SPOT_SIGMA_PX = 1.6
_OPTICS_PX = 0.7  # standard deviation by which optics blur markers that have a size
_PEAK_BINS = 1.5  # standard deviation of a peak, unless stated
_PEAK_REACH = 5.0  # standard deviations of a peak for which a profile has room
_COORDINATES = {1: ("range",), 2: ("u", "v"), 3: ("x", "y", "z")}  # columns of tables


@dataclass(frozen=True)
class Channel:
    """One sensor of a recording."""

    output: Output
    files: SourceFiles
    view: View
    options: SimulationOptions  # that hold for this sensor
    writing: Callable[[Path], AbstractContextManager[render.Write]]  # in the recording's folder
    step_s: float = 0.0  # seconds after the first sensor, as in its table of times


def check_setup(session: Session) -> None:
    """Raise a `SessionError` for a camera without a resolution, or one that looks for corners."""
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


@dataclass(frozen=True)
class Planner:
    """Preparation of the sensors of a session that `check_setup` has passed."""

    body: Body
    motion: Motion
    options: SimulationOptions
    fps: float
    scenery: Scenery  # that cameras also see

    def channel(self, setup: SensorSetup, files: SourceFiles, index: int, step_s: float) -> Channel:
        """Return the channel of a sensor, or raise a `SessionError` if it cannot be simulated.

        Random numbers are keyed by its `index` in the session; it is `step_s` later than the first
        sensor, and so are its times.
        """
        shutter, is_image = shutter_of(setup, self.options, step_s), setup.sensor.dimension == 2
        if files.kind == "detections":
            channel = self._table(setup, files)
            shutter = replace(shutter, exposure_s=0.0)  # a detection is the middle of a streak
        else:
            channel = (self._camera if is_image else self._profiles)(setup, files, index)
        scenery = self.scenery if is_image else Scenery()
        view = replace(channel.view, shutter=shutter, scenery=scenery)
        return replace(channel, view=view, step_s=step_s)

    def _camera(self, setup: SensorSetup, files: SourceFiles, index: int) -> Channel:
        assert setup.resolution is not None, "check_setup refuses this"
        options = self.options
        optics = _SPOT_SIGMA_PX if self.body.radii is None else _OPTICS_PX
        spot_sigma = options.spot_sigma or setup.extract.spot_sigma or optics
        form = render.ImageFormat(setup.resolution, spot_sigma, setup.extract.polarity)
        writing = partial(render.image_writer, files, options, form)
        if files.kind == "video":
            writing = partial(render.video_writer, files, options, form, self.fps)
        bounds = setup.sensor.lower, setup.sensor.upper
        view = self._view(setup, bounds, spot_sigma, index)
        return Channel("images", files, view, options, writing)

    def _profiles(self, setup: SensorSetup, files: SourceFiles, index: int) -> Channel:
        options, range_min, bin_size = self.options, setup.range_min, setup.bin_size
        assert range_min is not None
        assert bin_size is not None
        nearest, farthest = self._around(setup)
        width = options.range_width or setup.extract.spot_sigma or _PEAK_BINS * bin_size
        bins = ceil((farthest[0] + _PEAK_REACH * width - range_min) / bin_size) + 1
        if farthest[0] < range_min:
            raise SessionError(
                f"sensor {setup.name!r}: range_min: found {range_min:g}; the object is at "
                f"ranges from {nearest[0]:g} to {farthest[0]:g}"
            )
        form = render.ProfileFormat(bins, range_min, bin_size, width)
        view = self._view(setup, (np.maximum(nearest, range_min), farthest), width, index)
        writing = partial(render.profile_writer, files, options, form)
        return Channel("profiles", files, view, options, writing)

    def _table(self, setup: SensorSetup, files: SourceFiles) -> Channel:
        sensor, sigma, options = setup.sensor, setup.extract.sigma, self.options
        if sensor.dimension == 2:
            bounds, spacing = (sensor.lower, sensor.upper), _TABLE_SPACING_PX
            noise = options.pixel_noise
        else:
            # a line becomes detections that are about their noise apart
            bounds, spacing = self._around(setup), sigma
            usual = sigma if sensor.dimension == 1 else _CLOUD_NOISE * sigma
            noise = usual if options.range_noise is None else options.range_noise
        view = View(sensor, *bounds, np.ones(len(self.body)), spacing)
        output: Output = "pixels" if sensor.dimension == 2 else "lengths"
        even = replace(options, brightness_spread=0.0)
        writing = partial(render.detection_writer, files, noise, _COORDINATES[sensor.dimension])
        return Channel(output, files, view, even, writing)

    def _view(
        self, setup: SensorSetup, bounds: tuple[Floats, Floats], sigma: float, index: int
    ) -> View:
        """Return the view of a sensor whose spots have the standard deviation `sigma`."""
        # brightness does not change during a recording
        rng = generator(self.options.seed, Purpose.BRIGHTNESS, index)
        levels = brightness_levels(len(self.body), self.options.brightness_spread, rng)
        spacing = _LINE_SPACING * sigma
        # overlapping spots at this spacing add up to the brightness of a single spot
        ridge = float(spacing / (np.sqrt(2 * np.pi) * sigma))
        return View(setup.sensor, *bounds, levels, spacing, ridge)

    def _around(self, setup: SensorSetup) -> tuple[Floats, Floats]:
        """Return bounds (m,), (m,) of the moving body along the axes of a sensor of lengths."""
        motion, points = self.motion, self.body.nodes.points
        pivot_world = motion.T_world_object[:3, :3] @ motion.pivot + motion.T_world_object[:3, 3]
        middle, _ = setup.sensor.project(pivot_world)
        reach = motion.reach + np.linalg.norm(points - motion.pivot, axis=1).max()
        reach += 4 * self.body.spread if self.options.deform else 0.0
        nearest = middle - reach
        return np.maximum(nearest, 0.0) if setup.sensor.dimension == 1 else nearest, middle + reach


def shutter_of(setup: SensorSetup, options: SimulationOptions, step_s: float) -> Shutter:
    """Return the timing of a sensor: as the options say, else as the session states."""
    stated = setup.delay if isinstance(setup.delay, float) else 0.0
    readout = setup.readout if options.readout is None else options.readout
    exposure = setup.exposure if options.exposure is None else options.exposure
    delay = options.delay.get(setup.name, stated) + step_s
    if setup.resolution is None:
        return Shutter(delay)
    return Shutter(delay, readout, exposure, setup.resolution[1])
