"""The packages that are installed: a wheel and a source distribution, with all that they need."""

from __future__ import annotations

import os
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
SESSION = ROOT / "data" / "synthetic" / "range_profiles" / "session.toml"

pytest.importorskip("hatchling")


def built(source: Path, kind: str, folder: Path) -> Path:
    command = [sys.executable, "-m", "hatchling", "build", "-t", kind, "-d", str(folder)]
    subprocess.run(command, cwd=source, check=True, capture_output=True)
    (package,) = folder.iterdir()
    return package


def test_a_wheel_made_from_the_source_distribution_runs_by_itself(tmp_path: Path) -> None:
    source = built(ROOT, "sdist", tmp_path / "sdist")
    with tarfile.open(source) as archive:
        archive.extractall(tmp_path / "source", filter="data")
    (unpacked,) = (tmp_path / "source").iterdir()
    wheel = built(unpacked, "wheel", tmp_path / "wheel")
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(tmp_path / "installed")
    files = {path.name for path in (tmp_path / "installed" / "mixpose").rglob("*")}
    assert {"py.typed", "pose-lines.schema.json", "body.html.j2"} <= files
    environment = os.environ | {"PYTHONPATH": str(tmp_path / "installed")}
    for arguments in (["--version"], ["schema"], ["run", str(SESSION), "--stop", "1"]):
        result = subprocess.run(
            [sys.executable, "-m", "mixpose", *arguments],
            cwd=tmp_path, env=environment, capture_output=True, text=True, check=False,
        )  # fmt: skip
        assert result.returncode == 0, result.stderr
    where = subprocess.run(
        [sys.executable, "-c", "import mixpose; print(mixpose.__file__)"],
        cwd=tmp_path, env=environment, capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert where.stdout.startswith(str(tmp_path / "installed"))
