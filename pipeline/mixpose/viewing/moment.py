"""What passes from the run to the page, and back."""

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
    """One frame in plots and trails: all that is kept of frames that are not shown.

    Attributes
    ----------
    frame : int
    statuses : tuple of Status
        Of the bodies, in the session's order; likewise `places`.
    places : tuple of ((3,) float64 or None)
        Origins of the bodies in the world.
    residuals : mapping of str to float
        The largest `rms` of a sensor over the bodies, by its name; none where nothing was met.
    """

    frame: int
    statuses: tuple[Status, ...]
    places: tuple[Floats | None, ...]
    residuals: Mapping[str, float]


@dataclass(frozen=True)
class Shown:
    """A sensor's frame as the page has it.

    Attributes
    ----------
    frame : RawFrame or None
        None where the sensor has none.
    zoom : float
        By which its image was shrunk.
    found : (M, 2) float64 or None
        Features found, in pixels of the sensor.
    """

    frame: RawFrame | None
    zoom: float = 1.0
    found: Floats | None = None


@dataclass(frozen=True)
class Moment:
    """A frame that is shown, with what has been since the one before.

    Attributes
    ----------
    estimates : tuple of Estimate
        Of all bodies.
    sensors : mapping of str to Shown
    rows : tuple of Row
        Of frames since the last moment and of this one, the newest `Pace.history` of them.
    counts : mapping of Status to int
        Poses so far.
    per_second : float
        Frames estimated in a second, lately.
    """

    estimates: tuple[Estimate, ...]
    sensors: Mapping[str, Shown]
    rows: tuple[Row, ...]
    counts: Mapping[Status, int] = field(default_factory=dict)
    per_second: float = float("nan")


@dataclass(frozen=True)
class Done:
    """The recording is at its end."""


@dataclass(frozen=True)
class Viewers:
    """How many browsers have the page open."""

    count: int


Wish: TypeAlias = Literal["next", "pause", "go on", "step"]
"""What the page asks of the run: another moment, or what was clicked."""


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
