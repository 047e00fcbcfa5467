"""How large extraction errors are, as offsets show it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from matches import Seen, matches_of
from numpy.typing import NDArray

from mixpose.matching import ErrorRules, Matches, errors_seen, log_likelihood

Floats = NDArray[np.float64]

RULES = ErrorRules()
NOTHING = np.zeros((2, 1))


def offsets_of(*sensors: Floats, finest: float = 0.01) -> Matches:
    """Features (n, m) that are off by so much, in σ_ε, and all met."""
    return matches_of(
        *(Seen(np.zeros((*away.shape, 6)), offsets=away, finest=finest) for away in sensors)
    )


@pytest.mark.parametrize("coordinates", [1, 2])
@pytest.mark.parametrize("s", [0.05, 0.3])
def test_normal_offsets_have_their_variance(coordinates: int, s: float) -> None:
    away = np.random.default_rng(0).normal(0, s, (4000, coordinates))
    own, variances, blurs, _ = errors_seen(offsets_of(away), 0, NOTHING, RULES)
    # of so many, 1 standard deviation of the variance is 2 %
    assert variances[0] == pytest.approx(s**2, rel=0.06)
    assert own[1, 0] == pytest.approx(4000 * coordinates, rel=0.02)
    assert blurs[0] == pytest.approx(1.5 * s, rel=0.03)


def test_an_eighth_of_offsets_far_off_changes_little() -> None:
    rng = np.random.default_rng(1)
    away = rng.normal(0, 0.05, (400, 2))
    away[::8] += rng.uniform(0.5, 1.5, (50, 2))
    _, variances, _, _ = errors_seen(offsets_of(away), 0, NOTHING, RULES)
    assert variances[0] == pytest.approx(0.05**2, rel=0.15)


def test_what_may_err_by_more_than_others_tells_little_of_the_noise() -> None:
    rng = np.random.default_rng(4)
    away = rng.normal(0, 0.05, (60, 2))
    away[::3] += rng.normal(0, 0.2, (20, 2))
    extra = np.where(np.arange(60) % 3, 0.0, 0.2**2)[None]
    known = np.array([[400 * 0.05**2], [400.0]])
    own, *_ = errors_seen(replace(offsets_of(away), extra=extra), 0, known, RULES)
    # 40 of them, and 20 that weigh a seventeenth
    assert own[1, 0] == pytest.approx(2 * 41, rel=0.1)
    assert own[0, 0] / own[1, 0] == pytest.approx(0.05**2, rel=0.3)


def test_the_blur_stays_wide_where_a_frame_is_not_like_those_before_it() -> None:
    away = np.random.default_rng(2).normal(0, 0.3, (12, 2))
    before = np.array([[200 * 0.02**2], [200.0]])
    _, _, blurs, _ = errors_seen(offsets_of(away), 6, before, RULES)
    assert blurs[0] > 1.5 * 0.2


def test_without_offsets_to_spare_the_noise_is_the_typical_one() -> None:
    own, variances, blurs, _ = errors_seen(offsets_of(np.zeros((3, 2))), 6, NOTHING, RULES)
    assert own.tolist() == [[0.0], [0.0]]
    assert variances[0] == pytest.approx(0.2**2)
    assert blurs[0] == pytest.approx(1.5 * 0.2)


def test_no_blur_is_narrower_than_a_density_can_be_drawn() -> None:
    _, _, blurs, _ = errors_seen(offsets_of(np.full((50, 2), 1e-4), finest=0.2), 0, NOTHING, RULES)
    assert blurs[0] == pytest.approx(0.2)


def test_half_of_offsets_far_off_are_no_noise_where_the_rest_is_as_small_as_before() -> None:
    rng = np.random.default_rng(3)
    away = rng.normal(0, 0.02, (16, 2))
    before = np.array([[200 * 0.02**2], [200.0]])
    away[:7] += rng.uniform(0.4, 1.2, (7, 2))
    _, variances, blurs, _ = errors_seen(offsets_of(away), 6, before, RULES)
    assert variances[0] == pytest.approx(0.02**2, rel=0.3)
    # by chance no nine of sixteen offsets are within 0.05 of a wide noise
    likelihood = log_likelihood(blurs, offsets_of(away), 6, RULES)
    assert likelihood > 20
    unknown = errors_seen(offsets_of(away), 6, NOTHING, RULES)
    assert log_likelihood(unknown[2], offsets_of(away), 6, RULES) < likelihood


def test_sensors_are_weighed_half_by_what_all_of_them_err_by() -> None:
    rng = np.random.default_rng(4)
    away = rng.normal(0, np.repeat([[0.05], [0.2]], 2000, axis=0), (4000, 2))
    _, _, blurs, _ = errors_seen(offsets_of(away[:2000], away[2000:]), 0, np.zeros((2, 2)), RULES)
    mean = (0.05**2 + 0.2**2) / 2
    for blur, s in zip(blurs, (0.05, 0.2), strict=True):
        assert blur == pytest.approx(1.5 * np.sqrt((s**2 + mean) / 2), rel=0.06)
