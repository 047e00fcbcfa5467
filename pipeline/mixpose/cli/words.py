"""Arguments and options of several commands, and commands made from records of their options."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import Field, field, fields
from importlib import import_module
from inspect import signature
from pathlib import Path
from typing import Annotated, Any, Literal, TypeAlias, get_type_hints

import typer

Format: TypeAlias = Literal["jsonl", "csv", "tum", "bop", "ros"]
ConvertFormat: TypeAlias = Literal["jsonl", "csv", "tum", "bop", "ros", "rerun", "c3d", "trc"]

SessionFile = Annotated[Path, typer.Argument(metavar="SESSION.toml", help="The session file.")]
PosesFile = Annotated[Path, typer.Argument(metavar="POSES.jsonl", help="Estimated poses.")]
Recordings = Annotated[
    list[str] | None,
    typer.Option(metavar="NAME=PATH", help="Recording of a sensor in place of the session's."),
]
AllowCode = Annotated[
    bool,
    typer.Option(
        "--allow-code", help='Run functions that the session names: method = "module:function".'
    ),
]


def option(
    meaning: str,
    default: Any = None,
    *,
    name: str | None = None,
    panel: str | None = None,
    **more: Any,
) -> Any:
    """Return a field that is an option, required if the default is `...`; `more` goes to typer."""
    settings = {"help": meaning, "rich_help_panel": panel, **more}
    metadata = {"name": name, "settings": settings}
    return field(metadata=metadata) if default is ... else field(default=default, metadata=metadata)


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
        if entry.metadata:
            names = ("-o", "--output") if entry.name == "output" else (option_name(entry),)
            hints[entry.name] = Annotated[
                hints[entry.name], typer.Option(*names, **entry.metadata["settings"])
            ]
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
