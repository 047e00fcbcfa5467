"""README's tests with the arithmetic of other processors, and on a busy machine: a row for each.

    python tools/processors.py [--setting NAME ...] [--busy 8] [--list] [TEST ...]

OpenBLAS is told which processor's kernels to take, NumPy which vector units to leave alone, and
other processes keep the machine busy.  What this processor cannot do is told and not tried.  TEST
are files or options for pytest, in place of all tests.  The exit status is 1 where a test fails.
"""

from __future__ import annotations

import argparse
import os
import re
import shlex
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]

# Processors of OpenBLAS, and vector units by one of which NumPy tells that theirs are here; its
# names changed with version 2.4.
KERNELS = {
    "Haswell": ("AVX2", "X86_V3"),
    "Zen": ("AVX2", "X86_V3"),
    "SkylakeX": ("AVX512_SKX", "X86_V4"),
}
_AVX512 = re.compile(r"AVX512|X86_V4")
_COUNT = re.compile(r"(\d+) (passed|failed|error|skipped)")
_FAILED = re.compile(r"^(?:FAILED|ERROR) (\S+)", re.MULTILINE)
_KERNELS_IN_USE = (
    "import numpy, scipy.linalg, threadpoolctl\n"
    "found = [each.get('architecture', '?') for each in threadpoolctl.threadpool_info()]\n"
    "print('/'.join(dict.fromkeys(found)) or '-')"
)


@dataclass(frozen=True)
class Setting:
    """How tests are run.

    Attributes
    ----------
    name : str
    environment : mapping of str to str
        Variables beside those of this process.
    busy : int
        Processes that compute meanwhile.
    possible : bool
        Whether this processor can do it.
    """

    name: str
    environment: Mapping[str, str] = field(default_factory=dict)
    busy: int = 0
    possible: bool = True


@dataclass(frozen=True)
class Outcome:
    """Tests by how they ended, and the names of those that failed."""

    passed: int
    failed: int
    skipped: int
    names: tuple[str, ...]


def vector_units() -> list[str]:
    """Vector units that NumPy uses here, beyond those that it always needs."""
    found = np.show_config(mode="dicts")["SIMD Extensions"]
    return list(found.get("found", []))


def settings(units: Sequence[str], busy: int) -> list[Setting]:
    """All that is tried on a processor with these vector units."""
    rows = [Setting("plain")]
    for kernel, needed in KERNELS.items():
        possible = any(unit in units for unit in needed)
        rows.append(Setting(kernel, {"OPENBLAS_CORETYPE": kernel}, possible=possible))
    without = {"no-AVX512": [u for u in units if _AVX512.match(u)], "no-vectors": list(units)}
    for name, off in without.items():
        variables = {"NPY_DISABLE_CPU_FEATURES": " ".join(off)}
        rows.append(Setting(name, variables, possible=bool(off)))
    return [*rows, Setting("busy", busy=busy)]


def test_command(readme: str) -> list[str]:
    """The part of README's test command that runs pytest, for this Python."""
    block = readme.partition("<!-- test command -->")[2].partition("```sh\n")[2].partition("```")[0]
    (part,) = (part for part in block.split("&&") if "pytest" in part)
    words = shlex.split(part)
    return [sys.executable, *words[words.index("-m") :]]


def outcome_of(output: str, status: int) -> Outcome:
    """What pytest says at the end of its output; a process that says nothing is a failure."""
    last = output.strip().rpartition("\n")[2]
    counts = {kind: int(number) for number, kind in _COUNT.findall(last)}
    failed = counts.get("failed", 0) + counts.get("error", 0)
    names = tuple(_FAILED.findall(output))
    if status and not failed:
        failed, names = 1, (f"pytest ended with status {status}: {last}",)
    return Outcome(counts.get("passed", 0), failed, counts.get("skipped", 0), names)


@contextmanager
def load(count: int) -> Iterator[None]:
    """Processes that compute without end."""
    started = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(count)]
    try:
        yield
    finally:
        for process in started:
            process.kill()
            process.wait()


def tried(setting: Setting, command: Sequence[str]) -> Outcome:
    """Run tests under a setting and print its row."""
    if not setting.possible:
        print(f"{setting.name:<12}{'not on this machine':>20}", flush=True)
        return Outcome(0, 0, 0, ())
    environment = {**os.environ, **setting.environment}
    kernels = _said([sys.executable, "-c", _KERNELS_IN_USE], environment)[1].strip()
    began = time.perf_counter()
    with load(setting.busy):
        status, output = _said(command, environment)
    found = outcome_of(output, status)
    row = f"{setting.name:<12}{kernels:>20}{found.passed:>8}{found.failed:>8}{found.skipped:>9}"
    print(f"{row}{time.perf_counter() - began:>9.0f}", flush=True)
    for name in found.names:
        print(f"    {name}", flush=True)
    return found


def _said(command: Sequence[str], environment: Mapping[str, str]) -> tuple[int, str]:
    done = subprocess.run(
        command, cwd=ROOT, env=environment, stdout=subprocess.PIPE, text=True, check=False
    )
    return done.returncode, done.stdout


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("tests", nargs="*", metavar="TEST")
    parser.add_argument("--setting", action="append", default=[], help="all where left out")
    parser.add_argument("--busy", type=int, default=8, help="processes that keep it busy")
    parser.add_argument("--list", action="store_true", help="say the settings, and run nothing")
    options, more = parser.parse_known_args(arguments)
    rows = settings(vector_units(), options.busy)
    names = [row.name for row in rows]
    for name in options.setting:
        if name not in names:
            parser.error(f"no such setting: {name}; allowed: {', '.join(names)}")
    if options.list:
        for row in rows:
            variables = " ".join(f"{key}='{value}'" for key, value in row.environment.items())
            print(f"{row.name:<12}{variables or '-'}{'' if row.possible else ' (not here)'}")
        return 0
    command = test_command((ROOT / "README.md").read_text(encoding="utf-8"))
    command += [*more, *options.tests]
    print(f"{'setting':<12}{'linear algebra':>20}{'passed':>8}{'failed':>8}{'skipped':>9}{'s':>9}")
    wanted = [row for row in rows if not options.setting or row.name in options.setting]
    return int(any(tried(row, command).failed for row in wanted))


if __name__ == "__main__":
    sys.exit(main())
