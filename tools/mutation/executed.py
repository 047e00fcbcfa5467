"""Which tests execute which lines of the package: recorded once by coverage, then looked up.

A file of tests is recorded in a process of its own and kept as one file of JSON beside its like.
It is recorded anew where its text has changed.  Where a module has changed since, its lines are
not what they were: all tests that execute anything of it count then.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

SETTINGS = """[run]
source = {package}
data_file = {folder}/data
parallel = true
sigterm = true
context = ${{PYTEST_CURRENT_TEST-}}
disable_warnings = module-not-imported,no-data-collected,module-not-measured
"""

# Processes that tests start read the settings by themselves, and with them the name of the test.
STARTED = """import os

if "COVERAGE_PROCESS_START" in os.environ:
    import coverage

    coverage.process_startup()
"""
_PHASE = re.compile(r"(.+) \((call|setup|teardown)\)")


@dataclass(frozen=True)
class Executed:
    """What was recorded.

    Attributes
    ----------
    lines : dict
        For each module below the package, the lines that each context executed.  A context is a
        test, or a file of tests for what a fixture executed.
    seconds : dict
        What each test took that passed.
    changed : set of str
        Modules whose text is not what was recorded.
    """

    lines: dict[str, dict[str, set[int]]] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)
    changed: set[str] = field(default_factory=set)

    def tests(self, module: str, within: Iterable[tuple[int, int] | None]) -> list[str]:
        """Tests, quick ones first, that execute the first of some ranges of lines that any does.

        A range that is None stands for all lines of the module.
        """
        contexts = self.lines.get(module, {})
        for lines in within:
            everything = lines is None or module in self.changed
            wanted = set() if lines is None else set(range(lines[0], lines[1] + 1))
            names = {name for name, seen in contexts.items() if everything or seen & wanted}
            tests = [
                test for test in self.seconds if test in names or test.partition("::")[0] in names
            ]
            if tests:
                return sorted(tests, key=lambda test: self.seconds[test])
        return []


def digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def read(folder: Path, root: Path, package: str) -> Executed:
    """All that was recorded in a folder, for a repository as it stands now."""
    executed = Executed()
    for path in sorted(folder.glob("*.json")):
        one = json.loads(path.read_text(encoding="utf-8"))
        executed.seconds.update(one["seconds"])
        for module, contexts in one["lines"].items():
            source = root / package / module
            if not source.is_file() or digest(source) != one["sources"][module]:
                executed.changed.add(module)
            below = executed.lines.setdefault(module, {})
            for context, lines in contexts.items():
                below.setdefault(context, set()).update(lines)
    return executed


def record(
    tree: Path, package: str, folder: Path, environment: Mapping[str, str], limit_s: float
) -> None:
    """Record the tests of a tree that were not, or have changed; each file within a limit."""
    folder.mkdir(parents=True, exist_ok=True)
    for tests in sorted((tree / "tests").glob("test_*.py")):
        kept = folder / f"{tests.stem}.json"
        if kept.is_file() and json.loads(kept.read_text(encoding="utf-8"))["text"] == digest(tests):
            continue
        one = _recorded(tree, package, tests, environment, limit_s)
        kept.write_text(json.dumps(one), encoding="utf-8")
        print(f"{tests.name}: {len(one['seconds'])} tests recorded", flush=True)


def by_module(data: Path, package: Path) -> dict[str, dict[str, list[int]]]:
    """Lines of each context of each module, from a file of coverage.

    A process that a test starts bears the name of the test from `PYTEST_CURRENT_TEST`.
    """
    from coverage import CoverageData  # noqa: PLC0415  an extra that only this needs

    measured = CoverageData(str(data))
    measured.read()
    found: dict[str, dict[str, list[int]]] = {}
    for file in measured.measured_files():
        lines: dict[str, list[int]] = {}
        for line, contexts in measured.contexts_by_lineno(file).items():
            for name in {context_name(context) for context in contexts} - {""}:
                lines.setdefault(name, []).append(line)
        found[Path(file).relative_to(package).as_posix()] = lines
    return found


def context_name(context: str) -> str:
    """The test, or the file of tests where a fixture is made or nothing is known, of a context.

    A context reads `test`, or `test (call)` or `test (setup)` in a process that a test started.
    """
    process = _PHASE.fullmatch(context)
    if process is None:
        return context
    return process[1] if process[2] == "call" else process[1].partition("::")[0]


def _recorded(
    tree: Path, package: str, tests: Path, environment: Mapping[str, str], limit_s: float
) -> dict[str, Any]:
    """Run a file of tests under coverage; what is done within the limit is kept."""
    folder, took = tree / ".executed", tree / "seconds.jsonl"
    folder.mkdir()
    settings = folder / "settings"
    settings.write_text(SETTINGS.format(package=tree / package, folder=folder), encoding="utf-8")
    (folder / "sitecustomize.py").write_text(STARTED, encoding="utf-8")
    path = (environment["PYTHONPATH"], str(Path(__file__).resolve().parents[1]), str(folder))
    measured = {**environment, "PYTHONPATH": os.pathsep.join(path), "TO_MEASURE": str(settings)}
    measured.pop("PYTEST_CURRENT_TEST", None)  # of a test that calls this
    command = [sys.executable, "-m", "coverage"]
    run = ["-m", "pytest", "-p", "mutation.contexts", "-p", "no:cacheprovider", "-q", str(tests)]
    try:
        with suppress(subprocess.TimeoutExpired):
            _quietly([*command, "run", f"--rcfile={settings}", *run], tree, measured, limit_s)
        _quietly([*command, "combine", f"--rcfile={settings}"], tree, measured, limit_s)
        lines = by_module(folder / "data", tree / package)
        seconds = took.read_text(encoding="utf-8").splitlines() if took.is_file() else []
        return {
            "text": digest(tests),
            "sources": {module: digest(tree / package / module) for module in lines},
            "seconds": dict(map(json.loads, seconds)),
            "lines": lines,
        }
    finally:
        shutil.rmtree(folder)
        took.unlink(missing_ok=True)


def _quietly(
    command: Sequence[str], tree: Path, environment: Mapping[str, str], limit_s: float
) -> None:
    """Run a command; one that is not done in time is ended as coverage expects it."""
    with subprocess.Popen(
        command,
        cwd=tree,
        env=environment,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    ) as process:
        try:
            process.wait(limit_s)
        except subprocess.TimeoutExpired:
            process.terminate()
            process.wait(60.0)
            raise
