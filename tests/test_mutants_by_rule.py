"""Mutants by rule: what is changed, what is left alone, and by which tests they are tried."""

from __future__ import annotations

import ast
import json
import os
import subprocess
import sys
from argparse import Namespace
from functools import cache
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tools"))

import mutants as tool
from mutation.drawn import ROOMS, candidates, chosen_tests, drawn, reason_why_harmless
from mutation.executed import Executed, context_name, digest, read, record
from mutation.harmless import GUARDED, HARMLESS, Harmless
from mutation.mutant import MutationError
from mutation.rules import changes

ROOT = Path(__file__).resolve().parents[1]
ROOM = '''"""Not 1 number of this is changed."""

MOST = 3


def small(x: int, least: int = 0) -> str:
    """Whether x is not < 1."""
    if x < least and not x == MOST:
        return "less than 2" + "!"
    return f"{x + 1} is not small"
'''
TEST = """from mixpose.runner import small


def test_small() -> None:
    assert small(-1) == "less than 2!"
    assert small(0) == "1 is not small"


def test_nothing() -> None:
    pass
"""


def texts(source: str) -> list[tuple[int, str, str]]:
    """Line, piece and what replaces it."""
    data = source.encode()
    return [(one.line, data[one.start : one.end].decode(), one.after) for one in changes(source)]


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    """A repository of one module with two tests, of which one executes it, as git tracks it."""
    root = tmp_path / "tree"
    package, tests = root / tool.PACKAGE, root / "tests"
    package.mkdir(parents=True)
    tests.mkdir()
    (package / "__init__.py").write_text("", encoding="utf-8")
    (package / "runner.py").write_text(ROOM, encoding="utf-8")
    (tests / "test_runner_small.py").write_text(TEST, encoding="utf-8")
    return root


def recorded(tree: Path) -> Path:
    """A folder that tells which of the two tests executes what."""
    folder, test = tree / "build" / "executed", "tests/test_runner_small.py"
    folder.mkdir(parents=True)
    one = {
        "text": digest(tree / test),
        "sources": {"runner.py": digest(tree / tool.PACKAGE / "runner.py")},
        "seconds": {f"{test}::test_small": 0.5, f"{test}::test_nothing": 0.25},
        "lines": {"runner.py": {f"{test}::test_small": [8, 9, 10]}},
    }
    (folder / "test_runner_small.json").write_text(json.dumps(one), encoding="utf-8")
    return folder


def test_operators_numbers_defaults_and_exits_change_and_texts_do_not() -> None:
    assert texts(ROOM) == [
        (3, "3", "4"),
        (3, "3", "6"),
        (6, "0", "1"),
        (8, "<", "<="),
        (8, "and", "or"),
        (8, "not", ""),
        (8, "==", "!="),
        (9, 'return "less than 2" + "!"', "pass"),
    ]


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("a = b is not None", [("is not", "is")]),
        ("a = b not in c", [("not in", "in")]),
        ("a = (b) - (c)", [("-", "+")]),
        ("a = 'µ' if b // c else -d", [("//", "/"), ("-", "+")]),
        ("a = 0 < b <= c", [("0", "1"), ("<", "<="), ("<=", "<")]),
        ("a = 0.5 or True", [("0.5", "1.0"), ("or", "and"), ("True", "False")]),
        ("a: Literal[3] = b", []),
        ("draw(a, zorder=3)", []),
        ("raise ValueError(1)", []),
        ("a = [b] + c", []),
    ],
)
def test_a_line_changes_where_its_operators_stand(
    line: str, expected: list[tuple[str, str]]
) -> None:
    assert [(before, after) for _, before, after in texts(line)] == expected


def test_a_change_is_reached_where_its_statement_is_executed() -> None:
    text = """A = 1
def f(x=2):
    "3"
    with g(4):
        if x > 5:
            return h(
                6,
            )
"""
    reached = {one.line: one.reach for one in changes(text)}
    assert reached == {1: None, 2: (4, 8), 4: (4, 4), 5: (5, 5), 6: (6, 8), 7: (6, 8)}


