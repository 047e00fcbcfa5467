"""Measure mixpose: how fast, and how often right.

python tools/benchmark.py [CASE ...] [--trials N] [--json FILE]
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(name, "1")  # before numpy is imported: one core is measured

sys.path.insert(0, str(Path(__file__).resolve().parent))

import cv2  # noqa: E402
import numpy as np  # noqa: E402
from benchmarks import (  # noqa: E402
    calls_case,
    frames_case,
    growth_case,
    live_case,
    many_case,
    memory_case,
    objective_case,
    pose_case,
    scaling_case,
    search_rows,
    startup_case,
    stream_case,
    workers_case,
)

CASES: dict[str, Callable[[argparse.Namespace], dict[str, Any]]] = {
    "frames": frames_case.run,
    "growth": growth_case.run,
    "objective": objective_case.run,
    "pose": pose_case.run,
    "calls": calls_case.run,
    "stream": stream_case.run,
    "live": live_case.run,
    "search": search_rows.run,
    "scaling": scaling_case.run,
    "many": many_case.run,
    "memory": memory_case.run,
    "workers": workers_case.run,
    "startup": startup_case.run,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("cases", nargs="*", metavar="CASE", help=", ".join(CASES))
    parser.add_argument("--trials", type=int, default=200, help="random frames per row")
    parser.add_argument(
        "--rows", nargs="*", default=[], help="frames, search: only rows with these texts"
    )
    parser.add_argument("--json", type=Path, help="file for the figures")
    options = parser.parse_args()
    unknown = set(options.cases) - set(CASES)
    if unknown:
        parser.error(f"no such case: {', '.join(sorted(unknown))}; allowed: {', '.join(CASES)}")
    cv2.setNumThreads(1)
    figures: dict[str, Any] = {"machine": machine()}
    for case in options.cases or CASES:
        figures[case] = CASES[case](options)
    if options.json:
        options.json.write_text(json.dumps(figures, indent=1) + "\n", encoding="utf-8")


def machine() -> dict[str, Any]:
    return {
        "processor": platform.processor() or platform.machine(),
        "cores": os.cpu_count(),
        "load": list(os.getloadavg()) if hasattr(os, "getloadavg") else None,
        "python": platform.python_version(),
        "numpy": np.__version__,
        "opencv": cv2.__version__,
    }


if __name__ == "__main__":
    main()
