"""Bodies that do not fit: what they leave of a density, and the fit to features set free."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from mixpose.body import Body, PointFeature
from mixpose.density import peak
from mixpose.fit.probable import LabelledPlaces, SensorDensity, fit_freed, misfit, own_peaks
from mixpose.objective import BodyProjection, project_body
from mixpose.rigid import perturb, transform, twist_between
from mixpose.sensors import ParallelBeam

Floats = NDArray[np.float64]

FREE = np.ones(6, dtype=np.bool_)
SIGMA = 3.0
VARIANCE = 2 * SIGMA**2
POINTS = np.array(
    [[0, 0, 0], [60, 5, 10], [-40, 50, -12], [-30, -55, 25], [36, 40, 52], [22, -35, -48]], float
)


def beam(turned: bool) -> ParallelBeam:
    T = np.eye(4)
    if turned:
        T[:3, :3] = [[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]]
    return ParallelBeam(1.0, np.array([100.0, 100.0]), (201, 201), T)


BEAMS = beam(False), beam(True)


def gaussians(centres: Floats) -> Callable[[Floats], Floats]:
    """The matched density of equal features: values and gradients in closed form."""

    def density(y: Floats) -> Floats:
        away = centres - y[:, None]
        bells = np.exp(-0.5 * (away**2).sum(axis=2) / VARIANCE) * peak(VARIANCE, 2) / len(centres)
        return np.column_stack(
            [bells.sum(axis=1), (bells[..., None] * away).sum(axis=1) / VARIANCE]
        )

    return density


def seen(sensor: ParallelBeam, centres: Floats, noise: float = 1e-6) -> SensorDensity:
    """`noise`: the standard deviation of the density, as a share of a feature's height."""
    top = peak(VARIANCE, 2)
    cell = (noise * top / len(centres)) ** 2 / top
    extent = np.zeros(2), np.full(2, 200.0)
    return SensorDensity(sensor, gaussians(centres), VARIANCE, cell, extent)


def projection(points: Floats = POINTS) -> BodyProjection:
    return project_body(BEAMS, Body("body", tuple(PointFeature(point) for point in points)))


def projected(points: Floats = POINTS) -> list[Floats]:
    return [sensor.project(points)[0] for sensor in BEAMS]


def deformed(size: float, seed: int = 3) -> list[Floats]:
    rng = np.random.default_rng(seed)
    return projected(POINTS + size * rng.standard_normal(POINTS.shape))


def test_a_body_that_fits_leaves_nothing_also_where_its_features_overlap() -> None:
    near = np.array([[100.0, 100.0], [105.0, 100.0], [150.0, 150.0]])
    rest, heights = seen(BEAMS[0], near).residuals(near)
    np.testing.assert_allclose(rest / heights.mean(), 0.0, atol=1e-7)
    # of three equal features each has a third of the height
    np.testing.assert_allclose(heights, peak(VARIANCE, 2) / 3, rtol=1e-6)


def test_features_that_overlap_have_heights_of_their_own() -> None:
    # twice as much at the first place as at the second: three equal features, two in one
    near = np.array([[100.0, 100.0], [105.0, 100.0]])
    rest, heights = seen(BEAMS[0], near[[0, 0, 1]]).residuals(near)
    np.testing.assert_allclose(rest / heights.mean(), 0.0, atol=1e-7)
    assert heights[0] / heights[1] == pytest.approx(2.0, rel=1e-6)


def test_gradients_that_are_left_are_in_units_of_the_height() -> None:
    # one of two is 0.3 widths off: r exp(-r²/2) is left of its gradient
    places = np.array([[50.0, 50.0], [150.0, 150.0]])
    off = places + np.array([[0.3 * np.sqrt(VARIANCE), 0.0], [0.0, 0.0]])
    rest, heights = seen(BEAMS[0], off).residuals(places)
    assert rest[0, 0] / heights[1] == pytest.approx(0.3 * np.exp(-0.045), rel=1e-6)
    assert rest[1, 0] / heights[1] == pytest.approx(0.0, abs=1e-9)