def test_every_mutant_of_every_room_can_be_compiled_and_differs() -> None:
    package = ROOT / tool.PACKAGE
    some = drawn(package, 10 * len(ROOMS), seed=1)
    assert {one.room for one in some} == set(ROOMS)
    files = {one.file: (package / one.file).read_text(encoding="utf-8") for one in some}
    trees = {file: ast.dump(ast.parse(text)) for file, text in files.items()}
    for one in some:
        assert ast.dump(ast.parse(one.mutated(files[one.file]))) != trees[one.file], one.name


def test_the_seed_chooses_the_mutants_and_rooms_take_turns(tree: Path) -> None:
    package = ROOT / tool.PACKAGE
    first = drawn(package, 6, 1, ["poses", "frames"])
    assert first == drawn(package, 6, 1, ["poses", "frames"])
    assert first != drawn(package, 6, 2, ["poses", "frames"])
    assert [one.room for one in first] == ["poses", "frames"] * 3
    assert len(drawn(tree / tool.PACKAGE, 100, 0)) == len(changes(ROOM))  # no more than there are
    with pytest.raises(MutationError, match="no such room: attic; allowed: calibration, "):
        drawn(package, 1, 0, ["attic"])


def test_numbers_of_layout_are_left_alone(tree: Path) -> None:
    drawing = tree / tool.PACKAGE / "pictures" / "sheet.py"
    drawing.parent.mkdir()
    drawing.write_text("def wide(x):\n    return 3 < x\n", encoding="utf-8")
    assert [one.before for one in candidates(tree / tool.PACKAGE, "pictures")] == ["<"]


def test_a_text_that_has_moved_is_no_longer_mutated(tree: Path) -> None:
    one = next(candidates(tree / tool.PACKAGE, "runner"))
    with pytest.raises(MutationError, match=r"runner\.py is not what it was; draw anew"):
        one.mutated("# one line more\n" + ROOM)


@pytest.mark.parametrize(
    ("context", "name"),
    [
        ("", ""),
        ("a.py", "a.py"),
        ("a.py::test[x (y)]", "a.py::test[x (y)]"),
        ("a.py::test (call)", "a.py::test"),
        ("a.py::test[x] (setup)", "a.py"),
    ],
)
def test_lines_of_a_process_that_a_test_starts_are_the_tests(context: str, name: str) -> None:
    assert context_name(context) == name


def test_tests_that_execute_the_line_are_chosen_those_of_the_room_first(tree: Path) -> None:
    change = next(one for one in candidates(tree / tool.PACKAGE, "runner") if one.before == "and")
    lines = {"a.py::far": {8}, "tests/test_runner_x.py": {8}, "b.py::other": {9}}
    seconds = {
        "a.py::far": 1.0,
        "tests/test_runner_x.py::slow": 2.0,
        "tests/test_runner_x.py::quick": 1.0,
        "b.py::other": 0.1,
    }
    executed = Executed({"runner.py": lines}, seconds)
    room = ["tests/test_runner_x.py::quick", "tests/test_runner_x.py::slow"]
    assert chosen_tests(change, executed, 90.0) == [*room, "a.py::far"]
    assert chosen_tests(change, executed, 3.5) == room
    assert chosen_tests(change, executed, 0.5) == room[:1]
    elsewhere = Executed({"runner.py": {"b.py::other": {9}}}, seconds)
    assert chosen_tests(change, elsewhere, 90.0) == []
    on_import = next(candidates(tree / tool.PACKAGE, "runner"))
    assert chosen_tests(on_import, elsewhere, 90.0) == ["b.py::other"]


def test_lines_of_a_module_that_has_changed_since_are_not_trusted(tree: Path) -> None:
    folder = recorded(tree)
    executed = read(folder, tree, tool.PACKAGE)
    assert executed.tests("runner.py", [(3, 3)]) == []
    (tree / tool.PACKAGE / "runner.py").write_text("\n" + ROOM, encoding="utf-8")
    executed = read(folder, tree, tool.PACKAGE)
    assert executed.tests("runner.py", [(3, 3)]) == ["tests/test_runner_small.py::test_small"]


