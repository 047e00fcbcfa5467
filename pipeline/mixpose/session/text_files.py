"""Read the text files of a session, TOML and YAML among them."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from typing import Any

from mixpose.limits import MOST_BYTES, MOST_YAML_CHARACTERS, MOST_YAML_NODES
from mixpose.session.messages import BadKeyError

_BINARY_FORMATS = {
    rb"\x89PNG|\xff\xd8\xff|BM....\x00\x00|II\*\x00|MM\x00\*|GIF8": "an image",
    rb"RIFF....AVI |....ftyp|\x1aE\xdf\xa3": "a video",
    rb"%PDF": "a PDF file",
    rb"PK\x03\x04|\x1f\x8b": "a packed file",
}
"""Names of binary files that users name by mistake, by their first bytes."""

_LINE = re.compile(r"\(at line (\d+), column \d+\)")
_TABLE = re.compile(r"\[\[?\s*(sensor|object)\s*\]")
_OTHER_QUOTES = re.compile("[“”„‘’«»]")
_WORD = r"(?!(?:true|false)\s*(?:#.*)?$)[^\W\d][^\s\"'\[\]{},#]*"
_SLIPS = (
    (rf"\s*([\w.-]+)\s*=\s*({_WORD})\s*(?:#.*)?", r'text in quotes, \1 = "\2"'),
    (r"\s*([\w.-]+)\s*=\s*([-+]?\d+),(\d+)\s*(?:#.*)?", r"a decimal point, \1 = \2.\3"),
    (r"\s*([\w.-]+)\s*:(?=.)\s*(.*?)\s*", r"an equals sign, \1 = \2"),
)
"""Patterns of lines that are no TOML, and hints at what is allowed instead."""

_OPENCV_HEAD = re.compile(r"\A\s*%YAML:?[ \d.]*[^\n]*\n(---[^\n]*\n)?")


def read_bytes(path: Path) -> bytes:
    """Read a file; raise BadKeyError if that fails or the file has more than `MOST_BYTES`."""
    try:
        is_other = path.exists() and not path.is_file()
        size = path.stat().st_size
        content = path.read_bytes() if not is_other and size <= MOST_BYTES else b""
    except FileNotFoundError as error:
        raise BadKeyError(f"no such file: {path}") from error
    except OSError as error:
        raise BadKeyError(f"cannot read {path}: {error.strerror or error}") from error
    except ValueError as error:  # a zero byte in the name
        raise BadKeyError(f"not a file name: {str(path)!r}") from error
    if is_other:
        raise BadKeyError(f"cannot read {path}: found no file; allowed: no folder, pipe or device")
    if size > MOST_BYTES:
        raise BadKeyError(f"{path} has {size} bytes; allowed: at most {MOST_BYTES}")
    return content


def as_text(content: bytes) -> str:
    """Decode UTF-8, with or without a byte order mark; raise BadKeyError if it is not text."""
    for start, kind in _BINARY_FORMATS.items():
        if re.match(start, content, re.DOTALL):
            raise BadKeyError(f"found {kind}; allowed: a text file in UTF-8")
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = content[: error.start].count(b"\n") + 1
        raise BadKeyError(f"not UTF-8 text at line {line}; save the file as UTF-8") from error


def parse_toml(text: str) -> dict[str, Any]:
    """Parse TOML; raise BadKeyError with a hint at what was most likely meant."""
    try:
        return tomllib.loads(text)
    except ValueError as error:  # invalid TOML, or a number of thousands of digits
        raise BadKeyError(f"not TOML: {error}{_hint(text, str(error))}") from error


def _hint(text: str, reason: str) -> str:
    """Return a hint at what was most likely meant; empty if that is unknown."""
    place = _LINE.search(reason)
    lines = text.splitlines()
    line = lines[int(place[1]) - 1] if place and 0 < int(place[1]) <= len(lines) else ""
    table = _TABLE.match(line.strip())
    if table is not None and ("twice" in reason or "overwrite" in reason):
        return f"; allowed for each of several: [[{table[1]}]] in two brackets, the first too"
    if _OTHER_QUOTES.search(line):
        return '; allowed: straight quotes, "..."'
    if "\\" in line and ("in a string" in reason or "hex value" in reason):
        return "; allowed: paths with / , or in single quotes, '...'"
    matches = ((re.fullmatch(pattern, line), meant) for pattern, meant in _SLIPS)
    return next((f"; allowed: {match.expand(meant)}" for match, meant in matches if match), "")


def parse_yaml(text: str) -> Any:
    """Return the first document of a YAML text that is not empty; None if there is none."""
    import yaml  # noqa: PLC0415  # only calibrations in YAML need it

    if len(text) > MOST_YAML_CHARACTERS:
        raise BadKeyError(
            f"found {len(text)} characters of YAML; allowed: at most {MOST_YAML_CHARACTERS}"
        )
    text = _OPENCV_HEAD.sub("", text)
    try:
        large = any(map(_is_large, yaml.compose_all(text, yaml.SafeLoader)))
        documents = () if large else yaml.safe_load_all(text)
        content = next((part for part in documents if part is not None), None)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        line = f" at line {mark.line + 1}" if mark else ""
        raise BadKeyError(f"not YAML{line}: {error.problem or error.context}") from error
    except RecursionError as error:
        raise BadKeyError("lists or tables in it are nested too deeply") from error
    except (yaml.YAMLError, ValueError, LookupError, TypeError) as error:
        raise BadKeyError(f"not YAML: {error}") from error
    if large:
        raise BadKeyError(
            f"its aliases (*name) stand for more than {MOST_YAML_NODES} values; write out what is "
            "meant"
        )
    return content


def _is_large(root: Any) -> bool:
    """Test whether aliases make a document large: a few bytes may stand for gigabytes."""
    sizes: dict[int, float] = {}

    def size_of(node: Any) -> float:
        known = sizes.get(id(node))
        if known is not None:
            return known
        sizes[id(node)] = float("inf")  # a node that contains itself is infinite
        items = [] if isinstance(node.value, str) else node.value
        parts = [part for item in items for part in (item if isinstance(item, tuple) else (item,))]
        sizes[id(node)] = 1 + sum(map(size_of, parts))
        return sizes[id(node)]

    return root is not None and size_of(root) > MOST_YAML_NODES
