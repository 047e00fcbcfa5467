"""What passes from the run to the page, a `Moment` or None at the end, and back."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal, TypeAlias

import numpy as np

from mixpose.constants import constant
from mixpose.records import Estimate, Floats, RawFrame, Status


@dataclass(frozen=True)
class Pace:
    """How often, and how much, the page is told."""

    most_per_second: float = constant(
        20.0, "a motion seems to flow from about 16 pictures a second on"
    )
    share: float = constant(
        0.5, "of its time that the page draws: the rest of that processor is the run's"
    )
    history: int = constant(600, "frames in plots: about as many as a plot has pixels across")
    trail: int = constant(200, "frames of a trail: longer ones hide the scene they are in")
    patience_s: float = constant(
        30.0, "that a run on files waits for a browser: time to copy the address"
    )
    parting_s: float = constant(
        30.0,
        "that the page outlives the run while somebody looks: a slow browser has drawn the last "
        "frame by then, and one that is forgotten does not keep a script for ever",
    )


PACE = Pace()


@dataclass(frozen=True)
class Row:
    """One frame in plots and trails: all that is kept of frames that are not shown."""

    frame: int
    statuses: tuple[Status, ...]  # of the bodies, in the session's order
    places: tuple[Floats | None, ...]  # likewise their origins (3,) in the world
    # the largest `rms` of a sensor over the bodies, by its name; none where nothing was met
    residuals: Mapping[str, float]


@dataclass(frozen=True)
class Shown:
    """A sensor's frame as the page has it."""

    frame: RawFrame | None  # None where the sensor has none
    zoom: float = 1.0  # by which its image was shrunk
    found: Floats | None = None  # features (M, 2), in pixels of the sensor


@dataclass(frozen=True)
class Moment:
    """A frame that is shown, with what has been since the one before."""

    estimates: tuple[Estimate, ...]  # of all bodies
    sensors: Mapping[str, Shown]
    # of frames since the last moment and of this one, the newest `Pace.history`
    rows: tuple[Row, ...]
    counts: Mapping[Status, int] = field(default_factory=dict)  # poses so far
    per_second: float = float("nan")  # frames estimated in a second, lately


Wish: TypeAlias = Literal["next", "pause", "go on", "step"] | int
"""What the page asks of the run: another moment, what was clicked; or its number of browsers."""


def row_of(estimates: tuple[Estimate, ...]) -> Row:
    """What plots and trails keep of a frame."""
    residuals: dict[str, float] = {}
    for estimate in estimates:
        for name, report in estimate.sensors.items():
            if report.rms is not None and np.isfinite(report.rms):
                residuals[name] = max(report.rms, residuals.get(name, 0.0))
    return Row(
        estimates[0].frame,
        tuple(one.status for one in estimates),
        tuple(
            None if one.T_world_object is None else one.T_world_object[:3, 3] for one in estimates
        ),
        residuals,
    )
