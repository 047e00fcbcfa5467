"""Which detections predicted features meet, and what is seen beside them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mixpose.density import AssociationRules, Observation, crowding, features_met, surplus
from mixpose.density.features_met import FeaturesMet
from mixpose.density.overlap import peak
from mixpose.records import GridPattern, PointPattern

Floats = NDArray[np.float64]

RULES = AssociationRules()
VARIANCE = 4.5  # 2 σ² of σ_ε = 1.5: features are met within 3.3


def detections(*points: tuple[float, float]) -> Observation:
    return Observation(PointPattern(np.array(points, dtype=float), np.ones(len(points))), 1.5)


def met(observation: Observation, *places: tuple[float, float]) -> FeaturesMet:
    y = np.array(places, dtype=float)
    return features_met(
        observation, y, np.ones(len(y)), VARIANCE, np.zeros((len(y), 3)), 1.0, RULES
    )


def test_a_detection_is_that_of_one_feature() -> None:
    # on the first feature, and within reach of the second, which is hidden
    found = met(detections((10.0, 10.0)), (10.0, 10.0), (12.0, 10.0))
    assert found.shares.tolist() == [1.0, 0.0]
    assert found.partner.tolist() == [0, 1]


def test_features_side_by_side_meet_the_nearest_detection_each() -> None:
    found = met(detections((10.0, 10.0), (12.0, 10.0)), (10.0, 10.1), (12.0, 10.1))
    assert found.shares.tolist() == [1.0, 1.0]
    np.testing.assert_allclose(found.offsets, [[0.0, -0.1], [0.0, -0.1]], atol=1e-12)


def test_a_feature_that_may_be_off_is_met_as_far_as_it_may_be() -> None:
    spots, places = detections((10.0, 10.0)), np.array([[14.0, 10.0]])
    arguments = spots, places, np.ones(1), VARIANCE, np.ones((1, 3)), 1.0, AssociationRules()
    # met within 1.55 standard deviations of what the place and the detection may be off
    assert features_met(*arguments).shares.tolist() == [0.0]
    wide = np.array([(4.0 / 1.55) ** 2 - VARIANCE])
    assert features_met(*arguments, 0.98 * wide).shares.tolist() == [0.0]
    assert features_met(*arguments, 1.02 * wide).shares.tolist() == [1.0]


def test_two_features_that_share_a_detection_count_as_one_and_a_third_is_missed() -> None:
    # the detection is nearer to the middle of the first two than to either; the middle of the
    # second and the third would be met as well, had the second not its partner already
    found = met(detections((0.7, 0.3)), (0.0, 0.0), (1.0, 0.0), (1.4, 0.6))
    assert found.shares.tolist() == [0.5, 0.5, 0.0]
    assert found.partner.tolist() == [1, 0, 2]
    np.testing.assert_allclose(found.offsets[:2], [[0.2, 0.3]] * 2, atol=1e-12)


def mixture(centres: Floats, y: Floats) -> Floats:
    """Gaussians and their gradients (n, 3) in closed form."""
    away = centres - y[:, None]
    bells = np.exp(-0.5 * (away**2).sum(axis=2) / VARIANCE) * peak(VARIANCE, 2)
    gradient = (bells[..., None] * away).sum(axis=1) / VARIANCE
    return np.column_stack([bells.sum(axis=1), gradient])


def test_features_of_grey_values_that_overlap_are_met_where_they_are() -> None:
    y = np.array([[10.0, 10.0], [13.0, 10.0], [40.0, 40.0]])
    grey = Observation(GridPattern(np.ones((2, 2), dtype=np.float32), np.zeros(2), 1.0), 1.5)
    exact = features_met(grey, y, np.ones(3), VARIANCE, 0.2 * mixture(y, y), 0.2, RULES)
    np.testing.assert_allclose(exact.shares, 1.0, atol=1e-9)
    np.testing.assert_allclose(exact.offsets, 0.0, atol=1e-9)
    # one is 0.1 off: the others stay where they are, but for what is second order, 0.1²
    off = y + np.array([[0.0, 0.0], [0.0, 0.0], [0.1, 0.0]])
    found = features_met(grey, y, np.ones(3), VARIANCE, 0.2 * mixture(off, y), 0.2, RULES)
    np.testing.assert_allclose(found.offsets, off - y, atol=0.01)


def test_clutter_is_as_dense_as_detections_around_the_body_where_they_are_denser() -> None:
    around = [(100.0, 100.0), (200.0, 100.0), (200.0, 200.0), (150.0, 150.0), (120.0, 180.0)]
    points = np.array([*around, (0.0, 0.0), (1000.0, 1000.0)])
    lower = np.array([[100.0, 100.0], [600.0, 100.0]])
    found = crowding(points, lower, lower + 100.0, 30.0)
    np.testing.assert_allclose(found, [5 / 100**2, 7 / 1000**2])


def test_detections_beside_the_body_that_belong_to_none_are_surplus() -> None:
    body = np.array([[100.0, 100.0], [200.0, 200.0]])
    observation = detections((100.0, 100.0), (200.0, 200.0), (220.0, 150.0), (230.0, 150.0))
    # two are met; one lies within, one beyond a quarter of the body's size around it
    assert surplus(observation, body, 2.0, RULES) == 1
    assert surplus(detections((226.0, 150.0)), body, 0.0, RULES) == 0
    assert surplus(detections((224.0, 150.0)), body, 0.0, RULES) == 1
