"""The choice of frames of a recording."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Selection:
    """Numbers of the frames to estimate, as in `range`: `stop` is excluded."""

    start: int | None = None
    stop: int | None = None
    step: int = 1
