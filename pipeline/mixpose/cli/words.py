"""Arguments and options that several commands share, and commands that take a record of them."""

from __future__ import annotations

from collections.abc import Callable
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
        "--allow-code",
        help='Run functions that the session names: method = "module:function".',
    ),
]
Step = Annotated[int, typer.Option(min=1, help="Take every N-th frame number.")]
Start = Annotated[int | None, typer.Option(help="First frame number.")]
Stop = Annotated[int | None, typer.Option(help="Frame number to stop before.")]


def taking(request: type[Request]) -> Callable[[Callable[[Request], None]], Callable[..., None]]:
    """Make a command of a function of a record, whose fields are its arguments and options."""

    def decorated(command: Callable[[Request], None]) -> Callable[..., None]:
        hints = get_type_hints(request, include_extras=True)
        form = signature(request)
        typed = [one.replace(annotation=hints[name]) for name, one in form.parameters.items()]

        def called(**given: Any) -> None:
            command(request(**given))

        called.__name__, called.__doc__ = command.__name__, command.__doc__
        called.__annotations__ = hints
        called.__signature__ = form.replace(parameters=typed)  # type: ignore[attr-defined]
        return called

    return decorated
