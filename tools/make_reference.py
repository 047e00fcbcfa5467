"""Write docs/session.md, docs/commands.md and docs/constants.md from the code.

    python tools/make_reference.py [--check]

With --check nothing is written; the exit status is 1 where a file is not up to date.
"""

from __future__ import annotations

import ast
import dataclasses
import importlib
import inspect
import pkgutil
import re
import sys
import textwrap
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any, Literal, get_args, get_origin, get_type_hints

import typer
from pydantic.fields import FieldInfo

import mixpose
from mixpose.cli.app import app
from mixpose.extraction import ExtractOptions
from mixpose.session.schema import (
    EstimatorTable,
    GravityTable,
    ObjectTable,
    SessionTable,
    StartTable,
)
from mixpose.session.schema_sensors import (
    CalibrationErrorTable,
    CalibrationTable,
    CameraTable,
    CloudTable,
    ExtractTable,
    LaterationTable,
    ParallelTable,
    PlacedTable,
    Placement,
    SensorTable,
    Table,
)
from mixpose.session.validation import allowed_for

DOCS = Path(__file__).resolve().parents[1] / "docs"
MADE_BY = "<!-- Made by tools/make_reference.py from the code: change it there. -->"

# heading, table, and where keys that it inherits are described
SECTIONS: list[tuple[str, type[Table], tuple[type[Table], ...]]] = [
    ("The top of the file", SessionTable, ()),
    ("`[object]`", ObjectTable, ()),
    ("`[object.gravity]`", GravityTable, ()),
    ("`[start]`", StartTable, ()),
    ("`[estimator]`", EstimatorTable, ()),
    ("`[extract]` and `[sensor.extract]`", ExtractTable, ()),
    ("`[[sensor]]`", SensorTable, ()),
    ("`[[sensor]]`: where a camera stands", PlacedTable, (SensorTable,)),
    ('`[[sensor]]` with `model = "pinhole"` or `"fisheye"`', CameraTable, (PlacedTable,)),
    ("`calibration = { ... }`", CalibrationTable, ()),
    ("`calibration_error = { ... }`", CalibrationErrorTable, ()),
    ('`[[sensor]]` with `model = "parallel"`', ParallelTable, (PlacedTable,)),
    ('`[[sensor]]` with `model = "lateration"`', LaterationTable, (SensorTable,)),
    ('`[[sensor]]` with `model = "cloud"`', CloudTable, (SensorTable,)),
]

SESSION_HEAD = f"""\
# The session file

{MADE_BY}

One TOML file holds a whole set-up: the body, the sensors and where their recordings are. Paths in
it are relative to it, every length is in its `unit`. An unknown key is an error that names the
nearest known one, or the table where it belongs. `mixpose check SESSION.toml` reads the file and
every frame of the recordings, and says what looks wrong.

TOML gives every key to the last `[table]` above it: what stands at the top of the file must come
before the first table, and the keys of `[sensor.extract]` go to the last `[[sensor]]` above it.
A smallest file:

```toml
unit = "mm"

[object]
name = "tracker"
points = [
    [0, -25, -43.3], [100, -25, -43.3], [0, 61.6, -93.3],
    [100, 111.6, -6.7], [-48, 20, 12], [35, -60, 30],
]

[[sensor]]
name = "camera"
model = "pinhole"
source = "frames/*.png"
camera_matrix = [[812.4, 0, 322.7], [0, 811.9, 251.3], [0, 0, 1]]
```
"""

COMMANDS_HEAD = f"""\
# The command line

{MADE_BY}

Every command also takes `--debug`, which shows the traceback of an error; `run` then also names
the proposer (`docs/method.md`) of each pose that was not predicted. The exit status is 0
(done; a lost frame is a result), 2 (the session file or the options are wrong), 3 (the recording
cannot be read; poses already estimated stay written) or 130 (interrupted, everything so far
written). An error is one line on standard error.

A file that is text may be `-`, standard output; what is printed beside it then goes to standard
error. Folders, pictures, `.c3d` and `.rrd` need a name.
"""

CONSTANTS_HEAD = f"""\
# Constants

{MADE_BY}

Numbers that are believed rather than measured or derived on the spot, with their reasons.  They are
fields of frozen dataclasses; `mixpose.tracking.Rules` holds those that a `Tracker` goes by, and
`Tracker.create(..., rules=...)` takes others.  They are no options of a session.  Rows like 8/4/8
are those of `python tools/benchmark.py search`: features, hidden, false.
"""


