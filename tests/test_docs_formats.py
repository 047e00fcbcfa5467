"""The examples of docs/formats.md, run one after the other."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


def test_examples_of_the_page_about_formats_run(tmp_path: Path) -> None:
    pytest.importorskip("evo")
    pytest.importorskip("jsonschema")
    (tmp_path / "data").symlink_to(ROOT / "data", target_is_directory=True)
    text = (ROOT / "docs" / "formats.md").read_text(encoding="utf-8")
    blocks = re.findall(r"```(sh|python)\n(.*?)```", text, re.DOTALL)
    assert len(blocks) >= 7
    script = ["from mixpose.cli import main"]
    for kind, block in blocks:
        if "rerun" in block:  # its package is no part of the tests' environment
            continue
        if kind == "python":
            script.append(block)
        for line in block.splitlines() if kind == "sh" else ():
            assert line.startswith("mixpose ")
            script.append(
                f"try: main({line.split()[1:]!r})\nexcept SystemExit as e: assert not e.code"
            )
    result = subprocess.run(
        [sys.executable, "-c", "\n".join(script)],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert result.returncode == 0, result.stderr
    rms_m = float(result.stdout.split()[0])
    assert 0 < rms_m < 1e-4  # 0.04 mm, as the table of README.md has it
    written = {path.name for path in tmp_path.iterdir()} - {"data"}
    assert written == {
        *("poses.jsonl", "poses.csv", "poses.tum", "truth.tum", "poses.yaml"),
        *("bodies.jsonl", ".bodies.jsonl.state", "beside.csv"),
        *("mixpose_tracker-test.csv", "mixpose_camera-test.csv"),
    }
