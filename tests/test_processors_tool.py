"""The tool that runs the tests as on other processors: its settings, and how it reads pytest."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tools"))

import processors as tool

ROOT = Path(__file__).resolve().parents[1]


def test_what_is_run_is_the_readmes_test_command() -> None:
    command = tool.test_command((ROOT / "README.md").read_text(encoding="utf-8"))
    assert command[:3] == [sys.executable, "-m", "pytest"]


@pytest.mark.parametrize(
    ("units", "not_here"),
    [
        (["X86_V3", "X86_V4", "AVX512_ICL"], []),
        (["AVX2", "FMA3"], ["SkylakeX", "no-AVX512"]),
        ([], ["Haswell", "Zen", "SkylakeX", "no-AVX512", "no-vectors"]),
    ],
)
def test_what_a_processor_cannot_do_is_not_tried(
    units: list[str], not_here: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    rows = tool.settings(units, 8)
    assert [row.name for row in rows if not row.possible] == not_here
    assert {row.name: row.busy for row in rows if row.busy} == {"busy": 8}
    for row in rows:
        if not row.possible:
            assert tool.tried(row, ["no such program"]).failed == 0
    assert capsys.readouterr().out.count("not on this machine") == len(not_here)


def test_numpy_is_told_to_leave_alone_what_this_processor_has_only() -> None:
    (without,) = (s for s in tool.settings(["X86_V3", "X86_V4"], 8) if s.name == "no-AVX512")
    assert without.environment == {"NPY_DISABLE_CPU_FEATURES": "X86_V4"}
    units = tool.vector_units()
    program = "import numpy; print(numpy.show_config(mode='dicts')['SIMD Extensions']['baseline'])"
    for row in tool.settings(units, 8):  # a name that NumPy does not know here is a warning
        if row.possible:
            command = [sys.executable, "-W", "error", "-c", program]
            subprocess.run(command, env={**os.environ, **row.environment}, check=True)


def test_tests_that_fail_are_counted_and_named_and_so_is_a_process_that_dies() -> None:
    said = "FAILED tests/test_a.py::test_b - x\n=== 1 failed, 2 passed, 3 skipped in 0.1s ===\n"
    assert tool.outcome_of(said, 1) == tool.Outcome(2, 1, 3, ("tests/test_a.py::test_b",))
    assert tool.outcome_of("40 passed in 3.0s (0:00:03)\n", 0) == tool.Outcome(40, 0, 0, ())
    killed = tool.outcome_of("...", -4)
    assert (killed.failed, killed.names) == (1, ("pytest ended with status -4: ...",))


def test_a_setting_that_there_is_not_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        tool.main(["--setting", "Pentium"])
    assert "no such setting: Pentium; allowed: plain, Haswell" in capsys.readouterr().err