def session_reference() -> str:
    """The text of docs/session.md."""
    parts = [SESSION_HEAD]
    for heading, table, described in SECTIONS:
        skip = set().union(*(each.model_fields for each in described))
        parts.append(f"## {heading}\n\n{_prose(inspect.getdoc(table) or '')}\n")
        meanings = key_docstrings(table)
        for key in _in_order(table):
            if key not in skip:
                parts.append(_entry(table, key, table.model_fields[key], meanings[key]))
    return "\n".join(parts)


def key_docstrings(table: type[Table]) -> dict[str, str]:
    """What stands below each key of a table and of those it is made from."""
    found: dict[str, str] = {}
    for base in table.__mro__:
        if not (inspect.isclass(base) and issubclass(base, Table)):
            continue
        (definition,) = ast.parse(textwrap.dedent(inspect.getsource(base))).body
        assert isinstance(definition, ast.ClassDef)
        for key, text in zip(definition.body, definition.body[1:]):
            if (
                isinstance(key, ast.AnnAssign)
                and isinstance(key.target, ast.Name)
                and isinstance(text, ast.Expr)
                and isinstance(text.value, ast.Constant)
            ):
                found.setdefault(key.target.id, inspect.cleandoc(str(text.value.value)))
    return found


def split_example(text: str) -> tuple[str, str | None]:
    """A docstring's meaning and its example, a line of TOML."""
    meaning, _, example = text.partition("\nExample: ")
    return meaning, example.strip("`") or None


def _in_order(table: type[Table]) -> list[str]:
    """Keys of a table: its own first, then those that place it."""
    own = [key for key in table.model_fields if key not in Placement.model_fields]
    placing = [key for key in table.model_fields if key in Placement.model_fields]
    after = {"T_world_object", "T_sensor_world"} & set(own)
    for key in after:
        at = own.index(key) + 1
        return own[:at] + placing + own[at:]
    return own + placing


def _entry(table: type[Table], key: str, field: FieldInfo, text: str) -> str:
    meaning, example = split_example(text)
    lines = [f"### `{key}`", "", _prose(meaning), ""]
    allowed = allowed_for(field)
    if allowed:
        lines.append(f"- allowed: {_code(allowed)}")
    lines.append(f"- default: {_default(table, key, field)}")
    if example:
        lines.append(f"- example: `{example}`")
    return "\n".join([*lines, ""])


def _default(table: type[Table], key: str, field: FieldInfo) -> str:
    if field.is_required():
        return "none, the key is needed"
    default: Any = field.default
    if table is ExtractTable:
        default = getattr(ExtractOptions(), key)
    if default is None or default == () or isinstance(default, Table):
        return "left out"
    if isinstance(default, bool):
        return f"`{str(default).lower()}`"
    if isinstance(default, str):
        return f'`"{default}"`'
    if isinstance(default, tuple):
        return "`[" + ", ".join(f'"{each}"' for each in default) + "]`"
    return f"`{default:g}`"


def _prose(text: str) -> str:
    """A docstring's paragraph, wrapped for the page."""
    joined = " ".join(text.replace("``", "`").split())
    return textwrap.fill(joined, 100, break_long_words=False, break_on_hyphens=False)


def _code(text: str) -> str:
    """Words and brackets as code, lest Markdown reads them as its own."""
    return re.sub(r'("[^"]*"|(?<!\S)\[+[^\]]*\]+(?:, \[[^\]]*\]+)*)', r"`\1`", text)


def command_reference() -> str:
    """The text of docs/commands.md."""
    parts = [COMMANDS_HEAD]
    for command in app.registered_commands:
        function = command.callback
        assert function is not None
        hints = get_type_hints(function, include_extras=True)
        usage, entries, options = [f"mixpose {command.name or function.__name__}"], [], []
        for name, parameter in inspect.signature(function).parameters.items():
            if hints[name] is typer.Context:
                continue
            kind, info = get_args(hints[name])
            if isinstance(info, typer.models.ArgumentInfo):
                needed = parameter.default is inspect.Parameter.empty
                usage.append(f"{info.metavar}" if needed else f"[{info.metavar}]")
                entries.append(f"- `{info.metavar}`: {info.help}" + " Optional." * (not needed))
            else:
                options.append(_option(name, kind, info, parameter.default))
        text = _prose(inspect.getdoc(function) or "")
        usage += ["[OPTIONS]"] * bool(options)
        parts.append(f"## `{' '.join(usage)}`\n\n{text}\n")
        if entries or options:
            parts.append("\n".join(entries + options) + "\n")
    return "\n".join(parts)


