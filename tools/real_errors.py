"""How mixpose bears errors that are no independent noise: cut and merged spots, bad calibrations.

python tools/real_errors.py [CASE ...] [--seeds 5] [--workers 2] [--json FILE]

Recordings are made by `mixpose simulate`; then an arm is painted over their images, or the session
is changed so that it no longer tells the truth (`tools/rigs/`).  Beside the errors of mixpose stand
those of robust least squares (`scipy.optimize.least_squares`, soft_l1) on the same detections, told
which detection is whose by the true pose, or those of the same recording without the fault; then
whether the covariance holds, and how many poses of the same scene without its body are ok.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray
from rigs.cases import CASES, Case
from scipy.optimize import least_squares

import mixpose
from mixpose.body import Body
from mixpose.objective import View, project_body
from mixpose.poses.consistency import normalised_error_squared
from mixpose.poses.jsonl import read_poses
from mixpose.records import Estimate, FrameSet, PointPattern
from mixpose.rigid import perturb, rotation_angle_deg, twist_between
from mixpose.simulation import simulate

Floats: TypeAlias = NDArray[np.float64]

INSIDE_95 = 12.592  # χ² of six
WRONG = 20.0  # standard deviations of a dimension, and
WRONG_DEG, WRONG_MM = 3.0, 15.0  # from which a pose called ok is a wrong one
KNOWN_PX, SCALE_PX = 8.0, 0.05  # how far a detection may be off, and what is much for the oracle
WITHOUT = 12  # frames of the scene without its body


@dataclass(frozen=True)
class Figures:
    """RMS errors in degrees and length units of mixpose and of the oracle, and the covariance.

    `wrong` poses are ok and far off, or of a body that is away; `absent` ones are ok in a scene
    that never had one.
    """

    rotation_deg: float
    position: float
    oracle_deg: float
    oracle_position: float
    squared: float
    inside: float
    ok: float
    wrong: int
    absent: int = 0


def figures_of(name: str, seed: int) -> Figures:
    """Make a recording with a seed, estimate it, and compare."""
    case = CASES[name]
    with tempfile.TemporaryDirectory() as scratch:
        found = _compared(_recorded(case, seed, Path(scratch) / "own"), case)
        if case.against is not None:
            plain = CASES[case.against]
            other = _compared(_recorded(plain, seed, Path(scratch) / "plain"), plain)
            found = replace(found, oracle_deg=other.rotation_deg, oracle_position=other.position)
        options = replace(case.options, frames=WITHOUT, away_from=0)
        empty = _recorded(replace(case, options=options), seed, Path(scratch) / "empty")
        session = mixpose.load_session(empty / "session.toml")
        return replace(found, absent=sum(one.status == "ok" for one in mixpose.run(session)))


def _recorded(case: Case, seed: int, folder: Path) -> Path:
    folder.mkdir()
    draft, made = folder / "draft.toml", folder / "made"
    draft.write_text(case.session(), encoding="utf-8")
    simulate(mixpose.load_session(draft), made, replace(case.options, seed=seed))
    if case.change:
        case.change(made, seed)
    return made


def _compared(folder: Path, case: Case) -> Figures:
    session = mixpose.load_session(folder / "session.toml")
    truth = {one.frame: one.T_world_object for one in read_poses(folder / "truth.jsonl").poses}
    # the oracle does not know of moments
    oracle = case.against is None and not any(one.readout or one.delay for one in session.sensors)
    rows: list[tuple[float, ...]] = []
    count = phantoms = 0

    def watch(frames: FrameSet, views: Sequence[View], estimate: Estimate) -> None:
        nonlocal count, phantoms
        T_true, T = truth.get(estimate.frame), estimate.T_world_object
        count += T_true is not None
        if estimate.status != "ok" or T is None:
            return
        if T_true is None:
            phantoms += 1
            return
        assert estimate.covariance is not None
        total, dimensions = normalised_error_squared(twist_between(T_true, T), estimate.covariance)
        known = (np.nan, np.nan)
        if oracle:
            known = _errors(robust_least_squares(views, session.body, T_true), T_true)
        rows.append((*_errors(T, T_true), *known, total or np.inf, dimensions))

    for _ in mixpose.run(session, watch=watch):
        pass
    found = np.array(rows).reshape(-1, 6)
    rms = np.sqrt((found[:, :4] ** 2).mean(axis=0)) if len(found) else np.full(4, np.nan)
    off = (found[:, 0] > WRONG_DEG) | (found[:, 1] > WRONG_MM)
    return Figures(
        rotation_deg=float(rms[0]),
        position=float(rms[1]),
        oracle_deg=float(rms[2]),
        oracle_position=float(rms[3]),
        squared=float((found[:, 4] / found[:, 5]).mean()),
        inside=float((found[:, 4] <= INSIDE_95).mean()),
        ok=len(found) / count,
        wrong=int((off & (found[:, 4] > WRONG**2)).sum()) + phantoms,
    )


def _errors(T: Floats, T_true: Floats) -> tuple[float, float]:
    shift = float(np.linalg.norm(T[:3, 3] - T_true[:3, 3]))
    return float(rotation_angle_deg(T, T_true)), shift


def robust_least_squares(views: Sequence[View], body: Body, T_true: Floats) -> Floats:
    """The pose (4, 4) by robust least squares, where it is known which detection is whose."""
    pairs = []
    for view in views:
        pattern = view.observation.pattern
        assert isinstance(pattern, PointPattern)
        projection = project_body((view.sensor,), body)
        at = projection.project(T_true[None])
        if not len(pattern.points):
            continue
        apart = np.linalg.norm(pattern.points - at.y[0, 0, :, None], axis=2)
        nearest = apart.argmin(axis=1)
        mine = at.seen[0, 0] & (apart.min(axis=1) < KNOWN_PX)
        mine &= apart[:, nearest].argmin(axis=0) == np.arange(len(mine))
        pairs.append((projection, mine, pattern.points[nearest[mine]]))

    def residuals(twist: Floats) -> Floats:
        T = perturb(T_true, twist * np.repeat([1.0, 0.01], 3))
        return np.concatenate([(p.project(T[None]).y[0, 0, i] - y).ravel() for p, i, y in pairs])

    found = least_squares(residuals, np.zeros(6), loss="soft_l1", f_scale=SCALE_PX, xtol=1e-12)
    return perturb(T_true, found.x * np.repeat([1.0, 0.01], 3))


def line_of(name: str, found: Sequence[Figures]) -> str:
    """One case's line: medians over the seeds, and the worst of each figure in brackets."""
    column = {key: np.array([getattr(one, key) for one in found]) for key in asdict(found[0])}
    ratio = np.maximum(
        column["rotation_deg"] / column["oracle_deg"],
        column["position"] / column["oracle_position"],
    )
    cells = [f"{np.median(column[key]):.4f}" for key in list(column)[:4]]
    cells.append(f"{np.median(ratio):.2f} ({ratio.max():.2f})")
    squared, inside = column["squared"], column["inside"]
    cells.append(f"{np.median(squared):.2f} ({squared.min():.2f}-{squared.max():.2f})")
    cells.append(f"{np.median(inside):.0%} ({inside.min():.0%})")
    counts = [int(column[key].sum()) for key in ("wrong", "absent")]
    cells.append(f"{column['ok'].mean():.0%}, {counts[0]}, {counts[1]}")
    return f"| {name} | " + " | ".join(cells) + " |"


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("cases", nargs="*", metavar="CASE", help=", ".join(CASES))
    parser.add_argument("--seeds", type=int, default=5, help="recordings of each kind")
    parser.add_argument("--workers", type=int, default=2, help="processes at a time")
    parser.add_argument("--json", type=Path, help="file for the figures")
    options = parser.parse_args()
    unknown = set(options.cases) - set(CASES)
    if unknown:
        parser.error(f"no such case: {sorted(unknown)[0]!r}; allowed: {', '.join(CASES)}")
    titles = ("recording", "deg", "mm", "oracle, deg", "mm", "ratio (worst)", "squared error")
    print("| " + " | ".join((*titles, "inside 95 %", "ok, wrong, without")) + " |")
    print("| --- " * (len(titles) + 2) + "|")
    stored: dict[str, Any] = {}
    with ProcessPoolExecutor(options.workers) as pool:
        for name in options.cases or CASES:
            seeds = range(options.seeds)
            found = list(pool.map(figures_of, [name] * options.seeds, seeds))
            stored[name] = [asdict(each) for each in found]
            print(line_of(name, found), flush=True)
    if options.json:
        options.json.write_text(json.dumps(stored, indent=1) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
