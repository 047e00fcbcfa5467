"""Requests of commands, made of arguments and options, and that of ``mixpose run``.

This module imports little, so that a command which only starts other processes loads fast.
"""

from __future__ import annotations

import glob
from collections.abc import Callable, Mapping
from dataclasses import Field, dataclass, field, fields
from functools import partial
from importlib import import_module
from inspect import signature
from pathlib import Path
from typing import Annotated, Any, Literal, TypeAlias, get_type_hints

import typer

from mixpose.errors import SessionError
from mixpose.selection import Selection

Format: TypeAlias = Literal["jsonl", "csv", "tum", "bop", "ros"]

SUFFIXES = {
    ".jsonl": "jsonl",
    ".bop.csv": "bop",
    ".csv": "csv",
    ".tum": "tum",
    ".yaml": "ros",
    ".yml": "ros",
}
"""Formats of poses by the endings of file names."""

FARTHEST_S = 0.5
"""Longest prediction of poses, s: by then a hand may have reversed its motion."""


def option(
    meaning: str,
    default: Any = None,
    *,
    name: str | None = None,
    panel: str | None = None,
    make: Callable[..., Any] = typer.Option,
    **more: Any,
) -> Any:
    """Return a field that is an option, required if the default is `...`; `more` goes to typer."""
    settings = {"help": meaning, "rich_help_panel": panel, **more}
    metadata = {"name": name, "make": make, "settings": settings}
    return field(metadata=metadata) if default is ... else field(default=default, metadata=metadata)


argument = partial(option, make=typer.Argument)
another_source = partial(
    option,
    "Another recording of a sensor, relative to the working folder, or the number of a camera; "
    "repeatable.",
    metavar="NAME=PATH",
)
any_code = partial(
    option, 'Run functions that the session names: method = "module:function".', False
)
"""Arguments, and options that several commands have."""


def option_name(entry: Field[Any]) -> str:
    """Return the option of a field; named even for a bool, or typer would add one with "no-"."""
    return entry.metadata.get("name") or f"--{entry.name.replace('_', '-')}"


def command_for(request: type, work: str) -> Callable[..., None]:
    """Make a command with the fields of a record as parameters and its docstring as help.

    The record is passed to the ``module:function`` `work` of this package, imported when called.
    All raise SessionError if the session or an option is wrong, or an output would overwrite
    something else, and RecordingError if a recording or poses cannot be read. A field `debug` takes
    the value of ``--debug``.
    """
    hints: dict[str, Any] = get_type_hints(request, include_extras=True)
    for entry in fields(request):
        if make := entry.metadata.get("make"):
            names: list[str] = []
            if make is typer.Option:
                names = ["-o", "--output"] if entry.name == "output" else [option_name(entry)]
            made = make(*names, **entry.metadata["settings"])
            hints[entry.name] = Annotated[hints[entry.name], made]
    form = signature(request)
    if "debug" in hints:
        hints["debug"] = typer.Context  # which has the value
    typed = [p.replace(annotation=hints[name]) for name, p in form.parameters.items()]

    def command(**values: Any) -> None:
        module, _, name = work.partition(":")
        if "debug" in values:
            values["debug"] = bool(values["debug"].obj)
        getattr(import_module(f"mixpose.cli.{module}"), name)(request(**values))

    command.__doc__, command.__annotations__ = request.__doc__, hints
    command.__signature__ = form.replace(parameters=typed)  # type: ignore[attr-defined]
    return command


