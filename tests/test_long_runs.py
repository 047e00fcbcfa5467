"""Runs of any length: what is remembered of the frames does not grow with them."""

from __future__ import annotations

import gc
import sys
import tracemalloc
from itertools import islice
from pathlib import Path

import numpy as np

from mixpose.cli.findings import Stretches
from mixpose.cli.notices import Summary
from mixpose.runner import run
from mixpose.session import load_session

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tools"))

from cluster_trial import make_recordings


def test_what_a_run_remembers_does_not_grow_with_its_frames(tmp_path: Path) -> None:
    (path,) = make_recordings(tmp_path, 1, 150)
    session = load_session(path)
    summary = Summary(session)
    estimates = run(session, watch=summary.findings.watch)
    tracemalloc.start()
    try:
        remembered = []
        for frames in (50, 50, 49):
            for estimate in islice(estimates, frames):
                summary.add(estimate)
            gc.collect()
            remembered.append(tracemalloc.get_traced_memory()[0])
    finally:
        tracemalloc.stop()
    # residuals of two cameras, which are kept of the last 10,000 frames, take 100 bytes a frame;
    # one image of such a camera would take a million
    assert remembered[2] - remembered[1] < 50 * 1000


def test_frames_that_come_and_go_all_night_take_no_memory() -> None:
    rng = np.random.default_rng(0)
    stretches, all_of_them, place = Stretches(), list[tuple[int, int]](), 0
    for length in rng.integers(1, 50, 2000).tolist():
        all_of_them.append((place, length))
        for k in range(place, place + length):
            stretches.add(k, k)
        place += length + 1
    longest = sorted(sorted(all_of_them, key=lambda each: -each[1])[:3])
    named = ", ".join(f"{first} to {first + length - 1}" for first, length in longest)
    assert stretches.text() == f"{named} and 1997 more"
    assert stretches.count == sum(length for _, length in all_of_them)
    assert len(stretches.kept) <= 4
