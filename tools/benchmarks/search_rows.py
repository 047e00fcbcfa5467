"""How often, and how fast, the search finds a random pose of a random body."""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass
from typing import Any

import numpy as np

from benchmarks.search_cases import Row, Trial, absent, is_right, rows_named, trial
from mixpose.search import Candidate, search

TIMED = ("2 pinhole 6/0/0", "2 pinhole 6/1/3", "2 pinhole 8/2/4")
AS_GOOD = 3.0
"""Evidence, in nats, by which a rival may lead and the frame still be called ambiguous."""

ABSENT_DETECTIONS = 8
HEADING = (
    f"{'sensors N/hidden/false':24} {'right':>7} {'ambig.':>7} {'listed':>7} {'aim':>5}"
    f" {'ms median':>10} {'ms 95 %':>8}"
)


@dataclass(frozen=True)
class Outcome:
    """What a search returned for one frame.

    Attributes
    ----------
    first : bool
        The best candidate is right.
    ambiguous : bool
        It is not, but a right one is about as good.
    listed : bool
        A right one is among the candidates.
    ms : float
    """

    first: bool
    ambiguous: bool
    listed: bool
    ms: float


def outcome(frame: Trial) -> Outcome:
    candidates, ms = timed(frame)
    right = [is_right(each.T_world_object, frame) for each in candidates]
    first = bool(right and right[0])
    close = [each.evidence > candidates[0].evidence - AS_GOOD for each in candidates]
    ambiguous = not first and any(r and c for r, c in zip(right, close, strict=True))
    return Outcome(first, ambiguous, any(right), ms)


def timed(frame: Trial) -> tuple[list[Candidate], float]:
    began = time.perf_counter()
    candidates = search(frame.views, frame.body, free=np.ones(6, dtype=np.bool_), T_reference=None)
    return candidates, 1e3 * (time.perf_counter() - began)


def run(options: argparse.Namespace) -> dict[str, Any]:
    """Print the table and return its figures."""
    outcome(trial(rows_named([])[0], 0))
    table, fast = {}, []
    print(HEADING)
    for row in rows_named(options.rows):
        outcomes = [outcome(trial(row, seed)) for seed in range(options.trials)]
        table[row.name] = figures(row, outcomes)
        if row.name in TIMED:
            fast += [each.ms for each in outcomes]
    summary: dict[str, Any] = {"rows": table, "absent": absent_figures(options.trials)}
    if fast:
        summary["ms_median"] = float(np.median(fast))
        summary["ms_p95"] = float(np.percentile(fast, 95))
        print(f"two cameras: median {summary['ms_median']:.0f} ms, 95 % {summary['ms_p95']:.0f} ms")
    return summary


def figures(row: Row, outcomes: list[Outcome]) -> dict[str, Any]:
    first = float(np.mean([each.first for each in outcomes]))
    ambiguous = float(np.mean([each.ambiguous for each in outcomes]))
    listed = float(np.mean([each.listed for each in outcomes]))
    ms = [each.ms for each in outcomes]
    median, late = float(np.median(ms)), float(np.percentile(ms, 95))
    print(
        f"{row.name:24} {first:7.1%} {ambiguous:7.1%} {listed:7.1%} {row.wanted:5.0%}"
        f" {median:10.0f} {late:8.0f}",
        flush=True,
    )
    return {
        "success": first + ambiguous,
        "first": first,
        "listed": listed,
        "wrong_ok": None,
        "ms_median": median,
        "ms_p95": late,
    }


def absent_figures(trials: int) -> dict[str, float]:
    """Evidence that false detections alone muster, by number of cameras."""
    found = {}
    for name in ("2 pinhole 6/0/0", "1 pinhole 5/0/5"):
        row = rows_named([name])[0]
        frames = [absent(row, seed, detections=ABSENT_DETECTIONS) for seed in range(trials // 10)]
        best = [timed(frame)[0][:1] for frame in frames]
        evidence = [each[0].evidence if each else 0.0 for each in best]
        found[row.sensors] = float(max(evidence, default=0.0))
        kind = f"{ABSENT_DETECTIONS} false detections, {row.sensors}"
        print(f"no body, {kind}: evidence at most {max(evidence):.1f}")
    return found
