"""What each part brings: everything on, then without one proposer, refinement or rule at a time.

python tools/ablation.py [--trials N] [--recordings FOLDER] [--only NAME ...] [--json FILE]

Numbers are differences against everything on, but for the first line; errors of rotation and
position are ratios.  "right" and "ok" count right poses, those called ok among them.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(name, "1")  # before numpy is imported: one core is measured

sys.path.insert(0, str(Path(__file__).resolve().parent))

import cv2  # noqa: E402
from ablated.cases import (  # noqa: E402
    Case,
    RememberedSearch,
    all_on,
    loose_start_case,
    outcomes,
    room_case,
    search_case,
)
from ablated.recordings import real_cases, simulated_cases, synthetic_cases  # noqa: E402
from ablated.switches import SWITCHES, Switch  # noqa: E402
from ablated.table import HEADING, RULE, Outcomes, as_json, line  # noqa: E402
from benchmarks.search_cases import rows_named  # noqa: E402

SLOW = {"3 ranges 6/0/0": 4}
"""Rows of which so many times fewer frames are tried."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--trials", type=int, default=12, help="frames with the body per row")
    parser.add_argument(
        "--recordings",
        type=Path,
        default=os.environ.get("MIXPOSE_RECORDINGS"),
        help="folder of real recordings; default: MIXPOSE_RECORDINGS",
    )
    parser.add_argument("--only", nargs="*", default=[], help="switches with these texts")
    parser.add_argument("--cases", nargs="*", default=[], help="cases with these texts")
    parser.add_argument("--json", type=Path, help="file for the figures of each case")
    options = parser.parse_args()
    cv2.setNumThreads(1)
    began = time.perf_counter()
    cases = [one for one in cases_of(options) if _is_named(one.name, options.cases)]
    switches = [one for one in SWITCHES if _is_named(one.name, options.only)]
    told = compared(cases, switches)
    print(f"\n{(time.perf_counter() - began) / 60:.1f} minutes")
    if options.json:
        options.json.write_text(json.dumps(told, indent=1) + "\n", encoding="utf-8")


def _is_named(name: str, texts: list[str]) -> bool:
    return not texts or any(text in name for text in texts)


def cases_of(options: argparse.Namespace) -> list[Case]:
    """All cases: first frames, and recordings that are tracked."""
    cases = []
    for row in rows_named([]):
        cases.append(search_case(row, max(options.trials // SLOW.get(row.name, 1), 2)))
    cases.append(loose_start_case(options.trials))
    cases.append(room_case(options.trials))
    cases += synthetic_cases()
    with tempfile.TemporaryDirectory() as folder:
        cases += simulated_cases(Path(folder))
    if options.recordings:
        cases += real_cases(options.recordings)
    return cases


def compared(cases: list[Case], switches: list[Switch]) -> dict[str, Any]:
    """Print the table and return its figures."""
    memory = RememberedSearch()
    single = [case.name for case in cases if case.single_frames]
    frames = {case.name: sum(len(one.frames) for one in case.recordings) for case in cases}
    first = sum(count for name, count in frames.items() if name in single)
    print(f"{first} single frames, {sum(frames.values()) - first} tracked:")
    print(", ".join(f"{name} ({count})" for name, count in frames.items()), end="\n\n")

    def tried(switch: Switch) -> Outcomes:
        return {case.name: outcomes(case, switch.change, memory) for case in cases}

    print(f"{HEADING}\n{RULE}")
    base = tried(Switch("all on", all_on))
    print(line("(all on)", base, base, single), flush=True)
    told = {"all on": as_json(base)}
    for switch in switches:
        found = tried(switch)
        told[switch.name] = as_json(found)
        print(line(switch.name, found, base, single), flush=True)
    return told


if __name__ == "__main__":
    main()
