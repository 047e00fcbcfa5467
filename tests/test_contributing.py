"""The walk of one frame through the source names files and functions that exist."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import mixpose

PACKAGE = Path(mixpose.__file__).parent
PAGE = (Path(__file__).resolve().parents[1] / "CONTRIBUTING.md").read_text(encoding="utf-8")
WALK = PAGE.partition("## One frame")[2].partition("\n## ")[0]


def names_in(path: Path) -> set[str]:
    """Functions and classes of a file, methods as `Class.method`."""
    names = set()
    for node in ast.parse(path.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            names.add(node.name)
        if isinstance(node, ast.ClassDef):
            methods = [one for one in node.body if isinstance(one, ast.FunctionDef)]
            names |= {f"{node.name}.{one.name}" for one in methods}
    return names


def test_the_walk_of_a_frame_has_ten_steps_at_most() -> None:
    assert 5 <= len(re.findall(r"^\d+\. ", WALK, re.MULTILINE)) <= 10


def test_files_and_functions_of_the_walk_exist() -> None:
    files = re.findall(r"`([\w/]+\.py)`", WALK)
    assert len(files) >= 10
    everything: set[str] = set()
    for file in files:
        assert (PACKAGE / file).is_file(), file
        everything |= names_in(PACKAGE / file)
    # what follows a file, or stands before "in" one, is in that file
    pairs = [(f, n) for f, n in re.findall(r"`([\w/]+\.py)`,\s+`([\w.]+)`", WALK)]
    pairs += [(f, n) for n, f in re.findall(r"`([\w.]+)` in\s+`([\w/]+\.py)`", WALK)]
    assert len(pairs) >= 15
    for file, name in pairs:
        assert name in names_in(PACKAGE / file), f"{file} has no {name}"
    others = set(re.findall(r"`([a-z_]{4,}|[A-Z]\w+\.\w+)`", WALK)) - {name for _, name in pairs}
    assert others - {"ambiguous", "lost"} <= everything


def test_rooms_of_the_house_are_those_of_the_source() -> None:
    table = PAGE.partition("| floor | rooms |")[2].partition("\n\n")[0]
    rooms = set(re.findall(r"`(\w+)`", table))
    there = {path.stem for path in PACKAGE.iterdir() if path.suffix == ".py" or path.is_dir()}
    assert rooms == {name for name in there if not name.startswith("__")}
