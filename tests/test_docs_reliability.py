"""What docs/reliability.md promises is held by tests and tools that exist."""

from __future__ import annotations

import ast
import re
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tools"))

from faults import FAULTS

ROOT = Path(__file__).resolve().parents[1]
PAGE = (ROOT / "docs" / "reliability.md").read_text(encoding="utf-8")
PROMISES = PAGE.partition("## Which test holds which promise")[2]
ROW = re.compile(r"^\| ([^|]+) \| (\d+) \| (\d+) \| (\d+) \| (\d+) \| ([^|]+) \|$", re.MULTILINE)


def named_tests(file: str) -> set[str]:
    tree = ast.parse((ROOT / "tests" / file).read_text(encoding="utf-8"))
    return {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}


def test_each_promise_names_tests_that_exist() -> None:
    rows = re.findall(r"^\| ([^|]+) \| (`[^|]+`) \|$", PROMISES, re.MULTILINE)
    assert len(rows) >= 30
    for promise, held_by in rows:
        named = re.findall(r"`(\w+\.py)`:((?: `test_\w+`,?)+)", held_by)
        assert named, promise
        for file, tests in named:
            wanted = set(re.findall(r"test_\w+", tests))
            assert wanted <= named_tests(file), (
                f"{promise}: {file} has no {wanted - named_tests(file)}"
            )
    whole = "; ".join(held_by for _, held_by in rows)
    assert re.sub(r"`\w+\.py`:|`test_\w+`|[,; ]", "", whole) == ""  # all of it was looked up


def test_files_that_the_page_names_exist() -> None:
    files = set(re.findall(r"`((?:tests|tools|pipeline|data|\.ci)/[\w./]*)`", PAGE))
    assert len(files) >= 10
    files |= set(re.findall(r"`python (tools/\w+\.py)", PAGE))
    assert [each for each in sorted(files) if not (ROOT / each).exists()] == []


def test_the_table_of_faults_has_every_fault_and_no_wrong_pose() -> None:
    rows = ROW.findall(PAGE)
    assert [row[0] for row in rows] == list(FAULTS)
    for name, right, ambiguous, lost, wrong, said in rows:
        assert int(wrong) == 0, name
        assert int(right) + int(ambiguous) + int(lost) == 40, name
        assert re.search(FAULTS[name].named, said), name
        assert FAULTS[name].has_truth or int(right) == 0, name


@pytest.mark.parametrize("name", sorted(FAULTS))
def test_each_fault_but_none_must_be_named(name: str) -> None:
    assert bool(FAULTS[name].named) == (name != "nothing")
