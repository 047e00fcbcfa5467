"""What `--help` prints: commands in groups, values by what they are, and examples."""

from __future__ import annotations

from typing import Any

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
EXAMPLES = {
    name: [call for call in _CALLS if call.split()[1] == name]
    for names in GROUPS.values()
    for name in names
}
"""Two calls of each command."""

DEBUG = "Show the traceback of an error; of run, also where each pose came from that was searched."
"""What `--debug` does, which is no parameter of a single command."""

VALUES = {"path": "FILE", "int": "NUMBER", "float": "NUMBER", "str": "TEXT"}
"""What a value is called, by the word that begins its type's name."""


class Command(TyperCommand):
    """A command whose help ends on examples, and does not speak of Python's types."""

    def get_params(self, ctx: Any) -> list[Any]:
        """Parameters, each value with a name for what it is."""
        found: list[Any] = super().get_params(ctx)
        for one in found:
            kind = one.display_type(ctx).strip("<>").split(" ")[0]
            if one.param_type_name == "argument":  # whose name says what it is
                one.display_type_rich = lambda ctx: None
            elif one.metavar is None and not one.is_flag and kind in VALUES:
                one.metavar = VALUES[kind]
        return found

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Write arguments, options, by groups where they are many, and examples."""
        sections = dict[str, list[Any]]()
        for one in self.get_params(ctx):
            kind = "Arguments" if one.param_type_name == "argument" else "Options"
            if (record := one.get_help_record(ctx)) is not None:
                title = getattr(one, "rich_help_panel", None) or kind
                sections.setdefault(title, []).append(record)
        sections.setdefault("Options", []).append(("--debug", DEBUG))
        for title, records in sections.items():
            with formatter.section(title):
                formatter.write_dl(records)
        with formatter.section("Examples"):
            for line in EXAMPLES.get(self.name or "", ()):
                formatter.write(f"{'':>{formatter.current_indent}}{line}\n")


class Commands(TyperGroup):
    """All commands, in groups, each with its whole sentence."""

    def invoke(self, ctx: Any) -> Any:
        """Run a command; an EOFError is no interrupt, which typer takes it for."""
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