def _option(name: str, kind: Any, info: Any, default: Any) -> str:
    # typer takes the first word of an annotation for a default, until it builds the command
    first = (info.default,) if isinstance(info.default, str) else ()
    words = (*first, *info.param_decls) or (f"--{name.replace('_', '-')}",)
    value = info.metavar or _word_for(kind)
    described = f"- `{', '.join(words)}{f' {value}' if value else ''}`: {info.help}"
    least = f", at least {info.min}" if info.min is not None else ""
    if default is inspect.Parameter.empty:
        described += f" Needed{least}."
    elif default is not None and default is not False:
        described += f" Default: {default}{least}."
    return textwrap.fill(described, 100, subsequent_indent="  ", break_on_hyphens=False)


def _word_for(kind: Any) -> str:
    """What stands for a value of a type in a usage line."""
    for each in (kind, *get_args(kind)):
        if get_origin(each) is Literal:
            return "|".join(get_args(each))
    words = {Path: "PATH", int: "N", float: "NUMBER", str: "TEXT"}
    return next((words[each] for each in (kind, *get_args(kind)) if each in words), "")


def constants_reference() -> str:
    """The text of docs/constants.md."""
    parts = [CONSTANTS_HEAD]
    for module, tables in tables_of_constants().items():
        parts.append(f"## `{module}`\n")
        for table in tables:
            parts.append(f"### `{table.__name__}`\n\n{_prose(_first_line(table))}\n")
            rows = ["| field | default | why |", "| --- | --- | --- |"]
            rows += [
                f"| `{field.name}` | {_number(field.default)} | {_cell(field.metadata['why'])} |"
                for field in dataclasses.fields(table)
                if "why" in field.metadata
            ]
            parts.append("\n".join(rows) + "\n")
    return "\n".join(parts)


def tables_of_constants() -> dict[str, list[type]]:
    """Dataclasses with a `mixpose.constants.constant`, by the module that they stand in."""
    found: dict[str, list[type]] = {}
    for module in _modules():
        for table in vars(module).values():
            if not (inspect.isclass(table) and dataclasses.is_dataclass(table)):
                continue
            reasoned = any("why" in field.metadata for field in dataclasses.fields(table))
            if reasoned and table.__module__ == module.__name__:
                found.setdefault(module.__name__, []).append(table)
    return found


def _modules() -> Iterator[ModuleType]:
    """Modules of the package that hold constants, by name."""
    for info in sorted(pkgutil.walk_packages(mixpose.__path__, "mixpose."), key=lambda i: i.name):
        path = Path(*mixpose.__path__, *info.name.split(".")[1:]).with_suffix(".py")
        if path.exists() and "mixpose.constants" in path.read_text(encoding="utf-8"):
            yield importlib.import_module(info.name)


def _first_line(table: type) -> str:
    return (inspect.getdoc(table) or "").partition("\n")[0]


def _number(value: Any) -> str:
    """A default as it is written in code."""
    if isinstance(value, tuple):
        items = ", ".join(_number(each).strip("`") for each in value)
        return f"`({items}{',' * (len(value) == 1)})`"
    if dataclasses.is_dataclass(value):
        parts = [(field, getattr(value, field.name)) for field in dataclasses.fields(value)]
        changed = [(field.name, _number(at)) for field, at in parts if at != field.default]
        return ", ".join(f"`{name}` {at}" for name, at in changed)
    return f"`{value:.4g}`" if isinstance(value, float) else f"`{value}`"


def _cell(text: str) -> str:
    """Words for a cell of a table."""
    return text.replace("|", "\\|")


PAGES = {
    "session.md": session_reference,
    "commands.md": command_reference,
    "constants.md": constants_reference,
}


def main(arguments: list[str]) -> int:
    stale = []
    for name, make in PAGES.items():
        path, text = DOCS / name, make()
        if not path.exists() or path.read_text(encoding="utf-8") != text:
            stale.append(name)
            if "--check" not in arguments:
                path.write_text(text, encoding="utf-8", newline="\n")
    print(f"out of date: {', '.join(stale)}" if stale else "up to date")
    return int(bool(stale) and "--check" in arguments)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
