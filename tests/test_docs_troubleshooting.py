"""Links within pages lead to headings, and docs/troubleshooting.md quotes what the code prints."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
LINK = re.compile(r"\]\((?!https?:)([^)#]*)#([^)]+)\)")
QUOTED = re.compile(r"^ {4}(?:mixpose: (?:warning: )?|warning +)?(.+)$", re.MULTILINE)
SHORTEST = 8  # characters of a text in the code that says anything


def without_blocks(page: Path) -> str:
    return re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)


@cache
def headings(page: Path) -> frozenset[str]:
    """What GitHub calls the headings of a page in links."""
    found = re.findall(r"^#+ (.*)$", without_blocks(page), re.MULTILINE)
    return frozenset(re.sub(r"[^\w\- ]", "", one.lower()).replace(" ", "-") for one in found)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_to_headings_lead_to_one(page: Path) -> None:
    for file, heading in LINK.findall(without_blocks(page)):
        target = (page.parent / file).resolve() if file else page
        assert heading in headings(target), f"{file}#{heading}"


@cache
def texts() -> tuple[str, ...]:
    """Texts in the code, those of f-strings in pieces; the longest first."""
    found = set[str]()
    for path in (ROOT / "pipeline" / "mixpose").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Constant) and isinstance(node.value, str):
                found.update(part for part in re.split(r"\{\w*\}", node.value))
    return tuple(sorted((one for one in found if len(one) >= SHORTEST), key=len, reverse=True))


def quoted_lines() -> Iterator[str]:
    yield from QUOTED.findall((ROOT / "docs" / "troubleshooting.md").read_text(encoding="utf-8"))


def test_what_the_page_about_trouble_quotes_is_in_the_code() -> None:
    lines = list(quoted_lines())
    assert len(lines) > 60
    for line in lines:
        left = line
        for text in texts():
            left = left.replace(text, "")
        # names, numbers and short words stand between the texts
        assert len(left) < 0.7 * len(line), line


def test_what_the_page_about_trouble_quotes_leads_to_where_it_is_quoted() -> None:
    page = (ROOT / "docs" / "troubleshooting.md").read_text(encoding="utf-8")
    table = page.partition("## By what is printed")[2].partition("## By what the poses do")[0]
    rows = re.findall(r"^\| (`.*`) \| (.*) \|$", table, re.MULTILINE)
    assert len(rows) > 50
    printed = [(re.findall("`([^`]+)`", phrases), links) for phrases, links in rows]
    for entry in re.split(r"^### ", page, flags=re.MULTILINE)[1:]:
        heading = re.sub(r"[^\w\- ]", "", entry.partition("\n")[0].lower()).replace(" ", "-")
        for line in QUOTED.findall(entry):
            found = [
                links
                for phrases, links in printed
                if any(all(part in line for part in one.split(" ... ")) for one in phrases)
            ]
            assert any(f"(#{heading})" in links for links in found), line
