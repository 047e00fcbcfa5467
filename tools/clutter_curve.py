"""How many first poses are right, against markers that are added and removed, from nothing.

python tools/clutter_curve.py [--frames 40] [--markers 10] [--seed 0] [--workers 2]

A body of markers at random, anywhere before cameras all around; some of its markers are gone for
all cameras, and false ones are in space, up to so many for each true one, where all cameras see
them.  Each frame has a body, a place and false markers of its own, and nothing is told of them.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections import Counter
from multiprocessing import get_context
from pathlib import Path
from typing import NamedTuple, TypeAlias

for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(name, "1")  # before numpy is imported

sys.path.insert(0, str(Path(__file__).resolve().parent))

import cv2  # noqa: E402
import numpy as np  # noqa: E402
from numpy.typing import NDArray  # noqa: E402
from scipy.spatial.transform import Rotation  # noqa: E402
from several_bodies import NOISE_PX, camera_at, is_right, random_body  # noqa: E402

from mixpose.body import Body, PointFeature  # noqa: E402
from mixpose.density import Observation  # noqa: E402
from mixpose.objective import View  # noqa: E402
from mixpose.records import PointPattern  # noqa: E402
from mixpose.rigid import from_parts, transform  # noqa: E402
from mixpose.tracking import estimate_pose  # noqa: E402

Floats: TypeAlias = NDArray[np.float64]

CAMERAS, FALSE, GONE = (2, 4, 8), (0, 1, 2, 3, 5), (0.0, 0.25, 0.5)
AWAY_MM, ROOM_MM, SIGMA_PX = 1500.0, 250.0, 1.5


class Cell(NamedTuple):
    """What the frames of one place in the table have in common."""

    cameras: int
    false: int  # markers in space for each true one
    gone: float  # share of the true ones that no camera sees
    markers: int


def frame_of(cell: Cell, seed: int) -> tuple[list[View], Body, Floats]:
    """Views, the body, and its pose."""
    rng = np.random.default_rng([seed, cell.cameras, cell.false, round(100 * cell.gone)])
    points = random_body(rng, cell.markers)
    T = from_parts(Rotation.random(rng=rng).as_matrix(), rng.uniform(-ROOM_MM / 2, ROOM_MM / 2, 3))
    shown = rng.permutation(transform(T, points))[round(cell.gone * cell.markers) :]
    false = rng.uniform(-ROOM_MM, ROOM_MM, (cell.false * cell.markers, 3))
    views = []
    for k in range(cell.cameras):
        angle = 360.0 / max(cell.cameras, 4) * k + 20.0
        camera = camera_at(angle, 15.0 if k % 2 else -20.0, AWAY_MM)
        y, seen = camera.project(np.concatenate([shown, false]))
        y = rng.permutation(y[seen] + NOISE_PX * rng.standard_normal((int(seen.sum()), 2)))
        pattern = PointPattern(y, np.ones(len(y)))
        views.append(View(f"camera {k}", camera, Observation(pattern, SIGMA_PX)))
    return views, Body("body", tuple(PointFeature(one) for one in points)), T


def outcome(case: tuple[Cell, int]) -> tuple[Cell, str, bool]:
    """The status of one frame, and whether its pose is right."""
    cv2.setNumThreads(1)
    views, body, T = frame_of(*case)
    found = estimate_pose(views, body)
    return case[0], found.status, is_right(found, T, body.symmetries)


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--frames", type=int, default=40, help="of each cell")
    parser.add_argument("--markers", type=int, default=10)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=2)
    chosen = parser.parse_args()
    cells = [
        Cell(cameras, false, gone, chosen.markers)
        for cameras in CAMERAS
        for gone in GONE
        for false in FALSE
    ]
    cases = [(cell, chosen.seed + k) for cell in cells for k in range(chosen.frames)]
    tally: Counter[tuple[Cell, str]] = Counter()
    with get_context("spawn").Pool(chosen.workers) as pool:
        for cell, status, right in pool.imap_unordered(outcome, cases, chunksize=4):
            tally[cell, "right"] += right
            tally[cell, "ok"] += right and status == "ok"
            tally[cell, "wrong"] += status == "ok" and not right
    print(f"first pose right, and ok, % of {chosen.frames} frames; columns: false per true marker")
    print("| cameras | hidden | " + " | ".join(map(str, FALSE)) + " |")
    print("| --- | --- |" + " --- |" * len(FALSE))
    for cameras in CAMERAS:
        for gone in GONE:
            row = [Cell(cameras, false, gone, chosen.markers) for false in FALSE]
            shares = [
                f"{100 * tally[one, 'right'] / chosen.frames:.0f}, "
                f"{100 * tally[one, 'ok'] / chosen.frames:.0f}"
                for one in row
            ]
            print(f"| {cameras} | {100 * gone:.0f} % | " + " | ".join(shares) + " |")
    wrong = sum(tally[cell, "wrong"] for cell in cells)
    print(f"wrong and ok: {wrong} of {len(cases)}")
    return int(wrong > 0)


if __name__ == "__main__":
    sys.exit(main())
