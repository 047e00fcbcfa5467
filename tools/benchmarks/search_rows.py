"""How often, and how fast, a first pose is found, and whether a wrong one is ever believed.

A row's frames show a random body each; half as many more show nothing but false features.  Every
frame is given to the search alone, for its time, and to the estimator as the first of a recording,
for its status.

A frame counts as a success where the pose, which is the first hypothesis, is right; that a right
one stands anywhere among the hypotheses is told apart.  Whether the covariance holds is told of all
frames with a body that are called ok, the wrong ones too.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.stats import chi2

from benchmarks.search_cases import Row, Trial, absent, errors_squared, is_right, rows_named, trial
from mixpose.fit import EstimatorOptions
from mixpose.search import search_frame
from mixpose.tracking import Tracker

TIMED = ("2 pinhole 6/0/0", "2 pinhole 6/1/3", "2 pinhole 8/2/4")
FRESH = 10_000  # first seed of the frames without a body
HEADING = (
    f"{'sensors N/hidden/false':24} {'first':>7} {'aim':>5} {'listed':>7} {'ok':>7} {'ambig.':>7}"
    f" {'lost':>6} {'wrong ok':>9} {'inside 95 %':>12} {'squared':>8} {'search ms':>10} {'95 %':>6}"
    f" {'pose ms':>8}"
)


@dataclass(frozen=True)
class Outcome:
    """What the estimator said of one frame.

    Attributes
    ----------
    status : str
    first : bool
        The pose is right.
    listed : bool
        The pose or one of the hypotheses is right.
    squared : float or None
        Squared error in standard deviations of the reported covariance, of a frame that is ok.
    search_ms, pose_ms : float
        Time of the search alone, and of the whole estimate.
    """

    status: str
    first: bool
    listed: bool
    squared: float | None
    search_ms: float
    pose_ms: float


def outcome(frame: Trial) -> Outcome:
    began = time.perf_counter()
    search_frame(frame.views, frame.body, free=np.ones(6, dtype=np.bool_), T_reference=None)
    searched = time.perf_counter()
    tracker = Tracker.create(frame.body, EstimatorOptions())
    _, estimate = tracker.advance(tracker.begin(), 0, None, frame.views)
    done = time.perf_counter()
    T, squared = estimate.T_world_object, None
    first = T is not None and is_right(T, frame)
    if estimate.status == "ok" and T is not None and estimate.covariance is not None:
        squared = errors_squared(T, estimate.covariance, frame)
    listed = first or any(is_right(one.T_world_object, frame) for one in estimate.hypotheses)
    ms = (1e3 * (searched - began), 1e3 * (done - searched))
    return Outcome(estimate.status, first, listed, squared, *ms)


def run(options: argparse.Namespace) -> dict[str, Any]:
    """Print the table and return its figures."""
    outcome(trial(rows_named([])[0], 0))
    table: dict[str, Any] = {}
    fast: list[Outcome] = []
    print(HEADING)
    for row in rows_named(options.rows):
        seen = [outcome(trial(row, seed)) for seed in range(options.trials)]
        empty = [outcome(absent(row, FRESH + seed)) for seed in range(-(-options.trials // 2))]
        table[row.name] = figures(row, seen, empty)
        fast += seen if row.name in TIMED else []
    believed = sum(row["wrong_ok"] for row in table.values())
    frames = len(table) * (options.trials - (-options.trials // 2))
    print(f"wrong poses called ok: {believed} of {frames} frames, a third of them without a body")
    summary: dict[str, Any] = {"rows": table, "frames": frames, "wrong_ok": believed}
    if fast:
        summary["ms_median"] = float(np.median([one.search_ms for one in fast]))
        summary["ms_p95"] = float(np.percentile([one.search_ms for one in fast], 95))
        print(f"two cameras: median {summary['ms_median']:.0f} ms, 95 % {summary['ms_p95']:.0f} ms")
    return summary


def figures(row: Row, seen: Sequence[Outcome], empty: Sequence[Outcome]) -> dict[str, Any]:
    """Figures of one row, printed as a line."""
    status = Counter(one.status for one in seen)
    wrong = sum(one.status == "ok" and not one.first for one in seen)
    wrong += sum(one.status == "ok" for one in empty)
    first = float(np.mean([one.first for one in seen]))
    inside, squared = consistency([one.squared for one in seen if one.squared is not None])
    numbers = {
        "success": first,
        "first": first,
        "listed": float(np.mean([one.listed for one in seen])),
        "ok": status["ok"] / len(seen),
        "wrong_ok": wrong,
        "ambiguous": status["ambiguous"] / len(seen),
        "lost": status["lost"] / len(seen),
        "absent_lost": float(np.mean([float(one.status == "lost") for one in empty])),
        "inside_95": inside,
        "squared_per_dimension": squared,
        "search_ms_median": float(np.median([one.search_ms for one in seen])),
        "search_ms_p95": float(np.percentile([one.search_ms for one in seen], 95)),
        "pose_ms_median": float(np.median([one.pose_ms for one in seen])),
    }
    held = "-" if inside is None else f"{inside:.1%}"
    mean = "-" if squared is None else f"{squared:.2f}"
    print(
        f"{row.name:24} {first:7.1%} {row.wanted:5.0%} {numbers['listed']:7.1%}"
        f" {numbers['ok']:7.1%} {numbers['ambiguous']:7.1%} {numbers['lost']:6.1%} {wrong:9}"
        f" {held:>12} {mean:>8} {numbers['search_ms_median']:10.0f}"
        f" {numbers['search_ms_p95']:6.0f} {numbers['pose_ms_median']:8.0f}",
        flush=True,
    )
    return numbers


def consistency(squared: Sequence[float]) -> tuple[float | None, float | None]:
    """Share of squared errors inside the 95 % ellipsoid, and their mean per dimension.

    Of no frame at all nothing is known.
    """
    if not squared:
        return None, None
    inside = np.mean(np.array(squared) < chi2.ppf(0.95, 6))
    return float(inside), float(np.mean(squared)) / 6
