"""A pose near a start, through narrowing blurs."""

from __future__ import annotations

import numpy as np
import pytest
from detections import ALL_FREE, EIGHT, TRUTH, detect, interpolation_bound, random_start, view_of

from mixpose.body import Body, PointFeature
from mixpose.density import Observation
from mixpose.fit import EstimatorOptions, Fit, FitRules, blur_schedule, fit_near
from mixpose.fit.probable import Likelihood, likelihood_at, most_probable
from mixpose.objective import NormalPrior, View, matched_objective
from mixpose.records import Floats, GridPattern
from mixpose.rigid import perturb, twist_between
from mixpose.sensors import ParallelBeam, PinholeCamera


def test_exact_detections_give_the_exact_pose(pinhole_cameras: list[PinholeCamera]) -> None:
    views = detect(pinhole_cameras, EIGHT, TRUTH)
    fit = fit_near(
        views,
        EIGHT,
        random_start(1),
        np.repeat([6, 0.05], 3),
        EstimatorOptions(),
        EIGHT.means[:, None],
    )
    twist = np.abs(twist_between(TRUTH, fit.T_world_object))
    bound = interpolation_bound(views, EIGHT, TRUTH, ALL_FREE)
    assert (twist < bound).all()
    # a three-hundredth of the 0.2 px that detections err by as a rule
    assert np.linalg.norm(twist[:3]) < 2e-3
    assert np.degrees(np.linalg.norm(twist[3:])) < 2e-3


def test_blurs_narrow_from_what_the_start_may_be_off_by_to_the_finest(
    pinhole_cameras: list[PinholeCamera],
) -> None:
    camera = pinhole_cameras[0]
    views = [view_of("0", camera, camera.project(EIGHT.means + TRUTH[:3, 3])[0], sigma=1.5)]
    uncertainty = np.array([9.0, 9.0, 0.0, 0.0, 0.0, 0.0])
    levels = np.array(blur_schedule(views, EIGHT, TRUTH, uncertainty))[:, 0]
    at = camera.linearise(EIGHT.means @ TRUTH[:3, :3].T + TRUTH[:3, 3])[1]
    # root mean square of what moves along two axes in the image
    off = 9.0 * np.sqrt((at[..., :2] ** 2).sum(axis=2).mean())
    assert levels[0] == pytest.approx(off, rel=1e-6)
    assert levels[-1] == pytest.approx(1.5)
    assert (levels[:-1] / levels[1:]).max() <= 1.8 + 1e-9
    assert (np.diff(levels) < 0).all()


def test_no_blur_is_wider_than_a_tenth_of_what_is_seen(
    pinhole_cameras: list[PinholeCamera],
) -> None:
    views = detect(pinhole_cameras, EIGHT, TRUTH)
    levels = blur_schedule(views, EIGHT, TRUTH, np.repeat([1e3, 3.0], 3), FitRules())
    for view, widest in zip(views, levels[0], strict=True):
        lower, upper = view.observation.extent
        assert widest == pytest.approx(0.1 * (upper - lower).max())


def test_a_start_twenty_pixels_off_is_corrected(pinhole_cameras: list[PinholeCamera]) -> None:
    # 20 px are ten widths of the finest density: it pulls at nothing there
    views = detect(pinhole_cameras, EIGHT, TRUTH)
    start = perturb(TRUTH, np.array([12.0, -12.0, 12.0, 0.0, 0.0, 0.0]))
    u = np.repeat([12.0, 0.02], 3)
    fit = fit_near(views, EIGHT, start, u, EstimatorOptions(), EIGHT.means[:, None])
    twist = np.abs(twist_between(TRUTH, fit.T_world_object))
    assert (twist < interpolation_bound(views, EIGHT, TRUTH, ALL_FREE)).all()


def test_a_start_that_leads_where_another_did_is_given_the_very_same_fit(
    pinhole_cameras: list[PinholeCamera],
) -> None:
    views, climbed = detect(pinhole_cameras, EIGHT, TRUTH), list[Fit]()
    far = perturb(TRUTH, np.array([0.0, 0.0, 0.0, 0.0, 0.0, 2.0]))  # at another maximum
    first, again, elsewhere = (
        fit_near(
            views,
            EIGHT,
            start,
            np.repeat([6, 0.05], 3),
            EstimatorOptions(),
            EIGHT.means[:, None],
            climbed=climbed,
        )
        for start in (random_start(1), random_start(2), far)
    )
    assert again is first
    assert elsewhere is not first
    assert np.linalg.norm(twist_between(TRUTH, elsewhere.T_world_object)) > 0.1


DOT = Body("dot", (PointFeature(np.zeros(3)),))
BEAM = ParallelBeam(1.0, np.array([40.0, 40.0]), (81, 81), np.eye(4))
PLACE = np.array([1.3, -0.6])
NOISE = 0.1


def grey(seed: int) -> tuple[View, Floats]:
    """A spot of height 1 and σ = 2 px in white noise, and the noisy image."""
    v, u = np.mgrid[:81, :81] - 40.0
    spot = np.exp(-((u - PLACE[0]) ** 2 + (v - PLACE[1]) ** 2) / 8)
    image = spot + NOISE * np.random.default_rng(seed).standard_normal(spot.shape)
    pattern = GridPattern(image.astype(np.float32), np.zeros(2), 1.0)
    return View("grey", BEAM, Observation(pattern, 2.0, intrinsic=2.0)), image


