"""From a wrong value to one line: which file, which key, what was found, what is allowed."""

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
    """What is wrong with one key: all that readers raise here, before the file's name is known.

    A ValueError, which pydantic collects. `text` says what was found and what is allowed; `key`
    leads to the value from where the problem was noticed, list items by number, from 0.
    """

    def __init__(self, text: str, *key: str | int) -> None:
        super().__init__(text)
        self.text = text
        self.key: Key = key


@contextmanager
def under(*key: str | int) -> Iterator[None]:
    """Put a table's own key before the key of every problem noticed inside."""
    try:
        yield
    except BadKeyError as problem:
        raise BadKeyError(problem.text, *key, *problem.key) from problem


@contextmanager
def in_file(name: str) -> Iterator[None]:
    """Name the file that a problem was noticed in, where that is not the session file."""
    try:
        yield
    except BadKeyError as problem:
        where = f"{dotted(problem.key)}: " if problem.key else ""
        raise BadKeyError(f"{name}: {where}{problem.text}") from problem


def found(value: object, allowed: str) -> str:
    """Say what stands there and what may."""
    return f"found {show(value)}; allowed: {allowed}"


def show(value: object) -> str:
    """Write a value as in the file, on one line and shortened."""
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
    """Write a key as ``sensor["left"].T_sensor_world[2]``.

    `named` are the names of the session's sensors, or bodies, whichever the key is of; one that is
    unique text stands in place of the number.
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
    """The known word that another is most likely a misspelling of, whatever its case."""
    by_lower = {k.lower(): k for k in known}
    close = get_close_matches(word.lower(), by_lower, n=1, cutoff=cutoff)
    return by_lower[close[0]] if close else None


def one_of(words: Iterable[str]) -> str:
    """List the words that are allowed."""
    return ", ".join(f'"{word}"' for word in words)


def did_you_mean(value: object, words: Iterable[str]) -> str:
    """Hint at the nearest allowed word; empty when none is near."""
    close = nearest(value, words) if isinstance(value, str) else None
    return f'; did you mean "{close}"?' if close else ""


def one_line(file: object, key: Key, text: str, session: Any = None) -> str:
    """Put a message about a key of a file together, on a single line.

    `session` is the file as parsed, to call sensors and bodies by their names.
    """
    first = key[0] if key else None
    found = session.get(first) if isinstance(session, dict) else None
    if first == "object" and not isinstance(found, list):
        key = (first, *key[2:])  # the only one has no number
    tables = found if isinstance(found, list) and first in ("sensor", "object") else []
    names = [table.get("name") if isinstance(table, dict) else None for table in tables]
    where = f"{dotted(key, names)}: " if key else ""
    return " ".join(f"{file}: {where}{text}".split())
