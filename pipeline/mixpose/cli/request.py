"""What is asked of ``mixpose run``.

Apart from the run itself, so that a command which only starts others need not load what they do.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from mixpose.errors import SessionError
from mixpose.selection import Selection

SUFFIXES = {
    ".jsonl": "jsonl",
    ".bop.csv": "bop",
    ".csv": "csv",
    ".tum": "tum",
    ".yaml": "ros",
    ".yml": "ros",
}
"""Formats of poses by how the name of a file ends."""

FARTHEST_S = 0.5
"""What poses are foretold at most: a hand has turned round by then."""


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
    allow_code: bool = False
    scheduler: str | None = None
    labels: bool = False
    publish: tuple[str, ...] = ()
    predict: float | None = None
    view: str | None = None
    pause: bool = False

    @property
    def options(self) -> dict[str, int | bool]:
        """What is not the default of the options that all lines of a file have to share."""
        step, labels = self.selection.step, self.labels
        return {**({"step": step} if step != 1 else {}), **({"labels": True} if labels else {})}

    @property
    def ahead_s(self) -> float:
        """How far poses that are published are foretold.

        Raises SessionError if nothing is published, or the time is not one that can be looked
        ahead.
        """
        seconds = self.predict
        if seconds is None:
            return 0.0
        if not self.publish:
            raise SessionError(
                "--predict: found no --publish; poses are foretold for receivers, the file has "
                "those of its frames"
            )
        if not 0 < seconds <= FARTHEST_S:
            raise SessionError(
                f"--predict: found {seconds:g}; allowed: seconds above 0, up to {FARTHEST_S:g}"
            )
        return seconds


def output_of(named: Path | None) -> Path | None:
    """Where an option says that something goes; None, standard output, also where it says ``-``."""
    return None if named == Path("-") else named


def by_suffix(output: Path | None, suffixes: Mapping[str, str]) -> str | None:
    """The format that the name of a file tells by its end; None where it tells none."""
    name = "" if output is None else output.name.casefold()
    return next((each for end, each in suffixes.items() if name.endswith(end)), None)


def format_of(output: Path | None, named: str | None) -> str:
    """The format of poses: the one that is named, else that of the file's suffix.

    Without either, poses are JSON lines: to standard output, a pipe, or a name without a suffix.
    Raises SessionError if the suffix is that of no format, or of one that is not written while
    poses are estimated.
    """
    if named is not None:
        return named
    if output is None or not output.suffix or (output.exists() and not output.is_file()):
        return "jsonl"
    if output.name.casefold().endswith(".rrd"):
        raise SessionError(
            f"-o {output}: poses are not written in this format while they are estimated; write "
            f".jsonl, and then: mixpose convert POSES.jsonl -o {output}"
        )
    told = by_suffix(output, SUFFIXES)
    if told is None:
        raise SessionError(
            f"-o {output}: found the suffix {output.suffix}, which is no format of poses; allowed: "
            f"{', '.join(SUFFIXES)}; or name one with --format"
        )
    return told
