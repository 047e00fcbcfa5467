"""Messages between run and page: a `Moment`, or None at the end, and a `PageMessage` back."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal, TypeAlias

import numpy as np

from mixpose.constants import constant
from mixpose.records import Estimate, Floats, RawFrame, Status


@dataclass(frozen=True)
class Pace:
    """Limits of what is drawn on the page, and of waiting for browsers."""

    most_per_second: float = constant(
        20.0, "moments: a motion looks smooth from about 16 pictures a second on"
    )
    share: float = constant(
        0.5, "of its time that the page draws: the run has the other half of that processor"
    )
    history: int = constant(600, "frames in plots: about as many as a plot has pixels across")
    trail: int = constant(200, "frames of a trail: longer ones hide the scene")
    patience_s: float = constant(
        30.0, "that a run on files waits for a browser: time to copy the address"
    )
    parting_s: float = constant(
        30.0,
        "that the page stays open after the run: a slow browser has drawn the last frame by then, "
        "and a forgotten one does not keep a script for ever",
    )


PACE = Pace()


@dataclass(frozen=True)
class Row:
    """One frame in plots and trails, kept also for frames that are not shown."""

    frame: int
    statuses: tuple[Status, ...]  # of the bodies, in the session's order
    places: tuple[Floats | None, ...]  # origins of the bodies (3,) in the world
    # the largest `rms` over the bodies, by name of the sensor; without sensors that met nothing
    residuals: Mapping[str, float]


@dataclass(frozen=True)
class ShownFrame:
    """A sensor's frame on the page."""

    frame: RawFrame | None  # None if the sensor has none
    zoom: float = 1.0  # scale of its image, shrunk for the page
    features: Floats | None = None  # (M, 2), in pixels of the sensor


@dataclass(frozen=True)
class Moment:
    """A frame that is shown, with rows of the frames since the previous moment."""

    estimates: tuple[Estimate, ...]  # of all bodies
    sensors: Mapping[str, ShownFrame]
    # of frames since the previous moment and of this one, the newest `Pace.history`
    rows: tuple[Row, ...]
    counts: Mapping[Status, int] = field(default_factory=dict)  # number of poses so far
    per_second: float = float("nan")  # rate of frames in the last seconds


PageMessage: TypeAlias = Literal["next", "pause", "go on", "step"] | int
"""A message of the page: a request for the next moment, a click, or the number of browsers."""


def row_of(estimates: tuple[Estimate, ...]) -> Row:
    """Return the row of a frame for plots and trails."""
    residuals: dict[str, float] = {}
    for estimate in estimates:
        for name, report in estimate.sensors.items():
            if report.rms is not None and np.isfinite(report.rms):
                residuals[name] = max(report.rms, residuals.get(name, 0.0))
    statuses = tuple(estimate.status for estimate in estimates)
    poses = [estimate.T_world_object for estimate in estimates]
    places = tuple(None if T is None else T[:3, 3] for T in poses)
    return Row(estimates[0].frame, statuses, places, residuals)
