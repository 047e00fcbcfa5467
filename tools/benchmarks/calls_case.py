"""What Python does in a tracked frame of two cameras: calls, changes of file, kinds of record.

Time hangs on the machine, these do not.  A change of file is a call from one file of mixpose into
another; a record is a dataclass or named tuple of mixpose that is made.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from types import FrameType
from typing import Any

import mixpose
from benchmarks.pose_case import advance, trial
from benchmarks.timing import show

SOURCE = str(Path(mixpose.__file__).parent)
TRIALS = 12


class Counts:
    """Calls that `sys.setprofile` reports."""

    def __init__(self) -> None:
        self.calls, self.changes = 0, 0
        self.records: set[str] = set()

    def __call__(self, frame: FrameType, event: str, _: object) -> None:
        if event != "call":
            return
        self.calls += 1
        code, caller = frame.f_code, frame.f_back
        if code.co_filename == "<string>":
            made = frame.f_locals.get("self", frame.f_locals.get("_cls"))
            kind = made if isinstance(made, type) else type(made)
            if kind.__module__.startswith("mixpose"):
                self.records.add(kind.__qualname__)
        elif code.co_filename.startswith(SOURCE) and caller is not None:
            while caller is not None and not caller.f_code.co_filename.startswith(SOURCE):
                caller = caller.f_back
            self.changes += caller is not None and caller.f_code.co_filename != code.co_filename


def run(_: argparse.Namespace) -> dict[str, Any]:
    counted = []
    for seed in range(TRIALS):
        task = advance(trial(seed))
        task()  # what is made once for a scene
        counts = Counts()
        sys.setprofile(counts)
        try:
            task()
        finally:
            sys.setprofile(None)
        counted.append(counts)
    middle = TRIALS // 2
    figures: dict[str, Any] = {
        "calls_per_frame": sorted(one.calls for one in counted)[middle],
        "file_changes_per_frame": sorted(one.changes for one in counted)[middle],
        "kinds_of_record": sorted(len(one.records) for one in counted)[middle],
        "records": sorted(set().union(*(one.records for one in counted))),
    }
    print("calls: a tracked frame of two cameras, six markers, detections given")
    show("Python calls", figures["calls_per_frame"], at_most=1000)
    show("changes of file", figures["file_changes_per_frame"], at_most=100)
    show("kinds of record", figures["kinds_of_record"], at_most=15)
    return figures
