"""The paper's objective maps over (φ, w), on a few points."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tools"))

from paper import maps
from paper.quadrature import Quadrature, cut
from paper.systems import POINTS, SCENARIOS, pose

from mixpose.records import GridPattern
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


@pytest.mark.parametrize("m", [1, 2])
def test_sums_over_pixels_are_exact(m: int) -> None:
    place, sigma, blur, step = np.array([31.3, 24.8])[:m], 4.0, 3.0, 0.8
    axes = [step * np.arange(80.0), step * np.arange(70.0)][:m]
    bells = [np.exp(-0.5 * ((a - p) / sigma) ** 2) for a, p in zip(axes, place, strict=True)]
    values = bells[0][None] if m == 1 else np.outer(bells[1], bells[0])
    # a float64 pattern: the rounding of single precision is not what is tested
    exact = Quadrature(values / (2 * np.pi * sigma**2) ** (m / 2), np.zeros(m), step, blur)
    y = place + np.array([[0.0, 0.0], [2.1, -1.3], [-3.3, 4.0]])[:, :m]
    sampled, second = exact.sample_all(y)
    variance = sigma**2 + blur**2
    away = y - place
    C = np.exp(-0.5 * (away**2).sum(axis=1) / variance) / (2 * np.pi * variance) ** (m / 2)
    slope = -away * C[:, None] / variance
    bend = C[:, None, None] * (
        away[:, :, None] * away[:, None, :] / variance**2 - np.eye(m) / variance
    )
    assert sampled[:, 0] == pytest.approx(C, rel=1e-8)
    assert sampled[:, 1:] == pytest.approx(slope, abs=1e-8 * C.max())
    assert second == pytest.approx(bend, abs=1e-8 * C.max())


def test_a_pattern_is_cut_to_the_box_asked_for() -> None:
    values = np.arange(30 * 40, dtype=np.float32).reshape(30, 40)
    pattern = GridPattern(values, np.array([10.0, -5.0]), 0.5)
    part = cut(pattern, np.array([12.0, -4.0]), np.array([14.0, 0.0]), 2.0)
    assert part.origin == pytest.approx([12.0, -4.0])
    assert part.values == pytest.approx(values[2:11, 4:9])
