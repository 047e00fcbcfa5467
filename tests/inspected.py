"""What `mixpose inspect` says about one frame of a recording that a test may spoil."""

from __future__ import annotations

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

import mixpose
from mixpose.cli import main
from mixpose.frames import pair
from mixpose.pictures.advice import describe
from mixpose.pictures.finding import find
from mixpose.records import Estimate, Status
from mixpose.runner import observe, open_sources, run
from mixpose.selection import Selection

SYNTHETIC = Path(__file__).parents[1] / "data" / "synthetic"
TWO_CAMERAS = SYNTHETIC / "two_cameras" / "session.toml"
FRAME = 6  # which shows all markers to both cameras


def command(*arguments: str | Path | float) -> int:
    """The exit status of a command of `mixpose`."""
    with pytest.raises(SystemExit) as leaving:
        main([str(argument) for argument in arguments])
    return int(str(leaving.value.code))


def estimated_pose() -> NDArray[np.float64]:
    """Where the body is in that frame."""
    session = mixpose.load_session(TWO_CAMERAS)
    (estimate,) = run(session, selection=Selection(FRAME, FRAME + 1))
    assert estimate.T_world_object is not None
    return estimate.T_world_object


def copied(folder: Path) -> Path:
    """One frame of two cameras, in a new folder."""
    folder.mkdir()
    shutil.copy(TWO_CAMERAS, folder)
    for side in ("left", "right"):
        shutil.copy(TWO_CAMERAS.with_name(f"{side}{FRAME:04d}.png"), folder)
    return folder


def left_image(recording: Path) -> NDArray[np.uint8]:
    image = cv2.imread(str(recording / f"left{FRAME:04d}.png"), cv2.IMREAD_GRAYSCALE)
    assert image is not None
    return np.asarray(image, dtype=np.uint8)


def write_left(recording: Path, image: NDArray[np.uint8] | NDArray[np.float32]) -> None:
    cv2.imwrite(str(recording / f"left{FRAME:04d}.png"), image)


def with_options(recording: Path, lines: str) -> Path:
    session = recording / "session.toml"
    text = session.read_text(encoding="utf-8")
    assert 'method = "blobs"\n' in text
    session.write_text(text.replace('method = "blobs"\n', lines + "\n"), encoding="utf-8")
    return session


def advice_for(
    session_file: Path, frame: int, truth: NDArray[np.float64] | None, status: Status = "ok"
) -> str:
    """What is said about the first sensor of a frame with a known pose, or a lost one."""
    session = mixpose.load_session(session_file)
    frame_set = next(pair(open_sources(session, {}), frame, frame + 1))
    status = "lost" if truth is None else status
    estimate = Estimate(frame, None, "tracker", status, truth, None, 1.0, {})
    views = observe(session, frame_set)
    findings = find(session.sensors, frame_set.frames, views, session.body, estimate)
    return "\n".join(describe(findings[0], session.body, session.unit))
