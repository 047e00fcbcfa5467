"""Parsing TOML, with a hint where a common slip is what it fails at."""

from __future__ import annotations

import re
import tomllib
from typing import Any

from mixpose.session.messages import BadKeyError

_LINE = re.compile(r"\(at line (\d+), column \d+\)")
_TABLE = re.compile(r"\[\[?\s*(sensor|object)\s*\]")
_BARE_WORD = re.compile(r"\s*([\w.-]+)\s*=\s*([^\W\d][^\s\"'\[\]{},#]*)\s*(?:#.*)?")
_COMMA = re.compile(r"\s*([\w.-]+)\s*=\s*([-+]?\d+),(\d+)\s*(?:#.*)?")
_COLON = re.compile(r"\s*([\w.-]+)\s*:\s*(.+)")
_OTHER_QUOTES = re.compile("[“”„‘’«»]")


def parse_toml(text: str) -> dict[str, Any]:
    """Parse TOML. Raises BadKeyError in one line, with what is most likely meant."""
    try:
        return tomllib.loads(text)
    except ValueError as error:  # of TOML, or a number of thousands of digits
        raise BadKeyError(f"not TOML: {error}{_hint(text, str(error))}") from error


def _hint(text: str, reason: str) -> str:
    """What is most likely meant; empty where nothing is."""
    at = _LINE.search(reason)
    lines = text.splitlines()
    line = lines[int(at[1]) - 1] if at is not None and 0 < int(at[1]) <= len(lines) else ""
    table = _TABLE.match(line.strip())
    if table is not None and ("twice" in reason or "overwrite" in reason):
        return f"; allowed for each of several: [[{table[1]}]] in two brackets, the first too"
    if _OTHER_QUOTES.search(line):
        return '; allowed: straight quotes, "..."'
    if "\\" in line and "in a string" in reason:
        return "; allowed: paths with / , or in single quotes, '...'"
    return _meant(line)


def _meant(line: str) -> str:
    """A line as it would be TOML."""
    word = _BARE_WORD.fullmatch(line)
    if word is not None and word[2] not in ("true", "false"):
        return f'; allowed: text in quotes, {word[1]} = "{word[2]}"'
    comma = _COMMA.fullmatch(line)
    if comma is not None:
        return f"; allowed: a decimal point, {comma[1]} = {comma[2]}.{comma[3]}"
    colon = _COLON.fullmatch(line)
    if colon is not None:
        return f"; allowed: an equals sign, {colon[1]} = {colon[2].strip()}"
    return ""
