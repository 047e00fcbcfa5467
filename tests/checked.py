"""A recording to be checked, and what `mixpose check` says of it."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from mixpose.cli.app import CheckRequest
from mixpose.cli.check import check_session

SYNTHETIC = Path(__file__).parents[1] / "data" / "synthetic"


def copied(folder: Path) -> Path:
    """The folder with eight frames of the recording of two cameras."""
    source = SYNTHETIC / "two_cameras"
    shutil.copy(source / "session.toml", folder)
    for n in range(8):
        for side in ("left", "right"):
            shutil.copy(source / f"{side}{n:04d}.png", folder)
    return folder


def report_on(session: Path, capsys: pytest.CaptureFixture[str], *, quick: bool = False) -> str:
    """What is printed."""
    check_session(CheckRequest(session, quick=quick))
    return capsys.readouterr().out
