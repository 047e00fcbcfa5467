"""What a session file says, checked and frozen."""

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
    """Where the object is at first, ``[start]``."""

    T_world_object: Floats  # (4, 4)
    rotation_deg: float | None = None  # half-width in degrees; None where not given
    distance: float | None = None  # half-width in length units; None where the file gives none


@dataclass(frozen=True)
class ObjectSetup:
    """One ``[[object]]``."""

    body: Body
    start: Start | None = None  # of identical ones, where the first is
    count: int = 1  # how many identical ones there are

    @property
    def labels(self) -> tuple[str, ...]:
        """What each of them is called where one word has to do."""
        return tuple(label_of(self.body.name, instance) for instance in self.instances)

    @property
    def instances(self) -> tuple[int | None, ...]:
        """The numbers of identical ones; None where there is one only."""
        return tuple(range(self.count)) if self.count > 1 else (None,)


@dataclass(frozen=True)
class SensorSetup:
    """One ``[[sensor]]``: its geometry and where its frames come from."""

    name: str  # unique in the session
    model: str
    sensor: Sensor  # the calibrated geometry
    source: str | tuple[str, ...]  # as written, relative to `Session.folder`; empty: none is named
    times: Path | None  # table of frame times, relative paths resolved
    fps: float | None  # frames per second
    extract: ExtractOptions  # ``[extract]`` with what ``[sensor.extract]`` overrides
    range_min: float | None = None  # range of a profile's first bin, length units
    bin_size: float | None = None  # from bin to bin; both or neither
    resolution: tuple[int, int] | None = None  # width and height of a camera's images in px
    delay: float | Literal["estimate"] = 0.0  # s by which frames are later than their times
    readout: float = 0.0  # s from a camera's first row to its last
    exposure: float = 0.0  # s for which a row collects light
    calibration_error: CalibrationError | None = None  # of the geometry; None: exact
    own: frozenset[str] = frozenset()  # keys that ``[sensor.extract]`` sets, whatever ``[extract]``

    @property
    def sources(self) -> tuple[str, ...]:
        """Its source as a list, as the file may have it."""
        return (self.source,) if isinstance(self.source, str) else self.source

    def table_of(self, key: str) -> str:
        """The table of the session file in which a key of extraction takes effect, in words."""
        return "its own [sensor.extract]" if key in self.own else "[extract]"


@dataclass(frozen=True)
class Session:
    """A whole set-up, as read from one session file."""

    path: Path  # the session file, as it was named
    sha256: str  # of the file's bytes, in hexadecimal
    unit: Unit  # of every length; nothing is converted on reading
    # the first body, where it is at first, and below how many there are of it
    body: Body
    start: Start | None
    estimator: EstimatorOptions
    sensors: tuple[SensorSetup, ...]
    allow_code: bool = False  # whether functions that the file names may be run
    count: int = 1
    others: tuple[ObjectSetup, ...] = ()  # bodies after the first, in the order of the file

    @property
    def objects(self) -> tuple[ObjectSetup, ...]:
        """All bodies, in the order of the file."""
        return (ObjectSetup(self.body, self.start, self.count), *self.others)

    @property
    def labels(self) -> tuple[str, ...]:
        """Names of all bodies, identical ones numbered, in the order of their pose lines."""
        return tuple(label for one in self.objects for label in one.labels)

    def alone(self, name: str) -> Session:
        """The session of one of its bodies, by name, as if there were no other."""
        one = next(each for each in self.objects if each.body.name == name)
        return replace(self, body=one.body, start=one.start, count=1, others=())

    @property
    def folder(self) -> Path:
        """The folder that paths in the file are relative to."""
        return self.path.parent

    @property
    def metres_per_unit(self) -> float:
        """Length of the session's unit in metres."""
        return length_ratio(self.unit, "m")
