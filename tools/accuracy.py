"""How accurate mixpose is on recordings like those of data/synthetic/, over many seeds.

python tools/accuracy.py [RECORDING ...] [--seeds 16] [--workers 2] [--smooth] [--json FILE]

Each recording of tools/make_synthetic.py is made again with other motions, noise, clutter and
hidden markers, estimated from its frames, and compared with its truth.  For each figure the median
over the seeds is shown, and the worst: the largest error, the smallest share.  With --smooth, a
second line says the same of the smoothed poses, with errors by those of the same seed before.
"""

from __future__ import annotations

import argparse
import io
import json
import sys
import tempfile
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import redirect_stderr
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from make_synthetic import RECORDINGS

import mixpose
from mixpose.cli.app import SmoothRequest
from mixpose.cli.run import header_of
from mixpose.cli.smooth import smooth_poses
from mixpose.poses.evaluate import evaluate_files
from mixpose.poses.jsonl import JsonlWriter
from mixpose.simulation import simulate

FIRST_SEED = 1000  # of none of the recordings in data/synthetic/


@dataclass(frozen=True)
class Figures:
    """What a run on one recording comes to, as `mixpose evaluate` says it.

    Attributes
    ----------
    rotation_deg, position : float
        RMS errors over the frames with a pose, degrees and length units; NaN without any.
    ok : float
        Share of frames that are "ok".
    inside_95 : float
        Share of the ok frames whose truth lies inside the 95 % ellipsoid; NaN without any.
    squared : float
        Squared error of the ok frames in standard deviations, per dimension: 1 if right.
    """

    rotation_deg: float
    position: float
    ok: float
    inside_95: float
    squared: float


SHARES = ("ok", "inside_95")  # what is worse where it is smaller


def figures_of(name: str, seed: int, smooth: bool = False) -> list[Figures]:
    """Make a recording with a seed, estimate it and compare it with its truth; smoothed as well."""
    with tempfile.TemporaryDirectory() as scratch:
        folder, draft = Path(scratch) / name, Path(scratch) / "session.toml"
        draft.write_text(RECORDINGS[name].session, encoding="utf-8", newline="\n")
        simulate(mixpose.load_session(draft), folder, replace(RECORDINGS[name].options, seed=seed))
        session = mixpose.load_session(folder / "session.toml")
        poses, smoothed = folder / "poses.jsonl", folder / "smooth.jsonl"
        with poses.open("w", encoding="utf-8") as stream:
            writer = JsonlWriter(stream, header_of(session))
            for estimate in mixpose.run(session):
                writer.write(estimate)
        before = compared(poses, folder / "truth.jsonl")
        if not smooth:
            return [before]
        with redirect_stderr(io.StringIO()):
            smooth_poses(SmoothRequest(poses, smoothed))
        after = compared(smoothed, folder / "truth.jsonl")
    rotation, position = after.rotation_deg / before.rotation_deg, after.position / before.position
    return [before, replace(after, rotation_deg=rotation, position=position)]


def compared(poses: Path, truth: Path) -> Figures:
    """What a file of poses comes to."""
    found, nan = evaluate_files(poses, truth), float("nan")
    return Figures(
        rotation_deg=found.rotation_deg.rms if found.rotation_deg else nan,
        position=found.translation.rms if found.translation else nan,
        ok=found.ok / found.frames,
        inside_95=found.nees.inside_95 if found.nees else nan,
        squared=found.nees.mean_per_dimension if found.nees else nan,
    )


def summary(seeds: Sequence[Figures]) -> dict[str, dict[str, float]]:
    """Median and worst of each figure; a seed without a value is the worst."""
    table = {}
    for key in asdict(seeds[0]):
        worst = min if key in SHARES else max
        nothing = 0.0 if key in SHARES else np.inf
        values = [getattr(each, key) for each in seeds]
        values = [nothing if np.isnan(value) else value for value in values]
        table[key] = {"median": float(np.median(values)), "worst": float(worst(values))}
    return table


def line_of(name: str, table: Mapping[str, Mapping[str, float]]) -> str:
    """One recording's line: median and worst of each figure."""
    formats = {"ok": "7.1%", "inside_95": "7.1%", "squared": "7.2f"}
    cells = [
        " ".join(format(table[key][kind], formats.get(key, "7.2g")) for kind in ("median", "worst"))
        for key in table
    ]
    return f"{name:28} " + " ".join(f"{cell:>16}" for cell in cells)


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("recordings", nargs="*", metavar="RECORDING", help=", ".join(RECORDINGS))
    parser.add_argument("--seeds", type=int, default=16, help="recordings of each kind")
    parser.add_argument("--workers", type=int, default=2, help="processes at a time")
    parser.add_argument("--smooth", action="store_true", help="smooth the poses as well")
    parser.add_argument("--json", type=Path, help="file for the figures")
    options = parser.parse_args()
    unknown = set(options.recordings) - set(RECORDINGS)
    if unknown:
        parser.error(f"no such recording: {sorted(unknown)[0]}; allowed: {', '.join(RECORDINGS)}")
    if min(options.seeds, options.workers) < 1:
        parser.error("--seeds and --workers: allowed are whole numbers from 1")
    titles = ("rotation, deg", "position, mm", "ok", "inside 95 %", "squared error")
    print(
        f"RMS errors, shares, squared error per dimension; median and worst, {options.seeds} seeds"
    )
    print(f"{'recording':28} " + " ".join(f"{title:>16}" for title in titles))
    stored: dict[str, Any] = {}
    seeds = range(FIRST_SEED, FIRST_SEED + options.seeds)
    with ProcessPoolExecutor(options.workers) as pool:
        for name in options.recordings or RECORDINGS:
            of_seeds = list(pool.map(partial(figures_of, name, smooth=options.smooth), seeds))
            for label, found in zip((name, f"{name}, smoothed"), zip(*of_seeds)):
                stored[label] = {**summary(found), "seeds": [asdict(each) for each in found]}
                print(line_of(label, summary(found)), flush=True)
    if options.json:
        options.json.write_text(json.dumps(stored, indent=1) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
