"""The paper's objective maps over (φ, w), on a few points."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tools"))

from paper import maps
from paper.systems import POINTS, SCENARIOS, pose

from mixpose.rigid import transform


@pytest.fixture
def coarse_map(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(maps, "PHI", np.radians([30.0, 50.0, 60.0, 70.0, 90.0]))
    monkeypatch.setattr(maps, "W", np.array([20.0, 35.0, 40.0, 45.0, 60.0]))


def test_the_motion_of_the_maps_is_that_of_the_camera_example() -> None:
    phi, w = 1.1, 37.0
    moved = transform(pose(maps.parameters_of_motion(phi, w)), POINTS)
    x, y, z = (POINTS + w).T
    expected = [np.cos(phi) * x + np.sin(phi) * y, -np.sin(phi) * x + np.cos(phi) * y, z]
    assert moved == pytest.approx(np.transpose(expected), abs=1e-10)


@pytest.mark.usefixtures("coarse_map")
@pytest.mark.parametrize("scenario", ["I", "II", "IV"])
def test_the_matched_map_peaks_at_the_truth(scenario: str) -> None:
    chosen = next(s for s in SCENARIOS if s.name == scenario)
    for system in maps.mapped_systems():
        phi, w = maps.peak_of(maps.matched_map(system, chosen, seed=0))
        assert (np.degrees(phi), w) == pytest.approx((60.0, 40.0))


@pytest.mark.usefixtures("coarse_map")
def test_the_papers_map_peaks_at_the_truth_where_features_are_apart() -> None:
    for system in maps.mapped_systems():
        phi, w = maps.peak_of(maps.paper_map(system, SCENARIOS[0], seed=0))
        assert (np.degrees(phi), w) == pytest.approx((60.0, 40.0))
