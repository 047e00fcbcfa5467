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

_MEASURE = """
import os, sys
from pathlib import Path
from mixpose.cli.output import Output
from mixpose.cli.run import header_of
from mixpose.runner import run
from mixpose.session import load_session

def resident():
    fields = Path("/proc/self/statm").read_text().split()
    return int(fields[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6

session = load_session(sys.argv[1])
sizes = {}
with Output(Path(os.devnull), "jsonl", header_of(session), append=False) as output:
    for count, estimate in enumerate(run(session), 1):
        output.write(estimate)
        if str(count) in sys.argv[2:]:
            sizes[count] = resident()
print(sizes[int(sys.argv[2])], sizes[int(sys.argv[3])], estimate.status)
"""


def run(_: argparse.Namespace) -> dict[str, Any]:
    print(f"memory: {LATE} frames of {RESOLUTION[0]}x{RESOLUTION[1]}")
    if not Path("/proc/self/statm").exists():
        print("  not measured: this system has no /proc")
        return {"growth_mb": None}
    with tempfile.TemporaryDirectory() as temporary:
        session = recording(Path(temporary))
        command = [sys.executable, "-c", _MEASURE, str(session), str(EARLY), str(LATE)]
        result = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True)
    early, late = map(float, result.stdout.split()[:2])
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
