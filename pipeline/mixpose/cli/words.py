"""Arguments and options that several commands share, and commands that take a record of them."""

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
    """A field of a record that is an option of a command, needed where the default is `...`.

    Without a name it is called like the field. `panel` heads a group of options in the help, and
    typer takes `more`.
    """
    settings = {"help": meaning, "rich_help_panel": panel, **more}
    metadata = {"name": name, "settings": settings}
    return field(metadata=metadata) if default is ... else field(default=default, metadata=metadata)


def option_name(one: Field[Any]) -> str:
    """What is typed for a field; of a bool, too, for which typer adds one with "no-" otherwise."""
    return one.metadata.get("name") or f"--{one.name.replace('_', '-')}"


def taking(request: type, work: str) -> Callable[..., None]:
    """A command whose arguments and options are the fields of a record, and its docstring the help.

    The record goes to that ``module:function`` of this room, imported when called. All raise
    SessionError if the session or an option is wrong, or an output would overwrite something else,
    and RecordingError if a recording or poses cannot be read. A field `debug` is whether all that
    is known of errors is wanted, which may be asked of any command.
    """
    hints: dict[str, Any] = get_type_hints(request, include_extras=True)
    for one in fields(request):
        if one.metadata:
            names = ("-o", "--output") if one.name == "output" else (option_name(one),)
            hints[one.name] = Annotated[
                hints[one.name], typer.Option(*names, **one.metadata["settings"])
            ]
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
