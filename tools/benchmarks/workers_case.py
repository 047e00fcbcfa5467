"""Four recordings with two workers against one, by the command line."""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from benchmarks.recordings import session_text, simulated, write_session
from benchmarks.timing import medians, show
from mixpose.simulation import SimulationOptions

RECORDINGS = 4
DIFFERENT = 20
FRAMES = 120
RESOLUTION = (1280, 1024)
FOCAL = 900.0
MOTION = SimulationOptions(frames=FRAMES, amplitude_translation=30.0, amplitude_rotation_deg=10.0)


def run(_: argparse.Namespace) -> dict[str, Any]:
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        images = measured("images", image_sessions(folder), folder)
        tables = measured("tables", table_sessions(folder), folder)
    show("speed with two workers / with one, images", images["ratio"], at_least=1.7)
    # reading a table leaves the second processor idle, decoding images ahead does not
    show("the same for tables of detections", tables["ratio"])
    return {**images, **{f"tables_{key}": value for key, value in tables.items()}}


def measured(name: str, sessions: Sequence[Path], folder: Path) -> dict[str, float]:
    tasks = {
        f"{workers}": partial(run_all, sessions, folder / f"{name} by {workers}", workers)
        for workers in (1, 2)
    }
    seconds = medians(tasks, rounds=2, warm_up=0)
    print(f"workers: {len(sessions)} recordings of {FRAMES} frames of one camera, {name}")
    show("one worker, s", seconds["1"])
    show("two workers, s", seconds["2"])
    return {
        "ratio": seconds["1"] / seconds["2"],
        "one_s": seconds["1"],
        "two_s": seconds["2"],
    }


def image_sessions(folder: Path) -> list[Path]:
    """Sessions that each go to and fro over the same few images."""
    text = session_text(['"image*.png"'], RESOLUTION, FOCAL)
    short = simulated(folder / "images", text, replace(MOTION, frames=DIFFERENT))
    images = sorted(str(path) for path in short.folder.glob("image*.png"))
    there_and_back = images + images[-2:0:-1]
    names = [there_and_back[k % len(there_and_back)] for k in range(FRAMES)]
    return sessions_of(folder, "images", session_text([json.dumps(names)], RESOLUTION, FOCAL))


def table_sessions(folder: Path) -> list[Path]:
    """Sessions that read the same table of unlabelled detections."""
    text = session_text(['"table.csv"'], RESOLUTION, FOCAL)
    simulated(folder / "tables", text, replace(MOTION, frames=FRAMES))
    return sessions_of(folder, "tables", session_text(['"tables/table.csv"'], RESOLUTION, FOCAL))


def sessions_of(folder: Path, name: str, text: str) -> list[Path]:
    return [write_session(folder / f"{name}{k}.toml", text).path for k in range(RECORDINGS)]


def run_all(sessions: Sequence[Path], output: Path, workers: int) -> None:
    command = [sys.executable, "-m", "mixpose", "run", *map(str, sessions)]
    command += ["--workers", str(workers), "-o", str(output)]
    subprocess.run(command, check=True, capture_output=True)
