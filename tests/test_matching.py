"""Which detections predicted features meet, and what is seen beside them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from detections import view_of
from numpy.typing import NDArray

from mixpose.body import Body, PointFeature
from mixpose.density import Observation, peak
from mixpose.matching import AssociationRules, ErrorRules, Matches, associate, crowding
from mixpose.matching.associate import _in_turn, _neighbours, _residuals
from mixpose.objective import View, matched_objective
from mixpose.records import PointPattern
from mixpose.rigid import from_parts
from mixpose.sensors import PLANES, CloudSensor, PinholeCamera

Floats = NDArray[np.float64]

RULES = AssociationRules()
VARIANCE = 4.5  # 2 σ² of σ_ε = 1.5: features are met within 3.3
SIGMA = 1.5
K = np.array([[1000.0, 0, 500], [0, 1000.0, 500], [0, 0, 1]])
CAMERA = PinholeCamera(K, np.zeros(4), (1000, 1000), np.eye(4))
AT = from_parts(np.eye(3), np.array([0.0, 0.0, 1000.0]))
"""Where a body looks in the image as from above: a length unit is a pixel."""


def met(
    detections: list[tuple[float, float]], *places: tuple[float, float], off: float = 0.0
) -> Matches:
    """A flat body, seen from above; its features may be off, all places are from the middle."""
    spread = off**2 * np.eye(3)
    body = Body("flat", tuple(PointFeature(np.array([*place, 0.0]), spread) for place in places))
    view = view_of("camera", CAMERA, np.array(detections) + 500.0, SIGMA)
    objective = matched_objective([view], body, [SIGMA])
    return associate(objective, AT, RULES, ErrorRules().narrowest)


def test_a_detection_is_that_of_one_feature() -> None:
    # on the first feature, and within reach of the second, which is hidden
    found = met([(10.0, 10.0)], (10.0, 10.0), (12.0, 10.0))
    assert found.shares.tolist() == [[1.0, 0.0]]
    assert found.detections.tolist() == [[0, -1]]
    assert found.merged.tolist() == [0]


def test_features_side_by_side_meet_the_nearest_detection_each() -> None:
    found = met([(10.0, 10.0), (12.0, 10.0)], (10.0, 10.1), (12.0, 10.1))
    assert found.shares.tolist() == [[1.0, 1.0]]
    assert found.detections.tolist() == [[0, 1]]
    np.testing.assert_allclose(SIGMA * found.offsets[0], [[0.0, -0.1], [0.0, -0.1]], atol=1e-9)


def test_a_feature_that_may_be_off_is_met_as_far_as_it_may_be() -> None:
    spots, place = [(10.0, 10.0)], (14.0, 10.0)
    # met within 1.55 standard deviations of what the place and the detection may be off
    assert met(spots, place).shares.tolist() == [[0.0]]
    wide = (4.0 / 1.55) ** 2 - VARIANCE
    assert met(spots, place, off=np.sqrt(0.98 * wide)).shares.tolist() == [[0.0]]
    assert met(spots, place, off=np.sqrt(1.02 * wide)).shares.tolist() == [[1.0]]


def test_two_features_that_share_a_detection_count_as_one_and_a_third_is_missed() -> None:
    # the detection is nearer to the middle of the first two than to either; the middle of the
    # second and the third would be met as well, had the second not its partner already
    found = met([(0.7, 0.3)], (0.0, 0.0), (1.0, 0.0), (1.4, 0.6))
    assert found.shares.tolist() == [[0.5, 0.5, 0.0]]
    assert found.detections.tolist() == [[0, 0, -1]]
    assert found.merged.tolist() == [1]
    np.testing.assert_allclose(SIGMA * found.offsets[0, :2], [[0.2, 0.3]] * 2, atol=1e-9)
    # it moves as their middle does
    np.testing.assert_allclose(found.J[0, 0], found.J[0, 1], atol=1e-12)


def test_a_spot_may_be_of_a_missed_feature_within_its_radius_too() -> None:
    """With probability 0.6; then it is half of the distance beside the feature that it meets."""
    places = [(0.0, 0.0), (3.0, 0.0), (20.0, 0.0), (24.5, 0.0)]
    body = Body("flat", tuple(PointFeature(np.array([*place, 0.0])) for place in places))
    spots = np.array([(0.0, 0.0), (20.0, 0.0)]) + 500.0
    for radius, squared in ((4.0, 9.0), (2.5, 0.0)):
        pattern = PointPattern(spots, np.ones(2), radii=np.full(2, radius))
        view = View("camera", CAMERA, Observation(pattern, SIGMA))
        objective = matched_objective([view], body, [SIGMA])
        found = associate(objective, AT, RULES, ErrorRules().narrowest)
        assert found.detections.tolist() == [[0, -1, 1, -1]]
        np.testing.assert_allclose(found.extra[0, 0], 0.6 * squared / 4 / SIGMA**2)
        # the fourth is beyond the radius of the second spot
        assert found.extra[0, 2] == 0.0


def mixture(centres: Floats, y: Floats) -> Floats:
    """Gaussians and their gradients (n, 3) in closed form."""
    away = centres - y[:, None]
    bells = np.exp(-0.5 * (away**2).sum(axis=2) / VARIANCE) * peak(VARIANCE, 2)
    gradient = (bells[..., None] * away).sum(axis=1) / VARIANCE
    return np.column_stack([bells.sum(axis=1), gradient])


def test_features_of_grey_values_that_overlap_are_met_where_they_are() -> None:
    y = np.array([[10.0, 10.0], [13.0, 10.0], [40.0, 40.0]])

    def seen(centres: Floats) -> tuple[Floats, Floats]:
        values = 0.2 * mixture(centres, y)
        return _residuals(y, np.ones(3), VARIANCE, values, np.ones((3, 2, 6)), 0.2, RULES)[:2]

    shares, offsets = seen(y)
    np.testing.assert_allclose(shares, 1.0, atol=1e-9)
    np.testing.assert_allclose(offsets, 0.0, atol=1e-9)
    # one is 0.1 off: the others stay where they are, but for what is second order, 0.1²
    off = y + np.array([[0.0, 0.0], [0.0, 0.0], [0.1, 0.0]])
    np.testing.assert_allclose(seen(off)[1], off - y, atol=0.01)


def test_features_of_a_noisy_profile_that_overlap_are_off_independently_of_each_other() -> None:
    """White noise of cells, seen through features of deviation σ, of which C has the variance 2σ².

    Of a feature by itself the offset then has the variance noise² / Σ (∂h)²; of a pair 1.2 σ apart
    the same, as of the Jacobians, whose least squares are as far off as they say.
    """
    rng, y = (
        np.random.default_rng(3),
        np.array([[0.0], [1.2], [10.0], [20.0]]) * np.sqrt(VARIANCE / 2),
    )
    x = np.arange(-10.0, 50.0, 0.25) * np.sqrt(VARIANCE / 2)
    away = x - y
    h = np.exp(-(away**2) / VARIANCE)
    slopes = 2 * h * away / VARIANCE
    both = np.stack([h, slopes], axis=2) * peak(VARIANCE, 1) / np.vecdot(h, h)[:, None, None]
    J, noise = rng.standard_normal((4, 1, 6)), 1e-4
    g = h.sum(axis=0) + noise * rng.standard_normal((4000, len(x)))
    each = [_residuals(y, np.ones(4), VARIANCE, v @ both, J, 1.0, RULES) for v in g]
    offsets, rows = np.array([one[1][:, 0] for one in each]), each[0][2][:, 0, :2]
    variance = noise**2 / (slopes[2] @ slopes[2])
    # 4000 draws tell variances to 2.2 %
    np.testing.assert_allclose(np.cov(offsets.T) / variance, np.eye(4), atol=0.09)
    moved = np.linalg.lstsq(rows, offsets.T, rcond=None)[0]
    told = variance * np.linalg.inv(rows.T @ rows)
    np.testing.assert_allclose(np.linalg.solve(told, np.cov(moved)), np.eye(2), atol=0.09)


def test_clutter_is_as_dense_as_detections_around_the_body_where_they_are_denser() -> None:
    around = [(100.0, 100.0), (200.0, 100.0), (200.0, 200.0), (150.0, 150.0), (120.0, 180.0)]
    points = np.array([*around, (0.0, 0.0), (1000.0, 1000.0)])
    lower = np.array([[100.0, 100.0], [600.0, 100.0]])
    found = crowding(points, lower, lower + 100.0, 30.0, np.array([3.0, 0.0]))
    np.testing.assert_allclose(found[0], [5 / 100**2, 7 / 1000**2])
    # those that meet the body are no clutter beside it
    np.testing.assert_allclose(found[1], [2 / 100**3, 7 / 1000**3])


def test_detections_beside_the_body_that_belong_to_none_are_unmatched() -> None:
    corners = (100.0, 100.0), (200.0, 200.0)
    beside = [(220.0, 150.0), (230.0, 150.0)]
    # two are met; one lies within, one beyond a quarter of the body's size around it
    missed = met([*corners, *beside], *corners, (150.0, 150.0))
    assert missed.met.tolist() == [2.0]
    assert missed.unmatched_nearby.tolist() == [1.0]
    # where nothing is missed, what else is there is no sign of another place
    assert met([*corners, *beside], *corners).unmatched_nearby.tolist() == [0.0]
    assert met([(226.0, 150.0)], *corners).unmatched_nearby.tolist() == [0.0]
    assert met([(224.0, 150.0)], *corners).unmatched_nearby.tolist() == [1.0]


def test_what_is_one_behind_the_other_in_an_image_is_told_apart_in_space() -> None:
    body = Body("b", tuple(PointFeature(p) for p in 40 * np.eye(3)))
    at = body.means
    # nearer to the first marker than its own point in the first image, and 100 mm behind it
    points = np.concatenate([at + np.array([0.5, 0.5, 0]), at[:1] + np.array([0, 0, 100])])
    seen = Observation(PointPattern(points, np.ones(4)), 1.5)
    views = [
        View(name, plane, replace(seen, pattern=PointPattern(points[:, axes], np.ones(4))))
        for plane, (name, axes) in zip(CloudSensor().planes, PLANES, strict=True)
    ]
    objective = matched_objective(views, body, [1.5] * 3)
    found = associate(objective, np.eye(4), AssociationRules(), 0.05)
    np.testing.assert_array_equal(found.detections, [[0, 1, 2]] * len(PLANES))
    assert float(found.measurements.sum()) == 9.0
    assert float(found.squares.sum()) == pytest.approx(3 * 0.5 / 1.5**2)


def test_of_many_detections_the_nearest_and_all_in_reach_are_those_of_each_pair_by_itself() -> None:
    rng = np.random.default_rng(5)
    y, detections = rng.uniform(0, 100, (2, 120, 2)), rng.uniform(0, 100, (2, 150, 2))
    detections[1, 90:] = np.nan  # a sensor that has fewer
    reach = rng.uniform(0, 15.0**2, (2, 120))
    which, squared = _neighbours(y, detections, reach, ())
    away = detections[:, None] - y[:, :, None]
    each = np.vecdot(away, away)
    for k in range(2):
        for i in range(120):
            is_there = np.isfinite(squared[k, i])
            found = dict(zip(which[k, i, is_there].tolist(), squared[k, i, is_there].tolist()))
            near = np.argsort(each[k, i])
            within = np.flatnonzero(each[k, i] <= reach[k, i]).tolist()
            assert set(found) >= {*near[:2].tolist(), *within}
            assert all(s == pytest.approx(each[k, i, j]) for j, s in found.items())


def test_pairs_come_to_be_in_turn_as_if_one_by_one() -> None:
    rng = np.random.default_rng(6)
    one, other = rng.integers(0, 20, (2, 200))
    taken: list[int] = []
    for k in range(200):
        if one[k] not in one[taken] and other[k] not in other[taken]:
            taken.append(k)
    assert _in_turn(one, other).tolist() == taken
    assert not _in_turn(one[:0], other[:0]).size
