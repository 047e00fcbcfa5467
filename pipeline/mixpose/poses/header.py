"""Define the header of poses files."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from mixpose.records import Floats, label_of

FORMAT = "mixpose-poses"
VERSION = 1
COVARIANCE = "x y z rx ry rz, world axes, unit^2 and rad^2"


@dataclass(frozen=True)
class Header:
    """Facts that hold for all poses of a run."""

    unit: str  # "m", "cm", "mm" or "um": the unit of every length in the file
    session: str | None  # path of the session file; None without one
    session_sha256: str | None  # SHA-256 of the session file, in hexadecimal
    mixpose: str  # version of mixpose that made the poses
    seed: int
    # motions T_object_object that map the object's features onto themselves, identity included
    symmetries: Mapping[str, Floats] = field(default_factory=dict, compare=False)
    sources: Mapping[str, str] = field(default_factory=dict)  # in place of the session's, by sensor
    options: Mapping[str, int | bool] = field(default_factory=dict)  # further options of the run
    sensors: tuple[str, ...] = ()  # in the order of the session; for CSV columns only
    tips: bool = False  # whether any body has a tip; for CSV columns only
    objects: Mapping[str, int] = field(default_factory=dict)  # counts by name; empty: unknown
    smoothed: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)  # motion models by body

    @property
    def labels(self) -> tuple[str, ...]:
        """Labels of all bodies; identical ones are numbered."""
        return tuple(
            label_of(name, instance)
            for name, count in self.objects.items()
            for instance in (range(count) if count > 1 else (None,))
        )
