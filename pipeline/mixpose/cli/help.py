"""Change the messages of typer: the text of `--help`, and wrong usage in one line.

Help shows commands in groups, names of values by their meaning, and examples.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Sequence
from itertools import groupby, zip_longest
from typing import Any

import typer
from typer.core import TyperCommand, TyperGroup

from mixpose.cli import cut_message
from mixpose.errors import SessionError

GROUPS = {
    "Before poses": ("import", "calibrate", "learn", "check", "design"),
    "Poses": ("run", "inspect"),
    "After poses": ("evaluate", "report", "smooth", "pivot", "align", "convert"),
    "Beside poses": ("simulate", "schema"),
}
"""Commands in the order of the work; each is in one group."""

_CALLS = (
    "mixpose import camera.yml -o session.toml",
    "mixpose import left.yml right.yml body.rom -o session.toml",
    "mixpose calibrate session.toml -o calibrated.toml",
    "mixpose calibrate session.toml -o calibrated.toml --free left:focal --check",
    "mixpose learn session.toml -o body.csv",
    "mixpose learn session.toml -o body.csv --like older.csv",
    "mixpose check session.toml",
    "mixpose check session.toml --source left=other/",
    "mixpose design session.toml",
    "mixpose design one.toml other.toml --tip 0,0,-200 --plot rigs.png",
    "mixpose run session.toml -o poses.jsonl",
    "mixpose run session.toml -o poses.csv --overlay seen.mp4 --publish udp://localhost:5005",
    "mixpose inspect session.toml -o seen/",
    "mixpose inspect session.toml --frame 12 -o seen/",
    "mixpose evaluate poses.jsonl truth.jsonl",
    "mixpose evaluate poses.jsonl truth.jsonl --json",
    "mixpose report poses.jsonl -o report.html",
    "mixpose report poses.jsonl truth.jsonl -o report.html",
    "mixpose smooth poses.jsonl -o smooth.jsonl",
    "mixpose smooth poses.jsonl -o smooth.jsonl --fill 0.2",
    "mixpose pivot poses.jsonl",
    "mixpose pivot poses.jsonl --reference base --into session.toml",
    "mixpose align session.toml --floor plate@0 -o aligned.toml",
    "mixpose align session.toml --floor poses.jsonl -o aligned.toml --up z",
    "mixpose convert poses.jsonl -o poses.tum",
    "mixpose convert poses.jsonl -o markers.c3d --measured",
    "mixpose simulate session.toml -o try/ --frames 50",
    "mixpose simulate session.toml -o try/ --frames 50 --seed 3 --clutter 4",
    "mixpose schema",
    "mixpose schema > poses.schema.json",
)
EXAMPLES = {name: [*calls] for name, calls in groupby(_CALLS, lambda call: call.split()[1])}
"""Two calls of each command."""

DEBUG = "Show the traceback of an error; of run, also where each pose came from that was searched."
"""Help of `--debug`, which is no parameter of a single command."""

VALUES = {"path": "FILE", "int": "NUMBER", "float": "NUMBER", "str": "TEXT"}
"""Names of values in help by the first word of their types' names."""

# messages of typer and their replacements; other messages stay as they are
_WORDINGS = (
    (r"Input should be a valid (\w+).*", r"allowed: \1"),
    (r"Input should be (.*)", r"allowed: \1"),
    (r"Value error, '.*' is not one of (.*?)\.?", r"allowed: \1"),
    (
        r"Got unexpected extra arguments? ?\(s?\)? ?\((.*)\)",
        r"\1: found, but no argument is left for it",
    ),
    (r"Option '(.*)' requires an argument\.?", r"\1: found no value"),
    (r"Option '(.*)' does not take a value\.?", r"\1: found a value, but it takes none"),
    (r"No such command '(.*)'\. Did you mean (.*)\?", r"\1: no such command; did you mean \2?"),
    (r"No such command '(.*)'\.?", r"\1: no such command"),
)

_ADDRESS = re.compile(r"(.*:)?\d+")
"""A value of --view, which may be missing: another word is the next argument."""


