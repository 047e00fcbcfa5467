"""Blobs: centres of spots and disks drawn here by integration, known to a thousandth of a px."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter
from scipy.special import erf

from mixpose.extraction import METHODS, ExtractOptions, extract
from mixpose.extraction.conics import fit_conics
from mixpose.extraction.threshold import RULES
from mixpose.records import Pattern, PointPattern

Floats = NDArray[np.float64]
Bytes = NDArray[np.uint8]

NOISE = 2.0
BACKGROUND = 20.0


def spot(shape: tuple[int, int], u: float, v: float, sigma: float, peak: float) -> Floats:
    """Gaussian, integrated over every pixel."""

    def integral(count: int, centre: float) -> Floats:
        edges = (np.arange(count + 1) - 0.5 - centre) / (sigma * np.sqrt(2))
        return np.asarray(np.diff(erf(edges)) / 2)

    scale = peak * 2 * np.pi * sigma**2
    return scale * integral(shape[0], v)[:, None] * integral(shape[1], u)


def disk(size: int, u: float, v: float, radius: float, hole: float = 0.0) -> Floats:
    """Share of each pixel that an oblique disk covers; `hole`: half the side of a square one."""
    fine = 8
    first = np.maximum(np.floor(np.array([u, v]) - radius - 1).astype(int), 0)
    last = np.minimum(np.ceil(np.array([u, v]) + radius + 2).astype(int), size)
    columns, rows = last - first
    x, y = np.meshgrid(
        (np.arange(columns * fine) + 0.5) / fine - 0.5 + first[0] - u,
        (np.arange(rows * fine) + 0.5) / fine - 0.5 + first[1] - v,
    )
    along, across = x * 0.8 + y * 0.6, y * 0.8 - x * 0.6
    covered = (along / radius) ** 2 + (across / (0.85 * radius)) ** 2 < 1
    covered &= np.maximum(np.abs(x * 0.9 + y * 0.436), np.abs(y * 0.9 - x * 0.436)) >= hole
    image = np.zeros((size, size))
    binned = covered.reshape(rows, fine, columns, fine).mean(axis=(1, 3))
    image[first[1] : last[1], first[0] : last[0]] = binned
    return image


def spots(shape: tuple[int, int], centres: Floats, sigma: float, *peaks: float) -> Floats:
    """Several spots, of the same or of given peaks."""
    peaks = peaks * len(centres) if len(peaks) == 1 else peaks
    light = np.zeros(shape)
    for (u, v), peak in zip(centres, peaks, strict=True):
        light += spot(shape, u, v, sigma, peak)
    return light


def photograph(light: Floats, seed: int) -> Bytes:
    noise = np.random.default_rng(seed).normal(0, NOISE, light.shape)
    return np.clip(np.rint(light + BACKGROUND + noise), 0, 255).astype(np.uint8)


def points_of(pattern: Pattern) -> Floats:
    assert isinstance(pattern, PointPattern)
    assert pattern.points.shape == (len(pattern.weights), 2)
    assert np.all(pattern.weights == 1)
    return pattern.points


def blobs(image: NDArray[np.generic], **options: object) -> Floats:
    return points_of(extract(image, ExtractOptions(**options)))  # type: ignore[arg-type]


def distances(points: Floats, truth: Floats) -> Floats:
    """Distance of each true point from the nearest found one."""
    assert len(points)
    return np.asarray(np.linalg.norm(points[None] - truth[:, None], axis=-1).min(axis=1))


def rms_error_per_axis(sigma: float, peak: float) -> float:
    errors = []
    rng = np.random.default_rng(7)
    for seed in range(60):
        centre = rng.uniform(28, 32, 2)
        found = blobs(photograph(spots((60, 60), centre[None], sigma, peak), seed))
        assert found.shape == (1, 2)
        errors.append(found[0] - centre)
    return float(np.sqrt(np.mean(np.square(errors))))


@pytest.mark.parametrize("sigma", [0.8, 1.2, 2.0, 3.0])
def test_bright_spots_are_located_near_the_statistical_limit(sigma: float) -> None:
    # Limit for known shape and background: noise / (peak √(π/2)) = 0.011 px.  Measured: 0.019,
    # 0.017, 0.014 and 0.021 px.
    assert rms_error_per_axis(sigma, peak=150) < 0.03


def test_dim_spots_are_located_within_a_twentieth_of_a_pixel() -> None:
    # Limit 0.032 px, measured 0.039.
    assert rms_error_per_axis(1.5, peak=50) < 0.05


def test_centres_are_not_drawn_to_the_middles_of_pixels() -> None:
    fractions = np.linspace(-0.5, 0.5, 21)
    errors = [
        blobs(spot((41, 41), 20 + shift, 20, 1.0, 150).astype(np.float32))[0, 0] - 20 - shift
        for shift in fractions
    ]
    # Pixel locking would be a sine over the pixel; measured amplitude 0.014 px.
    assert np.max(np.abs(errors)) < 0.02


def test_few_leds_in_a_dark_frame_are_found_where_otsu_sees_only_noise() -> None:
    rng = np.random.default_rng(0)
    truth = np.array([(200.0, 150.0), (640.5, 300.2), (900.3, 800.7), (1100.1, 512.4)])
    image = photograph(spots((1024, 1280), truth, 1.3, 220, 150, 90, 60), 1)
    # Hot pixels are no blobs.
    image[rng.integers(0, 1024, 30), rng.integers(0, 1280, 30)] = 255
    found = blobs(image)
    assert len(found) == 4
    assert np.max(distances(found, truth)) < 0.15
    assert len(blobs(image, threshold="otsu")) > 100


def test_bright_and_dim_disks_with_a_hole_are_one_blob_each() -> None:
    truth = np.array([(60.3, 55.2), (180.7, 61.4), (62.1, 178.8), (181.2, 180.3)])
    light = np.zeros((240, 240))
    for (u, v), brightness in zip(truth, (230, 120, 60, 45), strict=True):
        light += brightness * disk(240, u, v, 40, hole=24)
    found = blobs(photograph(light, 2))
    assert len(found) == 4
    # Measured 0.02 px; a grey centroid of the dimmest would have 0.05.
    assert np.max(distances(found, truth)) < 0.1


@pytest.mark.parametrize("threshold", ["auto", 100.0])
def test_disk_that_its_hole_breaks_into_four_is_one_blob(threshold: str | float) -> None:
    # The hole's corners reach over the rim.
    light = 180 * disk(120, 60.4, 59.7, 40, hole=27.5)
    found = blobs(photograph(light, 3), threshold=threshold)
    assert len(found) == 1
    assert distances(found, np.array([(60.4, 59.7)]))[0] < 0.2


def test_disk_behind_a_cable_and_with_a_nick_keeps_its_centre() -> None:
    light = 180 * disk(120, 60.4, 59.7, 40, hole=15)
    u, v = np.meshgrid(np.arange(120.0), np.arange(120.0))
    light[np.abs(u - 0.5 * v - 20) < 3] = 0
    light[(u > 80) & (v > 65)] = 0
    found = blobs(photograph(light, 4))
    # The nick hides a fifth of the disk: the centroid of what is left is 5 px off.
    assert distances(found, np.array([(60.4, 59.7)]))[0] < 0.15


def test_noise_on_oblique_disks_makes_no_two_spots_of_them() -> None:
    # flat on top, so that between their halves and their middle there is nothing but noise
    x, y = np.meshgrid(np.arange(-15.0, 16.0), np.arange(-15.0, 16.0))
    covered = gaussian_filter(((x / 10) ** 2 + (y / 6) ** 2 < 1).astype(float), 1.0)
    for seed in range(40):
        found = blobs(photograph(150 * np.pad(covered, 20), seed))
        assert len(found) == 1
        # what has no rim is put at the middle of its hull, 0.1 px off and more
        assert np.abs(found[0] - 35).max() < 0.05


def test_disk_half_in_shadow_keeps_its_centre() -> None:
    light = 180 * disk(120, 60.4, 59.7, 40)
    light[:, 55:] *= 0.3
    found = blobs(photograph(light, 5))
    assert len(found) == 1
    assert distances(found, np.array([(60.4, 59.7)]))[0] < 0.15


def test_spots_on_unevenly_lit_ground_are_found() -> None:
    u, v = np.meshgrid(np.arange(640.0), np.arange(480.0))
    truth = np.array([(100.2, 90.6), (320.5, 240.1), (560.7, 400.3), (580.4, 80.8)])
    light = 90 * np.exp(-((u - 330) ** 2 + (v - 230) ** 2) / 2 / 120**2) + 0.08 * u
    light += spots((480, 640), truth, 1.5, 80)
    for rule in ("auto", "local"):
        found = blobs(photograph(light, 6), threshold=rule)
        assert len(found) == 4, rule
        assert np.max(distances(found, truth)) < 0.1, rule


def dots_on_paper() -> tuple[Floats, Floats]:
    """Dots of radius 5 px on paper whose light falls off to a third, on a dark table."""
    truth = np.array([(u + 0.3, v + 0.4) for v in (60, 120, 180) for u in (60, 120, 180)])
    light = np.full((240, 240), 200.0)
    for u, v in truth:
        light -= 170 * disk(240, u, v, 5)
    light[:20] = light[-20:] = light[:, :20] = light[:, -20:] = 15
    return light * np.linspace(1, 0.35, 240), truth


@pytest.mark.parametrize("threshold", ["auto", "local"])
def test_dark_dots_on_paper_on_a_dark_table_are_found(threshold: str) -> None:
    light, truth = dots_on_paper()
    found = blobs(photograph(light, 7), polarity="dark", threshold=threshold)
    errors = distances(found, truth)
    assert len(found) == 9 or threshold == "local"
    assert np.max(errors) < 0.1


def test_bright_dots_on_a_grey_ball_are_found_and_not_the_ball() -> None:
    truth = np.array([(95.3, 110.6), (140.8, 92.4), (118.2, 150.1)])
    ball, dots = disk(240, 120.4, 119.7, 70), sum(disk(240, u, v, 7) for u, v in truth)
    found = blobs(photograph(30 * ball + 180 * dots, 4))
    assert found.shape == (3, 2)
    assert np.max(distances(found, truth)) < 0.1


def test_a_disk_with_one_highlight_is_one_disk() -> None:
    centre = np.array([(60.4, 59.7)])
    light = 40 * disk(120, 60.4, 59.7, 25) + spot((120, 120), 68.3, 52.1, 1.5, 160)
    found = blobs(photograph(light, 4))
    assert found.shape == (1, 2)
    assert np.max(distances(found, centre)) < 0.1


def test_spots_that_touch_come_apart() -> None:
    truth = np.array([(30.2, 30.7), (36.4, 31.5)])
    found = blobs(photograph(spots((60, 60), truth, 1.5, 150, 90), 8))
    assert len(found) == 2
    assert np.max(distances(found, truth)) < 0.12


@pytest.mark.parametrize(("peak", "gap"), [(150.0, 2.0), (150.0, 4.0), (400.0, 4.0)])
def test_disks_whose_light_runs_together_are_found_apart(peak: float, gap: float) -> None:
    # the brighter ones saturate to beyond their rims
    for seed in range(3):
        rng = np.random.default_rng(seed)
        turn, radii = rng.uniform(0, np.pi), (20.0, 17.0)
        half = (sum(radii) + gap) / 2 * np.array([np.cos(turn), np.sin(turn)])
        truth = 80 + rng.uniform(-0.5, 0.5, 2) + np.array([-half, half])
        fine = (np.mgrid[:1280, :1280] + 0.5) / 8 - 0.5
        covered = np.zeros((160, 160))
        for (u, v), radius in zip(truth, radii, strict=True):
            inside = (fine[1] - u) ** 2 + (fine[0] - v) ** 2 < radius**2
            covered = np.maximum(covered, inside.reshape(160, 8, 160, 8).mean(axis=(1, 3)))
        found = blobs(photograph(peak * gaussian_filter(covered, 1.6), seed))
        assert len(found) == 2
        # as good as two that lie apart, which are found to 0.04 px
        assert np.max(distances(found, truth)) < 0.08


def test_spot_that_the_border_cuts_is_left_out_and_a_disk_mostly_seen_is_not() -> None:
    cut = photograph(spot((80, 80), 0.6, 40, 2, 150), 9)
    assert len(blobs(cut)) == 0
    # A fifth of the diameter is out of the image, a third of the rim.
    light = 150 * disk(120, 22, 60, 36)
    found = blobs(photograph(light, 10))
    assert distances(found, np.array([(22, 60)]))[0] < 0.2


def test_areas_limit_what_counts_as_a_blob() -> None:
    light = 150 * (disk(160, 40, 40, 4) + disk(160, 100, 100, 20))
    image = photograph(light, 11)
    small, large = np.array([(40, 40)]), np.array([(100, 100)])
    # Areas: π·4²·0.85 = 43 px, and 1068 px.
    assert distances(blobs(image, min_area=200), large)[0] < 0.1
    assert len(blobs(image, min_area=200)) == 1
    assert distances(blobs(image, max_area=200), small)[0] < 0.1
    assert len(blobs(image, max_area=200)) == 1
    assert len(blobs(image, min_area=2000)) == 0


def test_dots_on_a_plate_in_shadow_are_found_where_the_plate_is_too_large() -> None:
    truth = np.array([(150.3, 100.6), (210.7, 120.2), (180.1, 170.4), (240.5, 190.8)])
    plate = np.zeros((300, 400))
    plate[70:230, 110:290] = 70  # a shape of its own, half as bright as the dots on it
    image = photograph(plate + spots((300, 400), truth, 3.0, 90), 20)
    assert len(blobs(image)) == 1
    found = blobs(image, max_area=400)
    assert len(found) == 4
    assert np.max(distances(found, truth)) < 0.1


def test_light_from_a_lamp_on_the_floor_is_no_blob_but_a_spot_on_it_is() -> None:
    u, v = np.meshgrid(np.arange(400.0), np.arange(300.0))
    pool = 60 * np.exp(-((u - 200) ** 2 + (v - 150) ** 2) / 2 / 25**2)
    truth = np.array([(210.3, 155.6), (50, 50)])
    found = blobs(photograph(pool + spots((300, 400), truth, 1.5, 170), 12))
    assert len(found) == 2
    assert np.max(distances(found, truth)) < 0.1


@pytest.mark.parametrize("value", [0, 37, 255])
@pytest.mark.parametrize("threshold", [*RULES, 100.0])
@pytest.mark.parametrize("polarity", ["bright", "dark"])
def test_even_frames_hold_no_blobs(value: int, threshold: str | float, polarity: str) -> None:
    image = np.full((50, 70), value, np.uint8)
    assert blobs(image, threshold=threshold, polarity=polarity).shape == (0, 2)


def test_noise_alone_holds_no_blobs() -> None:
    for seed in range(3):
        assert len(blobs(photograph(np.zeros((1024, 1280)), seed))) == 0


@pytest.mark.parametrize("shape", [(1, 1), (1, 40), (40, 1), (3, 3), (5, 9)])
def test_tiny_images_hold_no_blobs(shape: tuple[int, int]) -> None:
    image = np.random.default_rng(0).integers(0, 256, shape, dtype=np.uint8)
    for threshold in (*RULES, 10.0):
        assert blobs(image, threshold=threshold, min_area=20).shape == (0, 2)


def test_types_of_image_agree() -> None:
    truth = np.array([(30.3, 40.6), (90.2, 70.1)])
    image = photograph(spots((120, 120), truth, 1.6, 150) + 120 * disk(120, 85, 25, 12), 13)
    found = blobs(image)
    assert len(found) == 3
    np.testing.assert_allclose(blobs(image.astype(np.uint16) * 257), found, atol=0.02)
    np.testing.assert_allclose(blobs(image.astype(np.float32) / 255), found, atol=0.02)
    turned = np.asarray(255 - image.astype(np.int64), dtype=np.uint8)
    np.testing.assert_allclose(blobs(turned, polarity="dark"), found, atol=1e-9)


@pytest.mark.parametrize("polarity", ["bright", "dark"])
def test_grey_level_is_in_units_of_the_image(polarity: str) -> None:
    for dtype, scale in ((np.uint8, 1.0), (np.uint16, 200.0), (np.float32, 0.004)):
        light = spot((60, 60), 20.2, 30.4, 2, 150) + spot((60, 60), 40.2, 30.4, 2, 70) + 10
        grey = (light if polarity == "bright" else 200 - light) * scale
        found = blobs(grey.astype(dtype), threshold=100 * scale, polarity=polarity)
        assert len(found) == 1, dtype
        assert distances(found, np.array([(20.2, 30.4)]))[0] < 0.1


def test_edges_that_fix_no_ellipse_give_the_same_one_each_time() -> None:
    # OpenCV moves such points by chance; a run that goes on would not repeat its frames
    line = np.stack([np.arange(8.0), 2 * np.arange(8.0)], axis=1)[None]
    found = [fit_conics(line, np.ones((1, 8), np.bool_), 0.0).centre.tolist() for _ in range(3)]
    assert found[0] == found[1] == found[2]


@pytest.mark.parametrize("shown", [72, 30, 18])
def test_ellipses_of_many_rims_at_once_are_those_of_each_by_itself(shown: int) -> None:
    rng = np.random.default_rng(8)
    angles = np.linspace(0, 2 * np.pi, 72, endpoint=False)
    circle = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    axes, centres = rng.uniform(7.0, 12.0, (40, 1, 2)), rng.uniform(100.0, 1500.0, (40, 1, 2))
    rims = centres + axes * circle + rng.normal(0.0, 0.02, (40, 72, 2))
    chosen = np.tile(np.arange(72) < shown, (40, 1))
    chosen[0, 5:] = False  # too few
    together = fit_conics(rims, chosen, 0.15)
    assert together.is_ellipse.tolist() == [False] + 39 * [True]
    for k in range(1, 40):
        alone = fit_conics(rims[k : k + 1], chosen[k : k + 1], 0.15)
        # OpenCV computes in single precision, of which a quarter of a rim leaves less
        assert np.abs(alone.centre[0] - together.centre[k]).max() < 1e-3
        assert np.abs(np.sort(alone.half_axes[0]) - np.sort(together.half_axes[k])).max() < 1e-3
    exact = fit_conics(centres + axes * circle, chosen, 0.15)
    assert np.abs(exact.centre - centres[:, 0])[1:].max() < 1e-6


def test_blobs_in_a_window_are_those_of_the_whole_image() -> None:
    truth = np.array([(100.3, 140.6), (160.2, 170.1), (300.5, 200.5)])
    image = photograph(spots((400, 500), truth, 1.6, 150), 14)
    options = ExtractOptions()
    inside = points_of(extract(image, options, window=(80, 120, 200, 220)))
    assert len(inside) == 2
    whole = points_of(extract(image, options))
    assert np.max(distances(whole, inside)) < 0.01
    # Beyond the image there is nothing to see.
    assert len(points_of(extract(image, options, window=(-50, -50, 5000, 5000)))) == 3
    assert len(points_of(extract(image, options, window=(600, 0, 700, 50)))) == 0
    assert len(points_of(extract(image, options, window=(50, 60, 50, 60)))) == 0


def test_window_filled_by_one_disk_knows_the_background_around_it() -> None:
    image = photograph(150 * disk(300, 150.3, 149.6, 50), 15)
    found = points_of(extract(image, ExtractOptions(), window=(98, 98, 203, 203)))
    assert distances(found, np.array([(150.3, 149.6)]))[0] < 0.1


def test_image_is_left_as_it_was() -> None:
    image = photograph(spot((60, 60), 30, 30, 2, 150) + np.linspace(0, 60, 60), 16)
    before = image.copy()
    for method in METHODS:
        for polarity in ("bright", "dark"):
            extract(image, ExtractOptions(method=method, polarity=polarity))
    np.testing.assert_array_equal(image, before)
    image.setflags(write=False)
    assert len(blobs(image)) == 1


def test_strided_images_are_taken() -> None:
    image = photograph(spot((60, 60), 30.5, 20.5, 2, 150), 17)
    np.testing.assert_allclose(blobs(image.T.copy().T), blobs(image))
    mirrored = blobs(image[::-1, ::-1])
    np.testing.assert_allclose(59 - mirrored, blobs(image), atol=0.02)


@pytest.mark.parametrize("turns", range(4))
def test_a_spot_is_left_out_whichever_border_cuts_it(turns: int) -> None:
    light = spot((80, 80), 0.6, 40, 2, 150) + spot((80, 80), 40, 30, 2, 150)
    found = blobs(np.rot90(photograph(light, 9), turns).copy())
    # half of the spot is out of the image: its centroid would be off by a px
    assert len(found) == 1
    expected = [(40, 30), (30, 39), (39, 49), (49, 40)][turns]
    assert distances(found, np.array([expected]))[0] < 0.05


def test_a_hot_pixel_does_not_hide_spots_that_are_dim_beside_it() -> None:
    image = photograph(spot((80, 80), 30.4, 40.2, 1.6, 40), 18)
    image[60, 60] = 255
    # a fifth of the hot pixel's 235 above the background would be 47, more than the spot has
    assert distances(blobs(image), np.array([(30.4, 40.2)]))[0] < 0.15


def test_whole_grey_values_are_above_the_broken_level_below_them() -> None:
    image = np.full((40, 40), 20, np.uint8)
    image[10:15, 20:25] = 101
    for threshold, count in ((100.0, 1), (100.5, 1), (101.0, 0), (101.5, 0)):
        assert len(blobs(image, threshold=threshold)) == count, threshold


def test_disks_found_together_are_those_found_one_by_one() -> None:
    # one large, one small, one cut by a straight edge: rims of unlike reach, and of fewer points
    size, places = 300, ((70.3, 80.6, 30.0), (210.8, 90.2, 9.0), (120.4, 215.7, 16.0))
    alone = []
    light = np.zeros((size, size))
    for u, v, radius in places:
        own = disk(size, u, v, radius)
        own[:, : int(u - 0.6 * radius)] = 0
        light += 150 * own
        alone.append(blobs(photograph(150 * own, 5)))
    together = blobs(photograph(light, 5))
    assert len(together) == 3
    # noise is the same, as is every number but for the order of sums
    np.testing.assert_allclose(
        np.sort(together, axis=0), np.sort(np.concatenate(alone), axis=0), atol=1e-6
    )
