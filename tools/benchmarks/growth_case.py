"""How the cost of a tracked frame beside decoding grows with what there is to see.

Of two cameras of 1.3 megapixels, no false spots and one body of eight markers one thing changes at
a time.  Bodies have five markers each and no start.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.frames_case import FOCAL, RESOLUTION, measured
from benchmarks.recordings import DISTANCE, NAMES, session_text, simulated
from benchmarks.timing import show, slope
from mixpose.session import Session
from mixpose.simulation import SimulationOptions

FRAMES = 10
MOTION = SimulationOptions(frames=FRAMES, amplitude_translation=15.0, amplitude_rotation_deg=10.0)
SIZES: Mapping[str, Sequence[int]] = {
    "pixels": (2**18, 2**20, 2**22),
    "spots": (1, 10, 40, 160),
    "features": (8, 20, 60, 200),
    "sensors": (1, 2, 3, 4),
    "bodies": (1, 2, 4, 8),
}


def run(options: argparse.Namespace) -> dict[str, Any]:
    print("growth: processor ms of a tracked frame beside decoding, calls of Python's functions")
    figures: dict[str, Any] = {}
    for kind, sizes in SIZES.items():
        if options.rows and kind not in options.rows:
            continue
        each = []
        for size in sizes:
            with tempfile.TemporaryDirectory() as folder:
                each.append(measured(recording(Path(folder), kind, size), FRAMES))
            show(f"{size} {kind}: ms", each[-1]["tracked_ms"])
            show("extraction, ms", each[-1]["extract_ms"])
            show("calls", each[-1]["calls_of_Python"])
            show("share ok", each[-1]["share_ok"])
        ms = [one["tracked_ms"] for one in each]
        figures[kind] = {"sizes": list(sizes), "ms": ms, "slope": slope(sizes, ms)}
        show(f"slope over {kind}", figures[kind]["slope"], at_most=1.1)
    return figures


def recording(folder: Path, kind: str, size: float) -> Session:
    """A recording with one number changed."""
    scale = float(np.sqrt(size / np.prod(RESOLUTION))) if kind == "pixels" else 1.0
    sensors = int(size) if kind == "sensors" else 2
    resolution = (int(RESOLUTION[0] * scale), int(RESOLUTION[1] * scale))
    sources = [f'"{name}*.png"' for name in NAMES[:sensors]]
    rng = np.random.default_rng(int(size))
    points = None
    if kind == "features":
        points = rng.uniform(-0.15 * DISTANCE, 0.15 * DISTANCE, (int(size), 3)).tolist()
    text = session_text(sources, resolution, FOCAL * scale, points=points)
    if kind == "bodies":
        bodies = rng.uniform(-50.0, 50.0, (int(size), 5, 3)).round(1).tolist()
        objects = [
            f'[[object]]\nname = "body{k}"\npoints = {each}\n' for k, each in enumerate(bodies)
        ]
        text = 'unit = "mm"\n' + "".join(objects) + text[text.index("[[sensor]]") :]
    clutter = size if kind == "spots" else 0.0
    return simulated(folder / "recording", text, replace(MOTION, clutter=clutter))