class Command(TyperCommand):
    """A command whose help ends with examples and does not mention Python's types."""

    def get_params(self, ctx: Any) -> list[Any]:
        """Return the parameters; values have names by their meaning."""
        parameters: list[Any] = super().get_params(ctx)
        for parameter in parameters:
            kind = parameter.display_type(ctx).strip("<>").split(" ")[0]
            if parameter.param_type_name == "argument":  # whose name says enough
                parameter.display_type_rich = lambda ctx: None
            elif parameter.metavar is None and not parameter.is_flag and kind in VALUES:
                parameter.metavar = VALUES[kind]
        return parameters

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Write arguments, options in their groups, and examples."""
        sections = dict[str, list[Any]]()
        for parameter in self.get_params(ctx):
            kind = "Arguments" if parameter.param_type_name == "argument" else "Options"
            if (record := parameter.get_help_record(ctx)) is not None:
                title = getattr(parameter, "rich_help_panel", None) or kind
                sections.setdefault(title, []).append(record)
        sections.setdefault("Options", []).append(("--debug", DEBUG))
        for title, records in sections.items():
            with formatter.section(title):
                formatter.write_dl(records)
        with formatter.section("Examples"):
            for line in EXAMPLES.get(self.name or "", ()):
                formatter.write(f"{'':>{formatter.current_indent}}{line}\n")


class Commands(TyperGroup):
    """All commands, in groups, with their whole first sentences."""

    def invoke(self, ctx: Any) -> Any:
        """Run a command; turn an EOFError, which typer takes for an interrupt, into an error."""
        try:
            return super().invoke(ctx)
        except EOFError as error:
            raise SessionError(cut_message(error)) from error

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write commands by group."""
        for title, names in GROUPS.items():
            with formatter.section(title):
                rows = [(name, self.commands[name].get_short_help_str(1000)) for name in names]
                formatter.write_dl(rows)


def usage_message(error: typer.TyperException, arguments: Sequence[str]) -> str:
    """Return one line: which option, what was found, what is allowed, and which help to read."""
    typed = " ".join(["mixpose", *arguments[:1]]) if arguments[0][:1] != "-" else "mixpose"
    command = getattr(getattr(error, "ctx", None), "command_path", typed)
    text = _text(error, arguments).rstrip(". ")
    return f"{text}{' See' if text.endswith('?') else '; see'} {command} --help"


def _text(error: typer.TyperException, arguments: Sequence[str]) -> str:
    message = error.message
    for pattern, wording in _WORDINGS:
        if re.fullmatch(pattern, message):
            message = re.sub(f"^{pattern}$", wording, message)
            break
    option = getattr(error, "option_name", None)
    if option is not None and hasattr(error, "possibilities"):
        near = difflib.get_close_matches(option, error.possibilities or (), n=1, cutoff=0.5)
        return f"{option}: no such option" + (f"; did you mean {near[0]}?" if near else "")
    parameter = getattr(error, "param", None)
    if parameter is None:
        return message
    names = [*parameter.opts, *parameter.secondary_opts]
    is_option = parameter.param_type_name == "option"
    name = max(names, key=len) if is_option else (parameter.metavar or names[0]).removesuffix("...")
    if not message:
        return f"{name}: missing"
    typed = _typed(names, arguments) if is_option else None
    return f"{name}: " + (f"found {typed}; " if typed is not None else "") + message


def _typed(names: Sequence[str], arguments: Sequence[str]) -> str | None:
    for i in reversed(range(len(arguments))):
        option, equals, value = arguments[i].partition("=")
        if option in names:
            return value if equals else next(iter(arguments[i + 1 : i + 2]), None)
    return None


def with_values(arguments: Sequence[str]) -> list[str]:
    """Return arguments with an empty value after each --view without one."""
    return [
        f"{word}=" if word == "--view" and not _ADDRESS.fullmatch(following) else word
        for word, following in zip_longest(arguments, arguments[1:], fillvalue="")
    ]
