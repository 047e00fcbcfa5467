"""Memory of a long run: resident size after 20,000 frames less that after 1,000.

The recording is a list of images of 64x64 px that goes to and fro over a few of them, and poses are
written to a file that keeps nothing.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from benchmarks.recordings import session_text, simulated, write_session
from benchmarks.timing import show
from mixpose.simulation import SimulationOptions

EARLY, LATE = 1_000, 20_000
DIFFERENT = 40
RESOLUTION = (64, 64)
FOCAL = 170.0
MARKERS = 4


def run(_: argparse.Namespace) -> dict[str, Any]:
    print(f"memory: {LATE} frames of {RESOLUTION[0]}x{RESOLUTION[1]}")
    if not Path("/proc/self/statm").exists():
        print("  not measured: this system has no /proc")
        return {"growth_mb": None}
    with tempfile.TemporaryDirectory() as temporary:
        session = recording(Path(temporary))
        program = str(Path(__file__).with_name("long_run.py"))
        command = [sys.executable, program, str(session), str(EARLY), str(LATE)]
        result = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True)
    early, late = map(float, result.stdout.split())
    show(f"resident after {EARLY} frames, MB", early)
    show(f"resident after {LATE} frames, MB", late)
    show("growth, MB", late - early, at_most=5)
    return {"growth_mb": late - early, "resident_mb": late}


def recording(folder: Path) -> Path:
    """The session of a long recording made of few images."""
    text = session_text(['"image*.png"'], RESOLUTION, FOCAL, markers=MARKERS)
    options = SimulationOptions(
        frames=DIFFERENT, spot_sigma=1.0, amplitude_translation=5.0, amplitude_rotation_deg=5.0
    )
    short = simulated(folder / "short", text, options)
    images = sorted(os.fspath(path) for path in short.folder.glob("image*.png"))
    there_and_back = images + images[-2:0:-1]
    names = [there_and_back[k % len(there_and_back)] for k in range(LATE)]
    long = session_text([json.dumps(names)], RESOLUTION, FOCAL, markers=MARKERS)
    return write_session(folder / "long.toml", long).path
