"""Four recordings with two workers against one, by the command line."""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from collections.abc import Sequence
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


def run(_: argparse.Namespace) -> dict[str, Any]:
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        sessions = recordings(folder)
        tasks = {
            f"{workers}": partial(run_all, sessions, folder / f"poses {workers}", workers)
            for workers in (1, 2)
        }
        seconds = medians(tasks, rounds=2, warm_up=0)
    ratio = seconds["1"] / seconds["2"]
    print(f"workers: {RECORDINGS} recordings of {FRAMES} images of one camera")
    show("one worker, s", seconds["1"])
    show("two workers, s", seconds["2"])
    show("speed with two workers / with one", ratio, at_least=1.7)
    return {"ratio": ratio, "one_s": seconds["1"], "two_s": seconds["2"]}


def recordings(folder: Path) -> list[Path]:
    """Sessions that each go to and fro over the same images."""
    text = session_text(['"image*.png"'], RESOLUTION, FOCAL)
    options = SimulationOptions(
        frames=DIFFERENT, amplitude_translation=30.0, amplitude_rotation_deg=10.0
    )
    short = simulated(folder / "short", text, options)
    images = sorted(str(path) for path in short.folder.glob("image*.png"))
    there_and_back = images + images[-2:0:-1]
    names = [there_and_back[k % len(there_and_back)] for k in range(FRAMES)]
    long = session_text([json.dumps(names)], RESOLUTION, FOCAL)
    return [write_session(folder / f"recording{k}.toml", long).path for k in range(RECORDINGS)]


def run_all(sessions: Sequence[Path], output: Path, workers: int) -> None:
    command = [sys.executable, "-m", "mixpose", "run", *map(str, sessions)]
    command += ["--workers", str(workers), "-o", str(output)]
    subprocess.run(command, check=True, capture_output=True)