def test_lines_are_recorded_by_test_also_in_processes_that_a_test_starts(tree: Path) -> None:
    pytest.importorskip("coverage")
    script = "from mixpose.runner import small; small(4)"
    test = tree / "tests" / "test_runner_small.py"
    started = f"subprocess.run([sys.executable, '-c', {script!r}], check=True)"
    test.write_text(f"import subprocess, sys\n{TEST.replace('pass', started)}", encoding="utf-8")
    folder, environment = tree / "build", {**os.environ, "PYTHONPATH": str(tree / "pipeline")}
    record(tree, tool.PACKAGE, folder, environment, 120.0)
    executed = read(folder, tree, tool.PACKAGE)
    small, nothing = (f"tests/test_runner_small.py::test_{name}" for name in ("small", "nothing"))
    assert set(executed.seconds) == {small, nothing}
    assert executed.tests("runner.py", [(9, 9)]) == [small]
    assert set(executed.tests("runner.py", [(10, 10)])) == {small, nothing}
    assert not (tree / "seconds.jsonl").exists()
    # what has not changed is not recorded again
    record(tree, tool.PACKAGE, folder, {}, 0.0)


def test_mutants_by_rule_are_tried_and_the_harmless_counted_apart(
    tree: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    subprocess.run(["git", "init", "-q"], cwd=tree, check=True)
    subprocess.run(["git", "add", "pipeline", "tests"], cwd=tree, check=True)
    folder = recorded(tree)
    known = "a text no user sees"
    monkeypatch.setattr(tool, "ROOT", tree)
    monkeypatch.setattr(tool, "EXECUTED", folder)
    monkeypatch.setattr(
        tool, "reason_why_harmless", lambda one: known if one.after == "6" else None
    )
    options = ["--random", "4", "--seed", "6", "--room", "runner", "--keep-going"]
    assert tool.main(options) == 1
    printed = capsys.readouterr().out
    test = "killed by tests/test_runner_small.py::test_small"
    assert f"runner.py:8: < -> <=: {test}" in printed
    assert f"runner.py:3: 3 -> 6: harmless, {known} (0.0 s)" in printed
    # no call of the tests comes near it
    assert "runner.py:3: 3 -> 4: SURVIVED" in printed
    assert "  MOST = 3  ->  MOST = 4 (1 tests)\n" in printed
    assert printed.splitlines()[-2] == "| all | 4 | 2 | 1 | 0 | 1 |"
    assert (tree / tool.PACKAGE / "runner.py").read_text(encoding="utf-8") == ROOM


def test_nothing_is_tried_where_no_record_is(tree: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tool, "copy_tracked", lambda root, copy: root.rename(copy))
    options = Namespace(random=1, seed=0, room=[], record=False)
    with pytest.raises(MutationError, match="found no record of what tests execute; add --record"):
        tool.tried_at_random(tree, tree / "none", options)


def test_lists_of_one_length_need_not_be_told_to_be(tree: Path) -> None:
    room = "a = zip(b, c, strict=True)\nd = sorted(e, reverse=True)\n"
    (tree / tool.PACKAGE / "runner.py").write_text(room, encoding="utf-8")
    found = [reason_why_harmless(one) for one in candidates(tree / tool.PACKAGE, "runner")]
    assert found == [GUARDED, None]


@pytest.mark.parametrize("one", HARMLESS, ids=lambda one: one.new)
def test_every_harmless_mutant_is_one_of_the_code_as_it_is(one: Harmless) -> None:
    room = one.file.partition("/")[0].removesuffix(".py")
    assert one.reason in {reason for file, reason in reasons_in(room) if file == one.file}


@cache
def reasons_in(room: str) -> list[tuple[str, str | None]]:
    """Files of the mutants of a room, and why these are harmless."""
    return [(one.file, reason_why_harmless(one)) for one in candidates(ROOT / tool.PACKAGE, room)]