@dataclass(frozen=True)
class RunRequest:
    """Estimate a pose per frame."""

    sessions: list[str] = argument(
        "One session file or several, patterns such as 'day*/session.toml', or text files (.txt) "
        "with one to a line.",
        ...,
        metavar="SESSION.toml...",
    )
    output: Path | None = option(
        "Write poses here, not to stdout (-), in the format that the suffix tells. With "
        "several sessions, a folder in which each gets its own for poses, log and status; what "
        "is done there already is not done again."
    )
    format: Format | None = option(
        "Else by the suffix: .jsonl .csv .tum .yaml (ros) .bop.csv; jsonl without."
    )
    source: list[str] | None = another_source()
    start: int | None = option("First frame number.")
    stop: int | None = option("Frame number to stop before.")
    step: int = option("Take every N-th frame number.", 1, min=1)
    resume: bool = option("Go on after the last frame in the output.", False)
    workers: int = option("How many sessions are run at a time.", 1, min=1)
    overlay: Path | None = option(
        "Draw each pose on its frames: a video (.mp4, .mkv, .avi) or a folder."
    )
    view: str | None = option(
        "Show the run on a page in the browser, at 127.0.0.1:8080 or this port; HOST:PORT "
        "opens it to others who have the address with its token.",
        metavar="[PORT]",
    )
    pause: bool = option("With --view, on files: begin paused, to go on from the page.", False)
    scheduler: str | None = option(
        "Run the sessions on a dask.distributed cluster: the address of its scheduler, or "
        "local for one on this machine.",
        metavar="ADDRESS",
    )
    labels: bool = option(
        "Say in each pose line which detection is which feature, and where features are in "
        "space by these alone; .jsonl only.",
        False,
    )
    publish: list[str] | None = option(
        "Send each pose to another program too: udp://host:port, tcp://host:port, "
        "ws://host:port, osc://host:port, lsl://name, mqtt://host/topic, ros2://topic; with "
        "'?only=ok' none but those that are ok; repeatable.",
        metavar="URL",
    )
    predict: float | None = option(
        "Publish where the body will be so much after each frame.", metavar="SECONDS"
    )
    allow_code: bool = any_code()
    debug: bool = False

    @property
    def poses(self) -> Path | None:
        """The file for poses; None for standard output."""
        return output_of(self.output)

    @property
    def format_name(self) -> str:
        """The format of poses: of --format, else of the file's suffix, else JSON lines."""
        return self.format or ("jsonl" if self.are_many else _format_by_suffix(self.poses))

    @property
    def are_many(self) -> bool:
        """Whether recordings get a folder each: several sessions, a pattern, list, or cluster."""
        first = self.sessions[0]
        is_pattern = glob.has_magic(first) and not Path(first).exists()
        is_list = len(self.sessions) > 1 or first.endswith(".txt")
        return self.scheduler is not None or is_list or is_pattern

    @property
    def selection(self) -> Selection:
        """The numbers of the frames to estimate."""
        return Selection(self.start, self.stop, self.step)

    @property
    def options(self) -> dict[str, int | bool]:
        """Options unlike their defaults that must be the same for all lines of a file."""
        step = {"step": self.step} if self.step != 1 else {}
        return step | ({"labels": True} if self.labels else {})

    @property
    def ahead_s(self) -> float:
        """How far ahead published poses are predicted; raises SessionError if they cannot be."""
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
    """Return the path that an option names; None, standard output, for ``-`` too."""
    return None if named == Path("-") else named


def by_suffix(output: Path | None, suffixes: Mapping[str, str]) -> str | None:
    """Return the format that belongs to the suffix of a file name; None if none does."""
    name = "" if output is None else output.name.casefold()
    return next((word for end, word in suffixes.items() if name.endswith(end)), None)


def _format_by_suffix(output: Path | None) -> str:
    if output is None or not output.suffix or (output.exists() and not output.is_file()):
        return "jsonl"
    if output.name.casefold().endswith(".rrd"):
        raise SessionError(
            f"-o {output}: poses are not written in this format while they are estimated; write "
            f".jsonl, and then: mixpose convert POSES.jsonl -o {output}"
        )
    format_name = by_suffix(output, SUFFIXES)
    if format_name is None:
        raise SessionError(
            f"-o {output}: found the suffix {output.suffix}, which is no format of poses; allowed: "
            f"{', '.join(SUFFIXES)}; or name one with --format"
        )
    return format_name
