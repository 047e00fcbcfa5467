"""Whether a wrong pose is ever believed among clutter in space, over thousands of frames.

python tools/clutter_study.py FOUND.jsonl [--frames 3000]

Scenes of `tools/benchmarks/space_clutter.py` in turn, a third of the frames without the body.  A
line per frame is written as soon as it is done; started again with the same file, it goes on.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections import Counter
from pathlib import Path
from typing import Any

for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(name, "1")  # before numpy is imported

sys.path.insert(0, str(Path(__file__).resolve().parent))

import cv2  # noqa: E402
from benchmarks.search_cases import is_right  # noqa: E402
from benchmarks.search_rows import FRESH  # noqa: E402
from benchmarks.space_clutter import SCENES, Scene, scene_trial  # noqa: E402

from mixpose.fit import EstimatorOptions  # noqa: E402
from mixpose.tracking import Tracker  # noqa: E402

TOLD_EVERY = 100  # frames


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("found", type=Path, help="file with a line per frame")
    parser.add_argument("--frames", type=int, default=3000)
    options = parser.parse_args()
    cv2.setNumThreads(1)
    lines = options.found.read_text().splitlines() if options.found.exists() else []
    found = [json.loads(line) for line in lines]
    with options.found.open("a", encoding="utf-8") as file:
        for k in range(len(found), options.frames):
            found.append(outcome(k))
            file.write(json.dumps(found[-1]) + "\n")
            file.flush()
            if found[-1]["status"] == "ok" and not found[-1]["right"]:
                print(f"wrong: {found[-1]}", flush=True)
            if len(found) % TOLD_EVERY == 0:
                print(summary(found), flush=True)
    for scene in SCENES:
        print(scene.name + ": " + summary([one for one in found if one["scene"] == scene.name]))
    print(summary(found))


def outcome(k: int) -> dict[str, Any]:
    """What the estimator says of frame k; of each scene, every third is without the body."""
    turn, which = divmod(k, len(SCENES))
    scene, present = SCENES[which], turn % 3 != 2
    seed = turn - turn // 3 if present else FRESH + turn // 3
    frame = scene_trial(scene, seed, present=present)
    tracker = Tracker.create(frame.body, EstimatorOptions())
    _, estimate = tracker.advance(tracker.begin(), 0, None, frame.views)
    T = estimate.T_world_object
    right = present and T is not None and is_right(T, frame)
    told = {"scene": scene.name, "seed": seed, "present": present, "full": _is_full(scene)}
    return told | {"status": estimate.status, "right": right, "doubt": estimate.doubt}


def _is_full(scene: Scene) -> bool:
    """Whether several cameras have the body in full view, and no congruent triple is beside it."""
    return not scene.blind and scene.sensors != "1 pinhole" and scene.other != "triple"


def summary(found: list[dict[str, Any]]) -> str:
    """Counts over frames."""
    there = [one for one in found if one["present"]]
    full = [one for one in there if one["full"]]
    states = Counter(one["status"] for one in there)
    wrong = sum(one["status"] == "ok" and not one["right"] for one in found)
    absent = sum(one["status"] == "lost" for one in found) - states["lost"]
    parts = [f"{len(found)} frames: {wrong} wrong ok", f"{dict(states)} of {len(there)} with body"]
    parts.append(f"{absent} of {len(found) - len(there)} without it lost")
    if full:
        sure = sum(one["status"] == "ok" and one["right"] for one in full)
        parts.append(f"in full view ok and right {sure / len(full):.1%} of {len(full)}")
    return "; ".join(parts)


if __name__ == "__main__":
    main()
