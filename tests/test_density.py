"""A density is a probability density, and looking it up is exact to float rounding."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from mixpose.density import (
    Density,
    Observation,
    Window,
    matched_atlas,
    remap,
    render,
    self_overlap,
)
from mixpose.records import GridPattern, Pattern, PointPattern


def points_pattern() -> PointPattern:
    rng = np.random.default_rng(1)
    return PointPattern(rng.uniform(40, 160, (7, 2)), rng.uniform(0.5, 2.0, 7))


def image_pattern() -> GridPattern:
    values = np.zeros((200, 220), dtype=np.float32)
    values[50:56, 70:74] = 90.0
    values[120, 101] = 30.0
    return GridPattern(values, np.zeros(2), 1.0)


def range_points() -> PointPattern:
    return PointPattern(np.array([[3.2], [7.9], [8.4]]), np.ones(3))


def range_profile() -> GridPattern:
    values = np.zeros((1, 400), dtype=np.float32)
    values[0, [100, 130, 135]] = [1.0, 2.0, 1.5]
    return GridPattern(values, np.array([900.0]), 0.5)


@pytest.mark.parametrize(
    ("pattern", "sigma"),
    [
        (points_pattern(), 1.5),
        (points_pattern(), 12.0),
        (image_pattern(), 1.5),
        (image_pattern(), 17.0),
        (range_points(), 0.3),
        (range_profile(), 2.0),
        (range_profile(), 11.0),
    ],
)
def test_every_density_integrates_to_one(pattern: Pattern, sigma: float) -> None:
    observation = Observation(pattern, sigma)
    lower, upper = observation.extent
    g = observation.density(sigma, (lower - 6 * sigma, upper + 6 * sigma))
    assert g.values.dtype == np.float32
    # the window ends at 5 sigma: the tails hold 1e-6, float32 sums another 1e-6
    integral = g.values.sum(dtype=np.float64) * g.window.step ** len(g.window.origin)
    assert integral == pytest.approx(1.0, abs=2e-5)


def test_blur_widens_a_feature_to_sigma_even_on_a_reduced_grid() -> None:
    observation = Observation(image_pattern(), 20.0)
    g = observation.density(20.0, (np.full(2, -200.0), np.full(2, 400.0)))
    assert g.window.step > 1.5
    u = g.window.axis(0)
    profile = g.values.sum(axis=0, dtype=np.float64)
    centre = (profile * u).sum() / profile.sum()
    variance = (profile * (u - centre) ** 2).sum() / profile.sum()
    values = image_pattern().values.sum(axis=0, dtype=np.float64)
    own = np.average(
        (np.arange(220) - np.average(np.arange(220), weights=values)) ** 2, weights=values
    )
    assert centre == pytest.approx(np.average(np.arange(220), weights=values), abs=0.02)
    assert np.sqrt(variance) == pytest.approx(np.sqrt(20.0**2 + own), rel=2e-3)


@pytest.mark.parametrize("channels", [1, 3, 4])
def test_remap_samples_float32_to_float_rounding(channels: int) -> None:
    # Before OpenCV 5 coordinates were rounded to 1/32 px: the objective was a staircase.
    # With 2 or more than 4 channels OpenCV 5.0 still does, by up to 0.02 here.
    rng = np.random.default_rng(0)
    values = rng.random((60, 80, channels), dtype=np.float32)
    u, v = rng.uniform(0, 78, 5000).astype(np.float32), rng.uniform(0, 58, 5000).astype(np.float32)
    i, j = np.floor(v).astype(int), np.floor(u).astype(int)
    b, a = (v - i)[:, None], (u - j)[:, None]
    exact = (1 - b) * ((1 - a) * values[i, j] + a * values[i, j + 1]) + b * (
        (1 - a) * values[i + 1, j] + a * values[i + 1, j + 1]
    )
    for count in (5000, 7):
        looked_up = remap(values, u[:count], v[:count])
        # numbers up to 1, a few roundings of 2⁻²⁴ each
        assert np.abs(looked_up - exact[:count]).max() < 5e-7


def test_coordinates_a_thousandth_of_a_step_apart_are_told_apart() -> None:
    values = np.random.default_rng(0).random((60, 80), dtype=np.float32)
    density = Density(values, Window(np.zeros(2), values.shape, 1.0), 1.0)
    y = np.stack([np.linspace(10.0, 10.03, 31), np.full(31, 20.5)], axis=-1)
    assert len(np.unique(density.sample(y))) == 31


@pytest.mark.parametrize("pattern", [points_pattern(), range_points(), range_profile()])
def test_densities_have_only_channels_that_are_looked_up_exactly(pattern: Pattern) -> None:
    observation = Observation(pattern, 2.0)
    density = observation.density(2.0, observation.extent, gradient=True)
    assert density.values.shape[2] == 3
    y = np.array([observation.extent[0]])
    assert density.sample(y).shape == (1, 1 + len(density.window.origin))
    assert matched_atlas([observation], [2.0], 4.0).values.shape[2] == 3


def test_more_samples_than_one_map_side_can_hold() -> None:
    values = np.arange(40 * 50, dtype=np.float32).reshape(40, 50)
    density = Density(values, Window(np.zeros(2), values.shape, 1.0), 1.0)
    y = np.random.default_rng(0).uniform([0, 0], [48, 38], (70_001, 2))
    # the ramp u + 50 v is interpolated exactly
    np.testing.assert_allclose(density.sample(y), y[:, 0] + 50 * y[:, 1], atol=1e-3)
    assert density.sample(y.reshape(70_001, 1, 2)).shape == (70_001, 1)


def test_outside_the_window_and_at_nan_is_the_floor() -> None:
    density = render(points_pattern(), 3.0, Window(np.zeros(2), (200, 200), 1.0), gradient=True)
    y = np.array([[-1e6, -1e6], [1e12, 3.0], [np.nan, 4.0], [-5.0, 50.0]])
    assert (density.sample(y) == 0).all()


@pytest.mark.parametrize("pattern", [points_pattern(), image_pattern(), range_points()])
def test_gradient_channels_are_the_derivative_of_the_density(pattern: Pattern) -> None:
    sigma = 6.0 if len(Observation(pattern, 1.0).extent[0]) == 2 else 0.6
    observation = Observation(pattern, sigma)
    lower, upper = observation.extent
    g = observation.density(sigma, (lower - 5 * sigma, upper + 5 * sigma), gradient=True)
    h = g.window.step
    if len(g.window.origin) == 1:
        numerical = (g.values[0, 2:, 0] - g.values[0, :-2, 0]) / (2 * h)
        analytic = g.values[0, 1:-1, 1]
    else:
        numerical = (g.values[2:, 1:-1, 0] - g.values[:-2, 1:-1, 0]) / (2 * h)
        analytic = g.values[1:-1, 1:-1, 2]
    # central differences of a Gaussian err by h²/(6σ²) of its steepest slope
    assert np.abs(numerical - analytic).max() < 0.06 * np.abs(analytic).max()
    assert np.abs(analytic).max() > 0


def test_matched_density_holds_inner_products_with_a_feature() -> None:
    pattern, sigma = points_pattern(), 4.0
    observation = Observation(pattern, sigma)
    matched = matched_atlas([observation], [sigma], 4.0)
    weights = pattern.weights / pattern.weights.sum()
    p = np.array([[80.0, 90.0]])
    away = pattern.points - p
    variance = 2 * sigma**2
    expected = np.sum(weights * np.exp(-0.5 * (away**2).sum(1) / variance) / (2 * np.pi * variance))
    assert matched.look_up(p[None, None])[0, 0, 0, 0] == pytest.approx(expected, rel=0.02)


@pytest.mark.parametrize("count", [20, 300])
def test_energy_of_points_equals_the_integral_of_the_squared_density(count: int) -> None:
    rng = np.random.default_rng(2)
    pattern = PointPattern(rng.uniform(0, 150, (count, 2)), np.ones(count))
    observation = Observation(pattern, 3.0)
    g = observation.density(3.0, (np.full(2, -20.0), np.full(2, 170.0)))
    integral = float((g.values.astype(np.float64) ** 2).sum() * g.window.step**2)
    assert observation.energy(3.0) == pytest.approx(integral, rel=1e-4)


def test_overlap_of_many_points_equals_all_pairs() -> None:
    points = np.random.default_rng(4).uniform(0, 60, (150, 2))
    away = ((points[:, None] - points[None]) ** 2).sum(-1)
    exact = np.exp(-0.5 * away / 8.0).sum() / (2 * np.pi * 8.0)
    assert self_overlap(points, np.ones(150), 8.0) == pytest.approx(exact, rel=1e-6)


def test_an_empty_pattern_gives_a_density_of_zero() -> None:
    pattern = PointPattern(np.zeros((0, 2)), np.zeros(0))
    assert Observation(pattern, 1.0).is_empty
    g = render(pattern, 2.0, Window(np.zeros(2), (10, 12), 1.0), gradient=True)
    assert g.values.shape == (10, 12, 3)
    assert not g.values.any()


def test_opencv_is_new_enough_for_exact_remap() -> None:
    assert int(cv2.__version__.split(".")[0]) >= 5


def test_a_profile_that_lies_below_zero_is_empty() -> None:
    noise = -np.ones((1, 50), dtype=np.float32)
    assert Observation(GridPattern(noise, np.zeros(1), 1.0), 2.0).is_empty
    noise[0, 20] = 100.0
    assert not Observation(GridPattern(noise, np.zeros(1), 1.0), 2.0).is_empty


def test_a_profile_whose_noise_cancels_keeps_the_size_of_its_noise() -> None:
    values = np.zeros((1, 100), dtype=np.float32)
    values[0, 40], values[0, 60:80] = 1.0, -0.0499
    observed = Observation(GridPattern(values, np.array([0.0]), 0.1), 0.2)
    density = observed.density(0.2, (np.array([3.0]), np.array([5.0])))
    # the integral of absolute values is 2 · 0.1, of which the peak holds half
    assert density.values.sum() * density.window.step == pytest.approx(0.5, rel=1e-2)


def test_a_measurement_that_is_a_density_already_is_not_blurred_again() -> None:
    v, u = np.mgrid[:61, :61] - 30.0
    values = np.exp(-(u**2 + v**2) / (2 * 3.0**2)).astype(np.float32)
    observed = Observation(GridPattern(values, np.array([-30.0, -30.0]), 1.0), 3.0, intrinsic=3.0)
    for sigma in (3.0, 5.0):
        assert observed.blur(sigma) == pytest.approx(np.sqrt(sigma**2 - 3.0**2))
        assert observed.blur(sigma, matched=True) == pytest.approx(np.sqrt(2 * sigma**2 - 3.0**2))
        # ⟨g, g⟩ of a Gaussian of standard deviation σ is 1/4πσ²
        assert observed.energy(sigma) == pytest.approx(1 / (4 * np.pi * sigma**2), rel=1e-3)


def test_the_energy_of_detections_falls_with_every_blur() -> None:
    observed = Observation(PointPattern(np.array([[10.0, 10.0], [500.0, 20.0]]), np.ones(2)), 1.5)
    for sigma in (1.5, 3.0, 6.0):
        # two halves that do not overlap
        assert observed.energy(sigma) == pytest.approx(2 * 0.25 / (4 * np.pi * sigma**2))
