"""A recording to be checked, and what `mixpose check` says of it."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from mixpose.cli.app import CheckRequest
from mixpose.cli.check import check_session
from mixpose.session import Session, load_session

SYNTHETIC = Path(__file__).parents[1] / "data" / "synthetic"


def copied(folder: Path) -> Path:
    """The folder with eight frames of the recording of two cameras."""
    source = SYNTHETIC / "two_cameras"
    shutil.copy(source / "session.toml", folder)
    for n in range(8):
        for side in ("left", "right"):
            shutil.copy(source / f"{side}{n:04d}.png", folder)
    return folder


def counted(folder: Path, count: int) -> Session:
    """The session of two cameras with so many of its body."""
    path, text = folder / "s.toml", (SYNTHETIC / "two_cameras" / "session.toml").read_text("utf-8")
    path.write_text(text.replace("[object]", f"[object]\ncount = {count}"), encoding="utf-8")
    return load_session(path)


def report_on(session: Path, capsys: pytest.CaptureFixture[str], *, quick: bool = False) -> str:
    """What is printed."""
    check_session(CheckRequest(session, quick=quick))
    return capsys.readouterr().out
