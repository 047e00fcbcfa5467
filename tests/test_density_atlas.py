"""Densities drawn as pages of one image and looked up by cv2.remap, against sums of Gaussians."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from mixpose.density import DRAWING, Atlas
from mixpose.density.atlas import Pages
from mixpose.objective.matched import FINE_STEPS, STEPS_PER_SIGMA
from mixpose.records import GridPattern, Pattern, PointPattern

Floats = NDArray[np.float64]

SIGMA = 2.0
"""Of the blur that is drawn: √2 σ_ε in the matched objective."""

MOST_OWN, REACH, TILE = DRAWING.own_tiles, DRAWING.reach, DRAWING.tile
STEPS = [2.5, STEPS_PER_SIGMA, 8.0]

CUT = math.exp(-(REACH**2) / 2)
"""Share of its peak at which a Gaussian may end, where its pages end."""


def looked_up(atlas: Atlas, y: Floats, sensor: int = 0) -> tuple[Floats, Floats]:
    """Densities (n,) and gradients (n, m) at places (n, m) of one sensor."""
    padded = np.zeros((len(atlas.per_unit), 1, len(y), 2))
    padded[sensor, 0, :, : y.shape[1]] = y
    found = atlas.look_up(padded)[sensor, 0]
    return found[:, 0], found[:, 1 : 1 + y.shape[1]]


def exact(points: Floats, y: Floats, sigma: float = SIGMA) -> tuple[Floats, Floats]:
    """The same of equal Gaussians about points (M, m), in closed form."""
    away = points - y[:, None]
    bells = np.exp(-0.5 * (away**2).sum(axis=2) / sigma**2)
    bells /= len(points) * (2 * np.pi * sigma**2) ** (y.shape[1] / 2)
    return bells.sum(axis=1), (bells[..., None] * away).sum(axis=1) / sigma**2


def peak(count: int, m: int = 2, sigma: float = SIGMA) -> float:
    return float((2 * np.pi * sigma**2) ** (-m / 2) / count)


def points_only(points: Floats, steps: float, sigma: float = SIGMA) -> Atlas:
    return Atlas([PointPattern(points, np.ones(len(points)))], [sigma], steps)


def far_apart(seed: int, side: int = 10) -> Floats:
    """Places 20 standard deviations apart, anywhere within a cell."""
    rng = np.random.default_rng(seed)
    u, v = np.meshgrid(20 * SIGMA * np.arange(side), 20 * SIGMA * np.arange(side))
    return np.stack([u.ravel(), v.ravel()], axis=1) + rng.uniform(0, SIGMA, (side**2, 2))


def spline_error(steps: float, derivative: float) -> float:
    """By how much a look-up errs along one axis, of the peak and in σ, for a third derivative.

    A share t of the way between two cells h apart, a quadratic spline whose coefficients are the
    values errs by h³ B₃(t)/6 of the third derivative, with the Bernoulli polynomial B₃ of t, at
    most √3/36; what it blurs on average is drawn narrower.  A part for what follows; single
    precision.
    """
    return (1 + 0.4 / steps) * math.sqrt(3) / 216 / steps**3 * derivative + 1e-6


# of a Gaussian, in peaks: its steepest slope, and its derivatives of third and of fourth order
SLOPE, THIRD, FOURTH = 0.61, 1.38, 3.0


@pytest.mark.parametrize("steps", STEPS)
def test_gradients_of_features_apart_are_zero_where_the_detections_are(steps: float) -> None:
    points = far_apart(1)
    atlas = points_only(points, steps)
    value, gradient = looked_up(atlas, points)
    away = SIGMA * gradient / value[:, None]
    # coordinates of an array of some thousand rows are rounded to 2⁻¹³ cells
    most = spline_error(steps, FOURTH) + 2**-13 / steps
    assert np.abs(away).max() < most
    # and no systematic shift: 200 numbers that are as likely to either side
    assert np.abs(away.mean()) < most / 5


@pytest.mark.parametrize("apart", [None, 3.5, 4.0, 4.5, 5.0, 5.5, 6.0, 6.5, 7.0])
def test_where_estimates_end_places_are_off_by_a_thousandth_of_sigma(apart: float | None) -> None:
    # a feature alone, and two that draw each other: to where exact sums have their peak
    rng = np.random.default_rng(11)
    points = far_apart(11)
    if apart is not None:
        turns = rng.uniform(0, 2 * np.pi, len(points))
        towards = np.stack([np.cos(turns), np.sin(turns)], axis=1)
        points = np.concatenate([points, points + apart * SIGMA / math.sqrt(2) * towards])
    atlas = points_only(points, STEPS_PER_SIGMA)
    densities: list[Callable[[Floats], tuple[Floats, Floats]]] = [
        lambda y: looked_up(atlas, y),
        lambda y: exact(points, y),
    ]
    ends = []
    for density in densities:
        y = points + np.random.default_rng(11).uniform(-0.1, 0.1, points.shape)
        for _ in range(40):  # mean-shift; features that draw each other slow it down
            value, gradient = density(y)
            y = y + SIGMA**2 * gradient / value[:, None]
        ends.append(y)
    off = np.linalg.norm(ends[0] - ends[1], axis=1).max() * math.sqrt(2) / SIGMA
    assert off < 1.05e-3  # σ_ε


@pytest.mark.parametrize("steps", STEPS)
@pytest.mark.parametrize("apart", [2.0, 3.0, 4.0, 5.0, 6.0])
def test_gradients_of_pairs_are_those_of_two_gaussians(apart: float, steps: float) -> None:
    # features of σ_ε = SIGMA / √2, 2 to 6 σ_ε apart, looked up within σ_ε of either
    rng = np.random.default_rng(2)
    first = far_apart(2)
    turns = rng.uniform(0, 2 * np.pi, len(first))
    towards = np.stack([np.cos(turns), np.sin(turns)], axis=1)
    points = np.concatenate([first, first + apart * SIGMA / math.sqrt(2) * towards])
    y = points + rng.uniform(-0.5, 0.5, points.shape) * SIGMA
    value, gradient = looked_up(points_only(points, steps), y)
    expected_value, expected = exact(points, y)
    top = peak(len(points))
    # of either, along the gradient and across; where it ends
    bend = 2 * spline_error(steps, FOURTH + SLOPE * THIRD) + REACH * CUT
    assert np.abs(gradient - expected).max() < bend * top / SIGMA
    assert np.abs(value - expected_value).max() < (2 * 2 * spline_error(steps, THIRD) + CUT) * top


@pytest.mark.parametrize("m", [1, 2])
@pytest.mark.parametrize("steps", STEPS)
def test_values_err_by_the_third_derivative_within_a_cell(steps: float, m: int) -> None:
    rng = np.random.default_rng(3)
    points = far_apart(3)
    if m == 1:
        points = 20 * SIGMA * rng.permutation(30).astype(np.float64)[:, None]
    y = np.repeat(points, 20, axis=0)
    y = y + rng.uniform(0.1 - REACH, REACH - 0.1, y.shape) * SIGMA
    value, gradient = looked_up(points_only(points, steps), y)
    expected_value, expected = exact(points, y)
    top = peak(len(points), m)
    assert np.abs(value - expected_value).max() < m * spline_error(steps, THIRD) * top
    bend = spline_error(steps, FOURTH + (m - 1) * SLOPE * THIRD)
    assert np.abs(gradient - expected).max() < bend * top / SIGMA


@pytest.mark.parametrize("steps", STEPS)
@pytest.mark.parametrize("m", [1, 2])
def test_a_drawn_density_integrates_to_one(steps: float, m: int) -> None:
    points = np.random.default_rng(4).uniform(0, 12 * SIGMA, (9, m))
    h = SIGMA / steps / 2.5
    axes = [np.arange(-8 * SIGMA, 20 * SIGMA, h)] * m
    y = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, m)
    integral = looked_up(points_only(points, steps), y)[0].sum() * h**m
    # what lies within the reach along each axis is drawn, and the rest of its pages
    assert math.erf(REACH / math.sqrt(2)) ** m - 1e-4 < integral < 1 + 1e-4


def grey_values() -> GridPattern:
    v, u = np.mgrid[:60, :80]
    spots = [(20.3, 25.7), (47.1, 33.4), (55.6, 12.2)]
    image = sum(np.exp(-0.5 * ((u - a) ** 2 + (v - b) ** 2) / 1.5**2) for a, b in spots)
    return GridPattern(np.asarray(image, dtype=np.float32), np.array([100.0, 50.0]), 1.0)


def test_grey_values_are_sums_over_pixels() -> None:
    pattern = grey_values()
    v, u = np.mgrid[:60, :80]
    pixels = np.stack([u.ravel(), v.ravel()], axis=1) + pattern.origin
    weights = pattern.values.ravel() / pattern.values.sum(dtype=np.float64)
    y = np.random.default_rng(5).uniform((100, 50), (179, 109), (500, 2))
    squared = ((pixels - y[:, None]) ** 2).sum(axis=2)
    expected = np.exp(-0.5 * squared / SIGMA**2) @ weights / (2 * np.pi * SIGMA**2)
    atlas = Atlas([pattern], [SIGMA], 8.0)
    looked_up(atlas, y[:5])
    few = atlas.values.size
    value, gradient = looked_up(atlas, y)
    # spots of standard deviation 1.5 blurred by 2 bend less than the blur alone
    assert np.abs(value - expected).max() < 2 * spline_error(8.0, THIRD) * expected.max()
    # what is not looked up is not drawn
    assert few < atlas.values.size
    assert np.abs(gradient).max() > 0


def test_grey_values_drawn_finely_have_their_gradients_to_the_last_digits() -> None:
    sigma, blur, step = 4.0, 3.0, 0.8
    for m in (1, 2):
        place = np.array([31.3, 24.8])[:m]
        axes = [step * np.arange(80.0), step * np.arange(70.0)][:m]
        bells = [np.exp(-0.5 * ((a - p) / sigma) ** 2) for a, p in zip(axes, place, strict=True)]
        values = bells[0][None] if m == 1 else np.outer(bells[1], bells[0])
        pattern = GridPattern(values.astype(np.float32), np.zeros(m), step)
        y = place + np.array([[0.0, 0.0], [2.1, -1.3], [-3.3, 4.0]])[:, :m]
        atlas = Atlas([pattern], [blur], FINE_STEPS)
        # a Gaussian blurred by a Gaussian is a Gaussian
        both = math.hypot(sigma, blur)
        C, slope = exact(place[None], y, both)
        value, gradient = looked_up(atlas, y)
        # single precision and the cut at 6 sigma are left
        np.testing.assert_allclose(value, C, rtol=2e-5)
        np.testing.assert_allclose(gradient, slope, atol=2e-5 * C.max())


def test_few_places_have_tiles_that_they_stay_in_for_half_a_tile() -> None:
    points = far_apart(12, side=3)
    atlas = points_only(points, STEPS_PER_SIGMA)
    half = TILE / 2 * SIGMA / STEPS_PER_SIGMA
    looked_up(atlas, points)
    drawn = atlas.values
    assert drawn.size == len(points) * (TILE + 3) ** 2 * 3
    for turn in np.linspace(0, 2 * np.pi, 9):
        # tiles are drawn around whole cells
        looked_up(atlas, points + 0.95 * half * np.array([np.cos(turn), np.sin(turn)]))
        assert atlas.values is drawn
    looked_up(atlas, points + 1.05 * half)
    assert atlas.values is not drawn


def test_what_is_seen_beside_a_tile_is_on_it_as_far_as_it_reaches() -> None:
    first = far_apart(15, side=5)
    beside = first + np.array([6.2 * SIGMA, 0])
    points = np.concatenate([first, beside])
    atlas = points_only(points, STEPS_PER_SIGMA)
    looked_up(atlas, first)
    drawn = atlas.values
    # nearly at the edge of its tile, 3.4 σ from what is beside it
    y = first + np.array([2.8 * SIGMA, 0])
    value, _ = looked_up(atlas, y)
    assert atlas.values is drawn
    # the third derivative is 3.4³ times the value at most, of each of two
    top = peak(len(points))
    most = exact(points, y)[0].max() / top
    off = (spline_error(STEPS_PER_SIGMA, 2 * 3.4**3 * most) + 2 * CUT) * top
    assert off < 0.3 * math.exp(-(3.4**2) / 2) * top
    np.testing.assert_allclose(value, exact(points, y)[0], atol=off)


def test_few_places_and_many_are_looked_up_alike() -> None:
    rng = np.random.default_rng(14)
    points = far_apart(14, side=4)
    y = np.repeat(points, 100, axis=0)
    y += rng.uniform(-3, 3, y.shape) * SIGMA
    assert len(y) > MOST_OWN
    atlas = points_only(points, STEPS_PER_SIGMA)
    value, gradient = looked_up(atlas, y)
    for some in np.split(np.arange(len(y)), 4):
        few, slope = looked_up(atlas, y[some])
        # coordinates in an array of up to 2048 rows are rounded to 6e-5 cells
        off = 2 * 6e-5 / STEPS_PER_SIGMA * value.max()
        np.testing.assert_allclose(few, value[some], atol=off)
        np.testing.assert_allclose(slope, gradient[some], atol=off / SIGMA)


def test_many_detections_looked_up_a_few_at_a_time_are_all_there() -> None:
    # more pages than one column of the array takes, in pieces of one row and of several
    points = far_apart(13, side=62)
    atlas = points_only(points, STEPS_PER_SIGMA)
    rng = np.random.default_rng(13)
    top = peak(len(points))
    for some in np.split(rng.permutation(len(points)), [MOST_OWN + 1, 2 * MOST_OWN + 2]):
        y = points[some] + rng.uniform(-0.5, 0.5, (len(some), 2)) * SIGMA
        value, _ = looked_up(atlas, y)
        off = 2 * spline_error(STEPS_PER_SIGMA, THIRD) * top
        np.testing.assert_allclose(value, exact(points, y)[0], atol=off)
    np.testing.assert_allclose(looked_up(atlas, points)[0], top, rtol=0.02)
    assert atlas.values.shape[1] > TILE + 3


def test_pages_join_without_a_seam() -> None:
    points = far_apart(6, side=4)
    atlas = points_only(points, STEPS_PER_SIGMA)
    step = SIGMA / STEPS_PER_SIGMA
    # pages begin at whole ones from sensor coordinates 0
    borders = np.arange(0.0, points[:, 0].max(), TILE * step)
    beside = 1e-4 * step
    crossed = 0
    for x in borders:
        near = points[np.abs(points[:, 0] - x) < 2 * SIGMA]
        left, right = (near.copy() for _ in range(2))
        left[:, 0], right[:, 0] = x - beside, x + beside
        left, right = (np.tile(one, (MOST_OWN, 1)) for one in (left, right))
        crossed += len(near)
        (a, da), (b, db) = looked_up(atlas, left), looked_up(atlas, right)
        # on either side of a border, 2e-4 of a cell apart, a value changes by its slope and no
        # more; coordinates in an array of some hundred rows are rounded to 2e-5 cells
        top = peak(len(points))
        assert np.abs(a - b).max(initial=0.0) < 4 * beside / SIGMA * top
        assert np.abs(da - db).max(initial=0.0) < 8 * beside / SIGMA * top / SIGMA
    assert crossed > 2


@pytest.mark.parametrize("steps", STEPS)
@pytest.mark.parametrize("m", [1, 2])
def test_a_detection_counts_once_wherever_the_origin_is(m: int, steps: float) -> None:
    rng = np.random.default_rng(7)
    for scale in (0.1, 1.0, 10.0, 1000.0):
        for _ in range(20):
            point = rng.normal(0, scale, (1, m))
            value, _ = looked_up(points_only(point, steps), point)
            # where rounding puts it on two pages that are one, it is twice as high
            assert value[0] == pytest.approx(peak(1, m), rel=m * spline_error(steps, THIRD))


def test_ranges_and_images_lie_in_one_atlas_as_each_alone() -> None:
    rng = np.random.default_rng(8)
    image = PointPattern(rng.uniform(0, 600, (6, 2)), np.ones(6))
    ranges = PointPattern(rng.uniform(3, 9, (4, 1)), rng.uniform(1, 2, 4))
    profile = GridPattern(rng.uniform(0, 1, (1, 200)).astype(np.float32), np.array([900.0]), 0.5)
    patterns: list[Pattern] = [image, ranges, profile, grey_values()]
    sigmas = [2.0, 0.3, 3.0, 2.0]
    together = Atlas(patterns, sigmas, STEPS_PER_SIGMA)
    places = [
        image.points + rng.normal(0, 1, (6, 2)),
        np.repeat(ranges.points, 2, axis=0) + rng.normal(0, 0.3, (8, 1)),
        rng.uniform(900, 1000, (7, 1)),
        rng.uniform((100, 50), (179, 109), (9, 2)),
    ]
    for k, (pattern, sigma, y) in enumerate(zip(patterns, sigmas, places, strict=True)):
        alone = Atlas([pattern], [sigma], STEPS_PER_SIGMA)
        value, gradient = looked_up(together, y, k)
        expected, expected_gradient = looked_up(alone, y)
        # cells begin elsewhere: both err, of m axes
        top = expected.max()
        assert np.abs(value - expected).max() < 2 * 2 * spline_error(STEPS_PER_SIGMA, THIRD) * top
        bend = 2 * spline_error(STEPS_PER_SIGMA, FOURTH + SLOPE * THIRD)
        assert np.abs(gradient - expected_gradient).max() < bend * top / sigma
        # where the one-dimensional ones have a second coordinate, it does not pull
        padded = np.zeros((4, 1, len(y), 2))
        padded[k, 0, :, : y.shape[1]] = y
        if y.shape[1] == 1:
            assert not together.look_up(padded)[k, 0, :, 2].any()


def test_detections_far_outside_neither_take_memory_nor_hide_the_others() -> None:
    rng = np.random.default_rng(9)
    near = rng.uniform(100, 500, (8, 2))
    alone = points_only(near, STEPS_PER_SIGMA)
    expected = looked_up(alone, near)[0] * 8 / 9
    for far in ([1e7, 200.0], [-1e7, 1e7], [300.0, 1e12]):
        points = np.concatenate([near, [far]])
        atlas = points_only(points, STEPS_PER_SIGMA)
        value, _ = looked_up(atlas, near)
        # cells begin elsewhere, along two axes, each
        np.testing.assert_allclose(value, expected, rtol=4 * spline_error(STEPS_PER_SIGMA, THIRD))
        many, _ = looked_up(atlas, np.tile(near, (MOST_OWN, 1)))
        np.testing.assert_allclose(many[: len(near)], value, rtol=1e-5)
        assert len(atlas.pages.table) < 1.1 * DRAWING.held
        assert atlas.values.nbytes < 2e6
    several = points_only(rng.uniform(-1e7, 1e7, (20, 2)), STEPS_PER_SIGMA)
    looked_up(several, np.tile(near, (MOST_OWN, 1)))
    assert several.values.nbytes < 2e6


@pytest.mark.parametrize("steps", STEPS)
def test_a_detection_is_drawn_well_beyond_where_features_are_met(steps: float) -> None:
    # features are met within 1.55 standard deviations; what reaches farther draws a neighbour, in
    # the prediction as in the observation
    z = 3.4
    points = far_apart(11, side=5)
    atlas = points_only(points, steps)
    for turn in np.linspace(0, 2 * np.pi, 12, endpoint=False):
        y = points + z * SIGMA * np.array([np.cos(turn), np.sin(turn)])
        value, gradient = looked_up(atlas, y)
        expected, slope = exact(points, y)
        # the third derivative is z³ times the value at most, and twice that within a cell
        off = (spline_error(steps, 2 * z**3) + 2e-6) * expected.max()
        np.testing.assert_allclose(value, expected, atol=off)
        np.testing.assert_allclose(gradient, slope, atol=z * off / SIGMA)


def test_where_nothing_is_drawn_the_density_is_zero() -> None:
    atlas = points_only(far_apart(10, side=3), STEPS_PER_SIGMA)
    outside = np.array([[-1e6, -1e6], [1e12, 3.0], [300.0, 300.0], [10 * SIGMA, 10 * SIGMA]])
    value, gradient = looked_up(atlas, outside)
    assert not value.any()
    assert not gradient.any()


def test_pages_of_many_sensors_lie_in_an_array_that_can_be_looked_up() -> None:
    # fifteen cameras whose detections are far apart; cv2.remap takes less than 32767 a side
    far_apart = np.array([[0.0, 0.0], [11_900.0, 11_900.0]])
    assert max(Pages(far_apart, [], TILE, 17.0, 15).values.shape) < 32767


def test_more_places_than_pages_of_a_wide_blur_are_looked_up_on_pages() -> None:
    # 300 places on a plane of about 6 by 6 pages; tiles of their own would be drawn for each
    rng = np.random.default_rng(4)
    points, y = rng.uniform(0, 25 * SIGMA, (2, 300, 2))
    atlas, few = points_only(points, STEPS_PER_SIGMA), points_only(points, STEPS_PER_SIGMA)
    values, _ = looked_up(atlas, y)
    assert "pages" in vars(atlas)
    own, _ = looked_up(few, y[:10])
    assert "pages" not in vars(few)
    # both cut Gaussians where their tiles end
    np.testing.assert_allclose(values[:10], own, atol=300 * CUT * peak(300))
    np.testing.assert_allclose(values, exact(points, y)[0], rtol=0.01)
