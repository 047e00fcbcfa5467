"""Arguments and options that several commands share, and commands that take a record of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import field, fields
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


def option(default: Any, meaning: str, *names: str, panel: str | None = None, **more: Any) -> Any:
    """A field of a record that is an option of a command, needed where the default is `...`.

    Without names it is called like the field. `panel` heads a group of options in the help, and
    typer takes `more`.
    """
    settings = {"help": meaning, "rich_help_panel": panel, **more}
    metadata = {"names": names, "settings": settings}
    return field(metadata=metadata) if default is ... else field(default=default, metadata=metadata)


def taking(request: type, work: str) -> Callable[..., None]:
    """A command whose arguments and options are the fields of a record, and its docstring the help.

    The record goes to that ``module:function`` of this room, imported when called. A field `debug`
    is whether all that is known of errors is wanted, which may be asked of any command.
    """
    hints: dict[str, Any] = get_type_hints(request, include_extras=True)
    for one in fields(request):
        if one.metadata:
            kind, names = hints[one.name], one.metadata["names"]
            if kind is bool and not names:  # else typer adds one that begins with "no-"
                names = (f"--{one.name.replace('_', '-')}",)
            hints[one.name] = Annotated[kind, typer.Option(*names, **one.metadata["settings"])]
    form = signature(request)
    if "debug" in hints:
        hints["debug"] = typer.Context  # which has it
    typed = [one.replace(annotation=hints[name]) for name, one in form.parameters.items()]

    def called(**given: Any) -> None:
        module, _, name = work.partition(":")
        if "debug" in given:
            given["debug"] = bool(given["debug"].obj)
        getattr(import_module(f"mixpose.cli.{module}"), name)(request(**given))

    called.__doc__, called.__annotations__ = request.__doc__, hints
    called.__signature__ = form.replace(parameters=typed)  # type: ignore[attr-defined]
    return called
