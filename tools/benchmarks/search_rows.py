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
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from scipy.stats import chi2

from benchmarks.search_cases import (
    Row,
    Trial,
    absent,
    crowded_absent,
    errors_squared,
    is_right,
    rows_named,
    sequence,
    trial,
)
from benchmarks.space_clutter import Scene, scene_trial, scenes_named
from benchmarks.timing import PROCESSOR
from mixpose.fit import EstimatorOptions
from mixpose.search import LIVE, THOROUGH, SearchReport, search_frame
from mixpose.tracking import Tracker

TIMED = ("2 pinhole 6/0/0", "2 pinhole 6/1/3", "2 pinhole 8/2/4")
ALL_FREE = np.ones(6, dtype=np.bool_)
FRESH = 10_000  # first seed of the frames without a body
SEQUENCE = Row("1 pinhole", 8, 3, 5, 0.99)
FRAMES = 20
CROWDS = ((6, 8), (20, 40), (100, 40))  # markers of a body that is not there, false detections
HEADING = (
    f"{'sensors N/hidden/false':29} {'first':>7} {'aim':>5} {'listed':>7} {'ok':>7} {'ambig.':>7}"
    f" {'lost':>6} {'wrong ok':>9} {'absent: lost':>13} {'inside 95 %':>12} {'squared':>8}"
    f" {'search ms':>10} {'95 %':>6} {'pose ms':>8} {'95 %':>6}"
    f"   {'made':>6} {'tested':>6} {'refined':>7}"
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
        Processor time of the search alone, and of the whole estimate.
    report : SearchReport
        Guesses of the search.
    """

    status: str
    first: bool
    listed: bool
    squared: float | None
    search_ms: float
    pose_ms: float
    report: SearchReport = SearchReport()


def outcome(frame: Trial) -> Outcome:
    began = PROCESSOR()
    found = search_frame(frame.views, frame.body, free=ALL_FREE, T_reference=None)
    searched = PROCESSOR()
    tracker = Tracker.create(frame.body, EstimatorOptions())
    _, estimate = tracker.advance(tracker.begin(), 0, None, frame.views)
    done = PROCESSOR()
    T, squared = estimate.T_world_object, None
    first = T is not None and is_right(T, frame)
    if estimate.status == "ok" and T is not None and estimate.covariance is not None:
        squared = errors_squared(T, estimate.covariance, frame)
    listed = first or any(is_right(one.T_world_object, frame) for one in estimate.hypotheses)
    ms = (1e3 * (searched - began), 1e3 * (done - searched))
    return Outcome(estimate.status, first, listed, squared, *ms, found.report)


def run(options: argparse.Namespace) -> dict[str, Any]:
    """Print the tables and return their figures."""
    outcome(trial(rows_named([])[0], 0))
    table: dict[str, Any] = {}
    fast: list[Outcome] = []
    half = -(-options.trials // 2)
    print(HEADING)
    for row in rows_named(options.rows):
        seen = [outcome(trial(row, seed)) for seed in range(options.trials)]
        empty = [outcome(absent(row, FRESH + seed)) for seed in range(half)]
        table[row.name] = figures(row, seen, empty)
        fast += seen if row.name in TIMED else []
    for scene in scenes_named(options.rows):
        seen = [outcome(scene_trial(scene, seed)) for seed in range(options.trials)]
        empty = [outcome(scene_trial(scene, FRESH + k, present=False)) for k in range(half)]
        table[scene.name] = figures(scene, seen, empty)
    believed = sum(row["wrong_ok"] for row in table.values())
    frames = len(table) * (options.trials + half)
    print(f"wrong poses called ok: {believed} of {frames} frames, a third of them without a body")
    summary: dict[str, Any] = {"rows": table, "frames": frames, "wrong_ok": believed}
    if fast:
        summary["ms_median"] = float(np.median([one.search_ms for one in fast]))
        summary["ms_p95"] = float(np.percentile([one.search_ms for one in fast], 95))
        print(f"two cameras: median {summary['ms_median']:.0f} ms, 95 % {summary['ms_p95']:.0f} ms")
    if not options.rows or "sequence" in options.rows:
        summary["sequence"] = sequences(-(-options.trials // 10))
    if not options.rows or "crowd" in options.rows:
        summary["crowd"] = crowds(-(-options.trials // 20))
    return summary


def sequences(count: int) -> dict[str, Any]:
    """How sure one camera becomes of a body with few markers as frame follows frame."""
    right, wrong, first_ok = [], 0, []
    for seed in range(count):
        frames = sequence(SEQUENCE, seed, FRAMES)
        tracker = Tracker.create(frames[0].body, EstimatorOptions())
        track, ok = tracker.begin(), []
        for k, frame in enumerate(frames):
            track, estimate = tracker.advance(track, k, None, frame.views)
            T = estimate.T_world_object
            sure, true = estimate.status == "ok", T is not None and is_right(T, frame)
            ok.append(sure and true)
            wrong += sure and not true
        right.append(float(np.mean(ok)))
        first_ok.append(ok.index(True) if any(ok) else FRAMES)
    found = {"ok": float(np.mean(right)), "wrong_ok": wrong, "first_ok": float(np.median(first_ok))}
    print(
        f"{count} sequences of {FRAMES} frames, {SEQUENCE.name}: ok and right in {found['ok']:.0%}"
        f" (worst {min(right):.0%}), from frame {found['first_ok']:.0f} on; wrong ok {wrong}"
    )
    return found


def crowds(count: int) -> dict[str, Any]:
    """What a frame of two cameras without the body costs, by all guesses and within a budget."""
    table: dict[str, Any] = {}
    print(
        f"{'body absent, 2 pinhole':29} {'thorough ms':>12} {'95 %':>6} {'live ms':>8} {'95 %':>6}"
    )
    for features, false in CROWDS:
        times: dict[str, list[float]] = {"thorough": [], "live": []}
        for seed in range(count):
            frame = crowded_absent(features, false, FRESH + seed)
            searches = {
                name: partial(
                    search_frame,
                    frame.views,
                    frame.body,
                    free=ALL_FREE,
                    T_reference=None,
                    budget=budget,
                )
                for name, budget in (("thorough", THOROUGH), ("live", LIVE))
            }
            searches["live"]()  # what is made once for a body is made
            for name, search in searches.items():
                began = PROCESSOR()
                search()
                times[name].append(1e3 * (PROCESSOR() - began))
        medians = {name: float(np.median(times[name])) for name in times}
        worst = {name: float(np.percentile(times[name], 95)) for name in times}
        table[f"{features}/{false}"] = {"ms_median": medians, "ms_p95": worst}
        print(
            f"{f'{features} markers, {false} false':29} {medians['thorough']:12.0f}"
            f" {worst['thorough']:6.0f} {medians['live']:8.0f} {worst['live']:6.0f}",
            flush=True,
        )
    return table


def figures(row: Row | Scene, seen: Sequence[Outcome], empty: Sequence[Outcome]) -> dict[str, Any]:
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
        "pose_ms_p95": float(np.percentile([one.pose_ms for one in seen], 95)),
    }
    reports = [one.report for one in seen]
    guesses = {
        name: int(np.median([getattr(one, name) for one in reports]))
        for name in ("made", "tested", "refined")
    }
    held = "-" if inside is None else f"{inside:.1%}"
    mean = "-" if squared is None else f"{squared:.2f}"
    print(
        f"{row.name:29} {first:7.1%} {row.wanted:5.0%} {numbers['listed']:7.1%}"
        f" {numbers['ok']:7.1%} {numbers['ambiguous']:7.1%} {numbers['lost']:6.1%} {wrong:9}"
        f" {numbers['absent_lost']:13.1%} {held:>12} {mean:>8} {numbers['search_ms_median']:10.0f}"
        f" {numbers['search_ms_p95']:6.0f} {numbers['pose_ms_median']:8.0f}"
        f" {numbers['pose_ms_p95']:6.0f}   {guesses['made']:6} {guesses['tested']:6}"
        f" {guesses['refined']:7}",
        flush=True,
    )
    return numbers | {"guesses": guesses}


def consistency(squared: Sequence[float]) -> tuple[float | None, float | None]:
    """Share of squared errors inside the 95 % ellipsoid, and their mean per dimension.

    Of no frame at all nothing is known.
    """
    if not squared:
        return None, None
    inside = np.mean(np.array(squared) < chi2.ppf(0.95, 6))
    return float(inside), float(np.mean(squared)) / 6
