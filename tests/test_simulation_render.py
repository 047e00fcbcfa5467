"""Drawn spots lie where features project to, and noise is as strong as asked for."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from mixpose.simulation.options import SimulationOptions
from mixpose.simulation.render import (
    ImageFormat,
    ProfileFormat,
    draw_profile,
    draw_spots,
    render_image,
    render_profile,
)
from mixpose.simulation.visible_spots import VisibleSpots

Floats = NDArray[np.float64]


def spots_at(points: Floats, levels: Floats | None = None) -> VisibleSpots:
    levels = np.ones(len(points)) if levels is None else levels
    return VisibleSpots(points, levels, np.arange(len(points)))


def centroid(image: NDArray[np.generic]) -> Floats:
    weights = image.astype(np.float64)
    v, u = np.indices(image.shape)
    return np.asarray([(weights * u).sum(), (weights * v).sum()] / weights.sum())


@pytest.mark.parametrize("sigma", [0.8, 1.6, 5.0])
def test_centroid_of_a_spot_is_its_place_wherever_in_the_pixel(sigma: float) -> None:
    for u, v in np.random.default_rng(1).uniform(40, 41, (25, 2)):
        image = np.zeros((90, 80))
        draw_spots(image, np.array([[u, v]]), np.array([180.0]), sigma)
        # narrower ones shift by exp(-2 (pi sigma)^2) / pi, as pixels miss their slope
        assert centroid(image) == pytest.approx([u, v], abs=1e-5)


def test_mass_of_a_spot_is_that_of_its_gaussian() -> None:
    image = np.zeros((60, 60))
    draw_spots(image, np.array([[30.3, 29.8]]), np.array([7.0]), 2.0)
    assert image.sum() == pytest.approx(7.0 * 2 * np.pi * 4.0, rel=1e-5)


def test_spots_at_the_border_are_cut_off_and_do_not_wrap_around() -> None:
    image = np.zeros((30, 40))
    draw_spots(image, np.array([[-0.5, 12.0]]), np.array([1.0]), 2.0)
    assert image.sum() == pytest.approx(0.5 * 2 * np.pi * 4.0, rel=1e-5)
    assert not image[:, 20:].any()
    draw_spots(image, np.array([[500.0, -80.0]]), np.array([1.0]), 2.0)
    assert image.sum() == pytest.approx(0.5 * 2 * np.pi * 4.0, rel=1e-5)


def test_centroid_survives_eight_bits() -> None:
    options = SimulationOptions(frames=1, background=0, noise=0, shot_noise=0)
    errors = []
    for point in np.random.default_rng(2).uniform(20, 21, (40, 2)):
        image = render_image(
            spots_at(point[None]),
            ImageFormat((42, 42), 1.6),
            options,
            np.random.default_rng(0),
        )
        assert image.dtype == np.uint8
        errors.append(centroid(image) - point)
    # rounding to grey levels: 0.3 levels in some 100 pixels against a mass of 2700
    assert np.sqrt(np.mean(np.square(errors))) < 0.01


def test_noise_has_the_variance_of_pixels_plus_photons_plus_rounding() -> None:
    options = SimulationOptions(frames=1, background=20, noise=3.0, shot_noise=0.1)
    empty = spots_at(np.zeros((0, 2)))
    image = render_image(empty, ImageFormat((400, 400), 1.6), options, np.random.default_rng(0))
    assert image.mean() == pytest.approx(20, abs=0.05)
    assert image.var() == pytest.approx(3.0**2 + 1 / 12, rel=0.02)
    # a spot so wide that it is flat in its middle: 100 levels add 10 to the variance
    bright = SimulationOptions(frames=1, background=20, noise=3.0, shot_noise=0.1, brightness=100)
    seen = spots_at(np.array([[200.0, 200.0]]))
    flat = ImageFormat((400, 400), 4000.0)
    lit = render_image(seen, flat, bright, np.random.default_rng(0))
    assert lit.mean() == pytest.approx(120, abs=0.3)
    assert lit.var() == pytest.approx(3.0**2 + 0.1 * 100 + 1 / 12, rel=0.02)


def test_dark_features_are_the_negative_of_bright_ones() -> None:
    options = SimulationOptions(frames=1)
    seen = spots_at(np.array([[12.0, 9.0]]))
    forms = ImageFormat((32, 24), 1.6), ImageFormat((32, 24), 1.6, "dark")
    bright, dark = (render_image(seen, f, options, np.random.default_rng(5)) for f in forms)
    assert np.array_equal(bright, 255 - dark)
    assert bright[9, 12] > 100 > dark[9, 12]


def test_what_is_too_bright_is_white() -> None:
    options = SimulationOptions(frames=1, brightness=400)
    seen = spots_at(np.array([[12.0, 9.0]]))
    image = render_image(seen, ImageFormat((32, 24), 1.6), options, np.random.default_rng(5))
    assert image.max() == 255


def test_profile_peaks_have_their_place_and_their_area() -> None:
    profile = np.zeros(200)
    draw_profile(profile, np.array([77.3]), np.array([2.0]), 3.0)
    assert profile.sum() == pytest.approx(2.0 * np.sqrt(2 * np.pi) * 3.0, rel=1e-5)
    assert (profile * np.arange(200)).sum() / profile.sum() == pytest.approx(77.3, abs=1e-5)


def test_profile_bins_count_from_range_min() -> None:
    options = SimulationOptions(frames=1, range_snr=1e6)
    form = ProfileFormat(bins=100, range_min=700.0, bin_size=0.5, width=4.0)
    seen = spots_at(np.array([[731.0]]))
    profile = render_profile(seen, form, options, np.random.default_rng(0))
    ranges = 700.0 + 0.5 * np.arange(100)
    assert profile.dtype == np.float32
    assert ranges[profile.argmax()] == 731.0
    assert profile.max() == pytest.approx(1.0, abs=0.01)


def test_profile_noise_is_one_over_the_signal_to_noise_ratio() -> None:
    options = SimulationOptions(frames=1, range_snr=5.0)
    form = ProfileFormat(bins=20000, range_min=0.0, bin_size=1.0, width=1.0)
    empty = spots_at(np.zeros((0, 1)))
    profile = render_profile(empty, form, options, np.random.default_rng(0))
    # the half below 0 is cut off: the mean square is half the variance
    assert profile.min() == 0
    assert np.mean(profile.astype(np.float64) ** 2) == pytest.approx(0.5 / 25, rel=0.05)
