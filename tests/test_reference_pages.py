"""The reference pages say what the code does, and their examples are right."""

from __future__ import annotations

import dataclasses
import re
import sys
import tomllib
from pathlib import Path
from typing import Any

import pytest
from pydantic import ValidationError

from mixpose.session import load_session
from mixpose.session.schema_sensors import Table
from mixpose.tracking import Rules

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tools"))

import make_reference  # noqa: E402

KEYS = [(table, key) for _, table, _ in make_reference.SECTIONS for key in table.model_fields]


@pytest.mark.parametrize("name", list(make_reference.PAGES))
def test_the_pages_are_as_the_tool_writes_them(name: str) -> None:
    committed = (ROOT / "docs" / name).read_text(encoding="utf-8")
    assert committed == make_reference.PAGES[name](), "run python tools/make_reference.py"


@pytest.mark.parametrize(("table", "key"), KEYS, ids=lambda part: getattr(part, "__name__", part))
def test_every_key_is_explained_with_an_example_that_is_accepted(
    table: type[Table], key: str
) -> None:
    meaning, example = make_reference.split_example(make_reference.key_docstrings(table)[key])
    assert meaning.strip()
    if meaning.startswith("See ") and example is None:
        return  # a table, with examples of its own
    assert example is not None
    values = tomllib.loads(example)
    assert list(values) == [key]
    wrong = set()
    try:
        table.model_validate(values)
    except ValidationError as error:
        wrong = {finding["loc"][0] for finding in error.errors()}
    assert key not in wrong  # though other keys are missing


def test_the_smallest_session_on_the_page_can_be_read(tmp_path: Path) -> None:
    page = (ROOT / "docs" / "session.md").read_text(encoding="utf-8")
    text = page.partition("```toml\n")[2].partition("```")[0]
    (tmp_path / "session.toml").write_text(text, encoding="utf-8")
    session = load_session(tmp_path / "session.toml")
    assert (len(session.body), len(session.sensors)) == (6, 1)


def test_every_rule_of_a_tracker_is_on_the_page_of_constants_with_a_reason() -> None:
    page = (ROOT / "docs" / "constants.md").read_text(encoding="utf-8")
    groups: list[Any] = [Rules()]
    seen = 0
    while groups:
        group = groups.pop()
        for field in dataclasses.fields(group):
            value = getattr(group, field.name)
            if dataclasses.is_dataclass(value) and "why" not in field.metadata:
                groups.append(value)  # else it is a rule itself: where to end an ascent
                continue
            section = page.partition(f"### `{type(group).__name__}`")[2].partition("###")[0]
            (row,) = re.findall(rf"\| `{field.name}` \| `.*` \| (.*) \|\n", section)
            assert row.strip(), field.name
            seen += 1
    assert seen > 100


def test_every_command_and_option_is_on_the_page() -> None:
    page = (ROOT / "docs" / "commands.md").read_text(encoding="utf-8")
    for words in (
        "## `mixpose run SESSION.toml",
        "`-o, --output PATH`",
        "`--source NAME=PATH`",
        "`--quick`",
        "`--format jsonl|csv|tum|bop|ros`: Else by the suffix: .jsonl",
        "`--frames N`: Number of frames. Needed, at least 1.",
    ):
        assert words in page
