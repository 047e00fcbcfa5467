"""Arguments and options that several commands share, and commands that take a record of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import field, fields
from inspect import signature
from pathlib import Path
from typing import Annotated, Any, Literal, TypeAlias, TypeVar, get_type_hints

import typer

Request = TypeVar("Request")

Format: TypeAlias = Literal["jsonl", "csv", "tum", "bop", "ros"]
ConvertFormat: TypeAlias = Literal["jsonl", "csv", "tum", "bop", "ros", "rerun", "c3d", "trc"]
LengthUnit: TypeAlias = Literal["m", "cm", "mm", "um"]

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


def taking(request: type[Request]) -> Callable[[Callable[[Request], None]], Callable[..., None]]:
    """Make a command of a function of a record, whose fields are its arguments and options."""

    def decorated(command: Callable[[Request], None]) -> Callable[..., None]:
        hints: dict[str, Any] = get_type_hints(request, include_extras=True)
        for one in fields(request):  # type: ignore[arg-type]
            if one.metadata:
                kind, names = hints[one.name], one.metadata["names"]
                if kind is bool and not names:  # else typer adds one that begins with "no-"
                    names = (f"--{one.name.replace('_', '-')}",)
                option = typer.Option(*names, **one.metadata["settings"])
                hints[one.name] = Annotated[kind, option]
        form = signature(request)
        typed = [one.replace(annotation=hints[name]) for name, one in form.parameters.items()]

        def called(**given: Any) -> None:
            command(request(**given))

        called.__name__, called.__doc__ = command.__name__, command.__doc__
        called.__annotations__ = hints
        called.__signature__ = form.replace(parameters=typed)  # type: ignore[attr-defined]
        return called

    return decorated
