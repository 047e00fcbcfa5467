"""Messages about wrong values: one line with file, key, what was found and what is allowed."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from difflib import get_close_matches
from typing import Any

_LONGEST = 60  # characters of a found value that are shown
CLOSE = 0.55  # similarity from which a word counts as a misspelling of another

Key = tuple[str | int, ...]


class BadKeyError(ValueError):
    """The problem of one key; all readers of this package raise it before the file is known.

    A ValueError, which pydantic collects. `text` says what was found and what is allowed; `key` is
    the path to the value from where the problem was noticed, list items by number, from 0.
    """

    def __init__(self, text: str, *key: str | int) -> None:
        super().__init__(text)
        self.text = text
        self.key: Key = key


@contextmanager
def under(*key: str | int) -> Iterator[None]:
    """Prepend the key of a table to the key of every problem raised inside."""
    try:
        yield
    except BadKeyError as problem:
        raise BadKeyError(problem.text, *key, *problem.key) from problem


@contextmanager
def in_file(name: str) -> Iterator[None]:
    """Prepend the name of a file, other than the session file, to problems raised inside."""
    try:
        yield
    except BadKeyError as problem:
        where = f"{dotted(problem.key)}: " if problem.key else ""
        raise BadKeyError(f"{name}: {where}{problem.text}") from problem


def mismatch(value: object, allowed: str) -> str:
    """Return the text of a message: the value that was found and what is allowed."""
    return f"found {show(value)}; allowed: {allowed}"


def show(value: object) -> str:
    """Return a value as TOML on one line, shortened if it is long."""
    text = _toml(value)
    if len(text) > _LONGEST:
        size = f" ({len(value)} items)" if isinstance(value, list) else ""
        text = f"{text[: _LONGEST - 3]}...{size}"
    return text


def _toml(value: object) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False)
    if isinstance(value, list):
        return f"[{', '.join(map(_toml, value))}]"
    if isinstance(value, dict):
        return f"{{{', '.join(f'{k} = {_toml(v)}' for k, v in value.items())}}}"
    if isinstance(value, int) and abs(value) >= 10**_LONGEST:
        return "an integer of more digits than a number holds"
    return str(value)


def dotted(key: Key, named: Iterable[object] = ()) -> str:
    """Return a key as text, such as ``sensor["left"].T_sensor_world[2]``.

    `named` are the names of the sensors or bodies that the key counts; a name replaces the number
    if it is a text and unique.
    """
    names = list(named)
    text = ""
    for i, part in enumerate(key):
        name = names[part] if i == 1 and isinstance(part, int) and part < len(names) else None
        if isinstance(part, str):
            text += f".{part}" if text else part
        elif isinstance(name, str) and name and names.count(name) == 1:
            text += f"[{json.dumps(name, ensure_ascii=False)}]"
        else:
            text += f"[{part}]"
    return text


def nearest(word: str, known: Iterable[str], *, cutoff: float = CLOSE) -> str | None:
    """Return the known word that `word` most likely misspells, whatever its case; None if none."""
    by_lower = {k.lower(): k for k in known}
    matches = get_close_matches(word.lower(), by_lower, n=1, cutoff=cutoff)
    return by_lower[matches[0]] if matches else None


def one_of(words: Iterable[str]) -> str:
    """Return words in quotes, separated by commas."""
    return ", ".join(f'"{word}"' for word in words)


def did_you_mean(value: object, words: Iterable[str]) -> str:
    """Return a hint at the nearest of the allowed words; empty if none is near."""
    close = nearest(value, words) if isinstance(value, str) else None
    return f'; did you mean "{close}"?' if close else ""


def one_line(file: object, key: Key, text: str, session: Any = None) -> str:
    """Return the whole message about a key of a file, with names from the parsed `session`."""
    first = key[0] if key else None
    entry = session.get(first) if isinstance(session, dict) else None
    if first == "object" and not isinstance(entry, list):
        key = (first, *key[2:])  # a single body has no number
    tables = entry if isinstance(entry, list) and first in ("sensor", "object") else []
    names = [table.get("name") if isinstance(table, dict) else None for table in tables]
    where = f"{dotted(key, names)}: " if key else ""
    return " ".join(f"{file}: {where}{text}".split())
