"""Which frames of a recording are taken."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Selection:
    """Which frames of a recording are estimated, as by `range`: numbers, `stop` excluded."""

    start: int | None = None
    stop: int | None = None
    step: int = 1