def test_the_misfit_is_the_squares_left_per_coordinate_that_is_left() -> None:
    found = [seen(one, y, noise=0.01) for one, y in zip(BEAMS, deformed(1.0), strict=True)]
    squares = 0.0
    for one, y in zip(found, projected(), strict=True):
        rest, heights = one.residuals(y)
        squares += float((rest**2).sum()) / (one.noise() ** 2 + (heights.mean() / 512) ** 2)
    # two gradients at 6 features in 2 sensors, less a pose
    assert misfit(found, POINTS, 6) == pytest.approx(squares / (24 - 6))
    assert misfit(found, POINTS, 6) > 3


def test_what_may_be_noise_is_no_misfit() -> None:
    found = [seen(one, y, noise=0.5) for one, y in zip(BEAMS, deformed(1.0), strict=True)]
    assert misfit(found, POINTS, 6) == 1.0


def test_each_feature_finds_its_own_peak() -> None:
    y = deformed(1.0)[0]
    found = own_peaks(seen(BEAMS[0], y), len(y))
    assert found is not None
    away = np.linalg.norm(found[:, None] - y, axis=2)
    assert away.min(axis=0).max() < 1e-6
    assert sorted(away.argmin(axis=1).tolist()) == list(range(6))


def test_a_feature_that_is_half_as_high_as_the_others_has_no_peak_of_its_own() -> None:
    places = np.array([[50.0, 50.0], [50.0, 150.0], [150.0, 50.0], [150.0, 150.0]])
    # three of four blobs hold two detections each, the last holds one: a fifth is as high as that
    crowd = np.concatenate([places[:3], places[:3], places[3:], [[100.0, 100.0]]])
    assert own_peaks(seen(BEAMS[0], crowd), 4) is None
    assert own_peaks(seen(BEAMS[0], places), 5) is None


def test_places_go_to_the_features_nearest_to_them() -> None:
    order = [3, 1, 5, 0, 2, 4]
    places = np.array([y[order] for y in projected()])
    unknown = LabelledPlaces(projection(), places, np.ones(2), np.zeros((2, 6), np.intp))
    # feature i is at the place that holds it
    assert unknown.nearest(np.eye(4)).tolist() == [np.argsort(order).tolist()] * 2


def test_a_deformed_body_is_fitted_to_its_features_by_least_squares() -> None:
    places = deformed(1.0)
    found = [seen(one, y) for one, y in zip(BEAMS, places, strict=True)]
    start = perturb(np.eye(4), np.array([2.0, -1.0, 1.0, 0.02, 0.03, -0.02]))
    T = fit_freed(projection(), found, start[None], FREE)
    assert T is not None
    # no step lowers the sum of squares of 2 · 6 distances
    at = sum_of_squares(T, places)
    for twist in 0.01 * np.vstack([np.diag([1, 1, 1, 0.02, 0.02, 0.02]) * s for s in (1, -1)]):
        assert sum_of_squares(perturb(T, twist), places) > at
    # deformed by 1 in 6 features: the pose is off by about √(1/6) and, at a rim of 60, a degree
    off = twist_between(np.eye(4), T)
    assert np.linalg.norm(off[:3]) < 1.5
    assert np.degrees(np.linalg.norm(off[3:])) < 3


def sum_of_squares(T: Floats, places: list[Floats]) -> float:
    y = [sensor.project(transform(T, POINTS))[0] for sensor in BEAMS]
    return float(sum(((a - b) ** 2).sum() for a, b in zip(y, places, strict=True)))


def test_places_that_might_be_each_others_free_nothing() -> None:
    # two features 10 apart in a body deformed by 10
    points = POINTS.copy()
    points[5] = points[4] + [8.0, 8.0, 8.0]
    rng = np.random.default_rng(4)
    places = projected(points + 12.0 * rng.standard_normal(points.shape))
    found = [seen(one, y) for one, y in zip(BEAMS, places, strict=True)]
    assert own_peaks(found[0], 6) is not None
    assert own_peaks(found[1], 6) is not None
    assert fit_freed(projection(points), found, np.eye(4)[None], FREE) is None