def shifted(x: float, y: float) -> Floats:
    return perturb(np.eye(4), np.array([x, y, 0, 0, 0, 0]))


def likelihood(view: View, misfit: float = 1.0) -> Likelihood:
    objective = matched_objective([view], DOT, [view.observation.sigma])
    return likelihood_at(objective, shifted(*PLACE), misfit)


def explained(image: Floats, x: float, y: float) -> float:
    """Energy of an image that a spot explains at a place, at its best height."""
    v, u = np.mgrid[:81, :81] - 40.0
    h = np.exp(-((u - x) ** 2 + (v - y) ** 2) / 8)
    return float((image * h).sum() ** 2 / (h**2).sum())


@pytest.mark.parametrize("misfit", [1.0, 4.0])
def test_the_likelihood_is_that_of_white_noise_of_every_pixel(misfit: float) -> None:
    view, image = grey(0)
    places = ((1.3, -0.6), (2.0, -0.6), (1.3, 0.8))
    found = likelihood(view, misfit).objective.value(np.stack([shifted(*p) for p in places]))
    # squares left over twice the variance of a pixel, which is what the first place leaves
    energies = np.array([explained(image, *place) for place in places])
    variance = ((image**2).sum() - energies[0]) / image.size
    expected = energies / (2 * variance * misfit)
    # single precision
    assert found == pytest.approx(expected, rel=1e-5)


def test_a_place_that_explains_less_than_half_of_the_image_may_have_rivals() -> None:
    view, image = grey(1)
    found = likelihood(view)
    share = explained(image, *PLACE) / (image**2).sum()
    assert found.shares[0] == pytest.approx(share, rel=1e-5)
    assert share < 0.25
    assert not found.is_alone


def test_a_start_that_is_known_better_than_the_image_tells_stays() -> None:
    view, _ = grey(2)
    options = EstimatorOptions(free=("x", "y"))
    ends = {}
    for known in (1e-4, 10.0):
        u = np.array([known, known, 0.0, 0.0, 0.0, 0.0])
        fit = fit_near([view], DOT, shifted(1.0, 0.0), u, options, np.zeros((1, 1, 3)))
        ends[known] = fit.T_world_object[:2, 3]
    # the image fixes the place to noise / (height √π) along each axis: ∫ (∂h/∂u)² is π
    np.testing.assert_allclose(ends[1e-4], [1.0, 0.0], atol=1e-3)
    np.testing.assert_allclose(ends[10.0], PLACE, atol=4 * NOISE / np.sqrt(np.pi))


def test_spots_of_grey_values_that_overlap_give_the_pose_to_the_last_digits() -> None:
    pair = Body("pair", (PointFeature(np.zeros(3)), PointFeature(np.array([5.0, 1.0, 0.0]))))
    v, u = np.mgrid[:81, :81] - 40.0
    image = np.zeros(u.shape)
    for x, y in PLACE + pair.means[:, :2]:
        image += np.exp(-((u - x) ** 2 + (v - y) ** 2) / 8)
    pattern = GridPattern(image.astype(np.float32), np.zeros(2), 1.0)
    view = View("grey", BEAM, Observation(pattern, 2.0, intrinsic=2.0))
    options, u6 = EstimatorOptions(free=("x", "y")), np.array([1.0, 1.0, 0, 0, 0, 0])
    fit = fit_near([view], pair, shifted(1.0, 0.0), u6, options, np.zeros((2, 1, 3)))
    # noise of cells is that of single precision: nothing but the look-up is left, which at 256
    # cells per standard deviation errs by 1e-5 of a slope
    np.testing.assert_allclose(fit.T_world_object[:2, 3], PLACE, atol=1e-4)


def test_spots_that_overlap_and_are_not_equally_bright_pull_each_other_no_more() -> None:
    pair = Body("pair", (PointFeature(np.zeros(3)), PointFeature(np.array([5.0, 1.0, 0.0]))))
    v, u = np.mgrid[:81, :81] - 40.0
    image = 0.01 * np.random.default_rng(0).standard_normal(u.shape)
    for bright, (x, y) in zip((1.0, 0.7), PLACE + pair.means[:, :2], strict=True):
        image += bright * np.exp(-((u - x) ** 2 + (v - y) ** 2) / 8)
    pattern = GridPattern(image.astype(np.float32), np.zeros(2), 1.0)
    view = View("grey", BEAM, Observation(pattern, 2.0, intrinsic=2.0))
    options, u6 = EstimatorOptions(free=("x", "y")), np.array([1.0, 1.0, 0, 0, 0, 0])
    fit = fit_near([view], pair, shifted(1.0, 0.0), u6, options, np.zeros((2, 1, 3)))
    # of two spots the place is known to noise / (height √2π); with one height it is 0.2 px off
    np.testing.assert_allclose(fit.T_world_object[:2, 3], PLACE, atol=4 * 0.01 / np.sqrt(2 * np.pi))
    objective = matched_objective([view], pair, [view.observation.sigma])
    prior = NormalPrior(shifted(1.0, 0.0), np.full(6, 1.0), u6 > 0)
    equal = most_probable(objective, fit.T_world_object, prior)
    assert np.abs(equal[:2, 3] - PLACE).max() > 0.1
