"""What is asked of ``mixpose run``.

Apart from the run itself, so that a command which only starts others need not load what they do.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from mixpose.selection import Selection


@dataclass(frozen=True)
class RunRequest:
    """The options of ``mixpose run``."""

    output: Path | None
    format: str
    sources: tuple[str, ...]
    selection: Selection
    resume: bool
    overlay: Path | None = None
    debug: bool = False
