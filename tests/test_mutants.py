"""The tool that puts small bugs into the code: its mutants fit the code, its verdicts are right."""

from __future__ import annotations

import ast
import sys
from dataclasses import replace
from functools import cache
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tools"))

import mutants as tool
from mutation import MUTANTS
from mutation.mutant import Mutant, MutationError

ROOT = Path(__file__).resolve().parents[1]
DOUBLE = "def twice(x: float) -> float:\n    return 2 * x\n\n\nUNUSED = 1\n"
TEST = "from mixpose.rigid import twice\n\n\ndef test_twice() -> None:\n    assert twice(2) == 4\n"


def mutant(before: str, after: str, name: str = "rigid-some") -> Mutant:
    return Mutant(name, "rigid.py", before, after, "a number is wrong")


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    """A repository of one module with one test."""
    package = tmp_path / "tree" / tool.PACKAGE
    package.mkdir(parents=True)
    (package / "__init__.py").write_text("", encoding="utf-8")
    (package / "rigid.py").write_text(DOUBLE, encoding="utf-8")
    tests = tmp_path / "tree" / "tests"
    tests.mkdir()
    (tests / "test_rigid.py").write_text(TEST, encoding="utf-8")
    return tmp_path / "tree"


@cache
def read_of(file: str) -> tuple[str, str]:
    """The text of a file of the package, and its syntax tree."""
    text = (ROOT / tool.PACKAGE / file).read_text(encoding="utf-8")
    return text, ast.dump(ast.parse(text))


@pytest.mark.parametrize("one", MUTANTS, ids=lambda one: one.name)
def test_every_mutant_fits_the_code_and_can_be_compiled(one: Mutant) -> None:
    text, tree = read_of(one.file)
    assert ast.dump(ast.parse(one.mutated(text))) != tree
    assert one.name.startswith(f"{one.room}-")
    assert one.why
    for pattern in (*one.tests, *tool.TESTS[one.room]):
        assert list((ROOT / "tests").glob(pattern)), pattern


def test_names_of_mutants_are_unique_and_every_room_has_some() -> None:
    assert len({one.name for one in MUTANTS}) == len(MUTANTS)
    assert {one.room for one in MUTANTS} == set(tool.TESTS)


@pytest.mark.parametrize(("before", "count"), [("3 * x", 0), ("x", 2)])
def test_a_text_that_does_not_stand_there_once_is_an_error_with_the_mutants_name(
    before: str, count: int
) -> None:
    with pytest.raises(MutationError, match=f"rigid-some: found its text {count} times"):
        mutant(before, "4 * x").mutated(DOUBLE)


def test_names_and_rooms_choose_mutants_and_unknown_ones_are_told() -> None:
    rooms = {one.room for one in tool.chosen(MUTANTS, [], ["sensors", "poses"])}
    assert rooms == {"sensors", "poses"}
    assert tool.chosen(MUTANTS, [MUTANTS[0].name], []) == (MUTANTS[0],)
    with pytest.raises(MutationError, match="no such mutant: rigid-nothing; allowed: rigid-"):
        tool.chosen(MUTANTS, ["rigid-nothing"], [])
    with pytest.raises(MutationError, match="no such room: attic; allowed: rigid, "):
        tool.chosen(MUTANTS, [], ["attic"])


def test_a_mutant_dies_of_the_test_that_notices_it_and_another_survives(tree: Path) -> None:
    copy = tree.parent / "copy"
    killed = tool.trial(tree, copy, mutant("2 * x", "3 * x"))
    assert killed.killed_by == "tests/test_rigid.py::test_twice"
    survivor = tool.trial(tree, copy, mutant("UNUSED = 1", "UNUSED = 2"))
    assert survivor.killed_by is None
    assert not copy.exists()
    assert (tree / tool.PACKAGE / "rigid.py").read_text(encoding="utf-8") == DOUBLE


def test_a_mutant_whose_tests_run_out_of_time_is_no_killed_one(
    tree: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    endless = mutant("return 2 * x", "while True: x", name="rigid-endless")
    monkeypatch.setattr(tool, "TIME_LIMIT_S", 3.0)
    outcome = tool.trial(tree, tree.parent / "copy", endless)
    assert (outcome.killed_by, outcome.out_of_time, outcome.verdict) == (None, True, "OUT OF TIME")
    assert not (tree.parent / "copy").exists()
    monkeypatch.setattr(tool, "tried", lambda *_, **__: [outcome])
    assert tool.main([]) == 1
    assert "1 mutants, 0 survived, 1 ran out of time" in capsys.readouterr().out
    # the same tests without a mutant
    monkeypatch.setattr(tool, "TIME_LIMIT_S", 0.01)
    with pytest.raises(MutationError, match=r"without any mutant, the tests are not done after"):
        tool.check_sound(tree, [endless])


def test_a_mutant_that_cannot_be_imported_is_an_error_and_no_verdict(tree: Path) -> None:
    broken = mutant("def twice", "def thrice", name="rigid-broken")
    with pytest.raises(MutationError, match="rigid-broken: the tests do not run"):
        tool.trial(tree, tree.parent / "copy", broken)


def test_tests_that_fail_without_any_mutant_are_an_error(tree: Path) -> None:
    tests = tree / "tests" / "test_rigid.py"
    tests.write_text(TEST.replace("== 4", "== 5"), encoding="utf-8")
    with pytest.raises(MutationError, match="test_twice fails without any mutant"):
        tool.check_sound(tree, [mutant("2 * x", "3 * x")])


def test_a_mutants_own_tests_come_before_those_of_its_room(tree: Path) -> None:
    (tree / "tests" / "test_special.py").write_text("", encoding="utf-8")
    special = replace(mutant("2 * x", "3 * x"), tests=("test_special.py",))
    assert tool.tests_of(tree, special) == ["tests/test_special.py", "tests/test_rigid.py"]
