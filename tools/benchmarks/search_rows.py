"""How often, and how fast, a first pose is found, and whether a wrong one is ever believed.

A row's frames show a random body each; half as many more show nothing but false features.  Every
frame is given to the search alone, for its time, and to the estimator as the first of a recording,
for its status.
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
from mixpose.estimation import EstimatorOptions, Tracker
from mixpose.search import search

TIMED = ("2 pinhole 6/0/0", "2 pinhole 6/1/3", "2 pinhole 8/2/4")
FRESH = 10_000  # first seed of the frames without a body
HEADING = (
    f"{'sensors N/hidden/false':24} {'success':>8} {'aim':>5} {'ok':>5} {'ambig.':>7} {'lost':>5}"
    f" {'wrong ok':>9} {'inside 95 %':>12} {'search ms':>10} {'95 %':>6} {'pose ms':>8}"
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
        Squared error in standard deviations of the reported covariance, of a right pose.
    search_ms, pose_ms : float
        Time of the search alone, and of the whole estimate.
    """

    status: str
    first: bool
    listed: bool
    squared: float | None
    search_ms: float
    pose_ms: float

    @property
    def is_success(self) -> bool:
        """Right and believed, or right and listed where several poses fit."""
        return self.first if self.status == "ok" else self.listed


def outcome(frame: Trial) -> Outcome:
    began = time.perf_counter()
    search(frame.views, frame.body, free=np.ones(6, dtype=np.bool_), T_reference=None)
    searched = time.perf_counter()
    tracker = Tracker.create(frame.body, EstimatorOptions())
    _, estimate = tracker.advance(tracker.begin(), 0, None, frame.views)
    done = time.perf_counter()
    T, squared = estimate.T_world_object, None
    first = T is not None and is_right(T, frame)
    if first:
        assert T is not None
        assert estimate.covariance is not None
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
    squared = [one.squared for one in seen if one.squared is not None]
    wrong = sum(one.status == "ok" and not one.first for one in seen)
    wrong += sum(one.status == "ok" for one in empty)
    numbers = {
        "success": float(np.mean([one.is_success for one in seen])),
        "first": float(np.mean([one.first for one in seen])),
        "wrong_ok": wrong,
        "ambiguous": status["ambiguous"] / len(seen),
        "lost": status["lost"] / len(seen),
        "absent_lost": float(np.mean([float(one.status == "lost") for one in empty])),
        "inside_95": float(np.mean(np.array(squared) < chi2.ppf(0.95, 6))),
        "search_ms_median": float(np.median([one.search_ms for one in seen])),
        "search_ms_p95": float(np.percentile([one.search_ms for one in seen], 95)),
        "pose_ms_median": float(np.median([one.pose_ms for one in seen])),
    }
    print(
        f"{row.name:24} {numbers['success']:8.1%} {row.wanted:5.0%} {status['ok']:5}"
        f" {status['ambiguous']:7} {status['lost']:5} {wrong:9} {numbers['inside_95']:12.1%}"
        f" {numbers['search_ms_median']:10.0f} {numbers['search_ms_p95']:6.0f}"
        f" {numbers['pose_ms_median']:8.0f}",
        flush=True,
    )
    return numbers
