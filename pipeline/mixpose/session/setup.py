"""A session: the checked, immutable contents of a session file."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from mixpose.body import Body
from mixpose.extraction.options import ExtractOptions
from mixpose.fit import EstimatorOptions
from mixpose.records import Floats, label_of
from mixpose.sensors import CalibrationError, Sensor
from mixpose.units import Unit, length_ratio


@dataclass(frozen=True)
class Start:
    """The pose of a body in the first frame, ``[start]``."""

    T_world_object: Floats  # (4, 4)
    rotation_deg: float | None = None  # half-width in degrees; None: not given
    distance: float | None = None  # half-width in length units; None: not given


@dataclass(frozen=True)
class ObjectSetup:
    """One ``[[object]]``."""

    body: Body
    start: Start | None = None  # of the first, if there are several identical bodies
    count: int = 1  # number of identical bodies

    @property
    def labels(self) -> tuple[str, ...]:
        """Names of the identical bodies, numbered if there are several."""
        return tuple(label_of(self.body.name, instance) for instance in self.instances)

    @property
    def instances(self) -> tuple[int | None, ...]:
        """Numbers of the identical bodies; None for a single body."""
        return tuple(range(self.count)) if self.count > 1 else (None,)


@dataclass(frozen=True)
class SensorSetup:
    """One ``[[sensor]]``: its geometry and where its frames come from."""

    name: str  # unique in the session
    model: str
    sensor: Sensor  # the calibrated geometry
    source: str | tuple[str, ...]  # as written, relative to `Session.folder`; empty: none
    times: Path | None  # table of frame times, relative paths resolved
    fps: float | None  # frames per second
    extract: ExtractOptions  # ``[extract]`` with what ``[sensor.extract]`` overrides
    range_min: float | None = None  # range of a profile's first bin, length units
    bin_size: float | None = None  # from bin to bin; None if and only if `range_min` is
    resolution: tuple[int, int] | None = None  # width and height of a camera's images in px
    delay: float | Literal["estimate"] = 0.0  # s by which frames are taken later than their times
    readout: float = 0.0  # s from a camera's first row to its last
    exposure: float = 0.0  # s for which a row collects light
    calibration_error: CalibrationError | None = None  # of the geometry; None: exact
    overridden: frozenset[str] = frozenset()  # keys that ``[sensor.extract]`` sets

    @property
    def sources(self) -> tuple[str, ...]:
        """The source as a tuple, even if it is a single text."""
        return (self.source,) if isinstance(self.source, str) else self.source

    def table_of(self, key: str) -> str:
        """Name the table of the session file from which a key of extraction takes its value."""
        return "its own [sensor.extract]" if key in self.overridden else "[extract]"


@dataclass(frozen=True)
class Session:
    """The whole set-up that a session file describes."""

    path: Path  # the session file, as the user named it
    sha256: str  # of the file's bytes, in hexadecimal
    unit: Unit  # of every length; nothing is converted on reading
    # the first body and its start; `count` is its number of identical copies
    body: Body
    start: Start | None
    estimator: EstimatorOptions
    sensors: tuple[SensorSetup, ...]
    allow_code: bool = False  # whether functions named in the file may be run
    count: int = 1
    other_objects: tuple[ObjectSetup, ...] = ()  # bodies after the first, in the order of the file

    @property
    def objects(self) -> tuple[ObjectSetup, ...]:
        """All bodies, in the order of the file."""
        return (ObjectSetup(self.body, self.start, self.count), *self.other_objects)

    @property
    def bodies(self) -> dict[str, Body]:
        """All bodies by label, identical ones numbered, in the order of their pose lines."""
        return {label: setup.body for setup in self.objects for label in setup.labels}

    @property
    def labels(self) -> tuple[str, ...]:
        """Labels of all bodies, in the order of their pose lines."""
        return tuple(self.bodies)

    def with_only(self, name: str) -> Session:
        """Return the session with a single one of its bodies, by name."""
        chosen = next(setup for setup in self.objects if setup.body.name == name)
        return replace(self, body=chosen.body, start=chosen.start, count=1, other_objects=())

    @property
    def folder(self) -> Path:
        """The folder that paths in the file are relative to."""
        return self.path.parent

    @property
    def metres_per_unit(self) -> float:
        """Length of the session's unit in metres."""
        return length_ratio(self.unit, "m")
