"""The tool that measures accuracy over many seeds: `tools/accuracy.py`."""

from __future__ import annotations

import math
import sys
from dataclasses import replace
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tools"))

from accuracy import FIRST_SEED, Figures, figures_of, summary
from make_synthetic import RECORDINGS


def test_worst_is_the_largest_error_and_the_smallest_share() -> None:
    seeds = [Figures(0.1 * k, 0.2 * k, 1 - 0.1 * k, 0.9 - 0.1 * k, float(k)) for k in (1, 3, 2)]
    table = summary(seeds)
    assert {key: round(each["median"], 9) for key, each in table.items()} == {
        "rotation_deg": 0.2, "position": 0.4, "ok": 0.8, "inside_95": 0.7, "squared": 2.0,
    }  # fmt: skip
    assert {key: round(each["worst"], 9) for key, each in table.items()} == {
        "rotation_deg": 0.3, "position": 0.6, "ok": 0.7, "inside_95": 0.6, "squared": 3.0,
    }  # fmt: skip


def test_a_seed_without_any_pose_is_the_worst_and_not_left_out() -> None:
    nan = math.nan
    table = summary([Figures(0.1, 0.2, 1.0, 0.9, 1.0), Figures(nan, nan, 0.0, nan, nan)])
    assert [each["worst"] for each in table.values()] == [math.inf, math.inf, 0.0, 0.0, math.inf]


def test_a_seed_gives_the_same_figures_again_and_another_one_others(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    # the seeds of the recordings themselves would be measured twice
    assert all(each.options.seed < FIRST_SEED for each in RECORDINGS.values())
    made = RECORDINGS["range_profiles"]
    few = replace(made, options=replace(made.options, frames=12))
    monkeypatch.setitem(RECORDINGS, "range_profiles", few)
    (first, smoothed), (again,), (other,) = (
        figures_of("range_profiles", FIRST_SEED + k, smooth)
        for k, smooth in [(0, True), (0, False), (1, False)]
    )
    assert first == again
    assert first.rotation_deg != other.rotation_deg
    assert 0.1 < smoothed.rotation_deg < 1  # of what it was
