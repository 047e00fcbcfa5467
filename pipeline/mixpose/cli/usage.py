"""What was typed: options whose value may be left out, and what is wrong, in one line.

The line is worded as every other error of mixpose.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Sequence

import typer

# what typer says, and how mixpose says it; the rest of a message stays as it is
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
OPTIONAL = {"--view": _ADDRESS}
"""What a value of each looks like; anything else after it is the next argument."""


def usage_message(error: typer.TyperException, arguments: Sequence[str]) -> str:
    """One line: which option, what was found of what was typed, what is allowed, what to read."""
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
    found = _typed(names, arguments) if is_option else None
    return f"{name}: " + (f"found {found}; " if found is not None else "") + message


def _typed(names: Sequence[str], arguments: Sequence[str]) -> str | None:
    """The value of an option as it was typed, the last if there are several."""
    for i in reversed(range(len(arguments))):
        option, equals, value = arguments[i].partition("=")
        if option in names:
            return value if equals else next(iter(arguments[i + 1 : i + 2]), None)
    return None


def with_values(arguments: Sequence[str]) -> list[str]:
    """Arguments in which each of these options has a value, an empty one where none was given."""
    given: list[str] = []
    for k, argument in enumerate(arguments):
        pattern = OPTIONAL.get(argument)
        following = arguments[k + 1] if k + 1 < len(arguments) else ""
        has_value = pattern is None or pattern.fullmatch(following) is not None
        given.append(argument if has_value else f"{argument}=")
    return given
