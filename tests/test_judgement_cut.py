"""The covariance of a pose of which one detection may be cut."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from matches import Seen, matches_of
from numpy.typing import NDArray
from scipy.special import chdtri

from mixpose.judgement.acceptance import AcceptanceRules, is_open
from mixpose.judgement.cut import with_cut_spots
from mixpose.judgement.judge import ScoredPose
from mixpose.judgement.noise import NoiseModel
from mixpose.matching import ErrorRules, Matches

Floats = NDArray[np.float64]

NOISE = 0.05
FREE = np.ones(6, dtype=np.bool_)


def widened(
    found: Matches, errors: ErrorRules = ErrorRules(), degrees: float = 1e12
) -> tuple[Floats, Floats, float]:
    """Covariance of the least squares, what it is larger by, and the factor."""
    J = found.J.reshape(-1, 6) / NOISE
    C, r = np.linalg.inv(J.T @ J).astype(np.float64), found.offsets.ravel() / NOISE
    variances = np.full(found.shares.shape, NOISE**2)
    known = np.full(6, 10.0)
    return (C, *with_cut_spots(found, J, r, J.T @ J, known, variances, errors, 0.001, degrees))


def met(features: int, rng: np.random.Generator, errors: Floats) -> tuple[Matches, Floats]:
    """One camera's matches at the pose of the least squares of errors (n, 2), and its error."""
    J = rng.normal(size=(features, 2, 6))
    off = np.linalg.lstsq(J.reshape(-1, 6), errors.ravel(), rcond=None)[0].astype(np.float64)
    return matches_of(Seen(J, offsets=errors - J @ off, crowd=1e-6)), off


def test_what_many_others_tell_as_well_makes_a_pose_hardly_wider() -> None:
    rng = np.random.default_rng(0)
    found, _ = met(40, rng, rng.normal(0, NOISE, (40, 2)))
    C, spread, factor = widened(found)
    # by the chance of a cut, 40 x 0.013, of one in 40 features: some hundredths
    assert np.trace(np.linalg.solve(C, spread)) / 6 < 0.05
    assert factor < 1.3


def test_where_nothing_is_cut_a_pose_is_as_the_noise_has_it() -> None:
    found, _ = met(5, np.random.default_rng(0), np.zeros((5, 2)))
    never = ErrorRules(chances=(0.0, 0.0, 0.0))
    C, spread, factor = widened(replace(found, crowd=0 * found.crowd), never)
    np.testing.assert_allclose(spread, 0, atol=1e-12 * np.trace(C))
    assert factor == pytest.approx(1.0, abs=1e-6)


def test_a_pose_beside_the_least_squares_is_as_wide_as_that_and_as_far_off() -> None:
    rng = np.random.default_rng(0)
    found, _ = met(4, rng, rng.normal(0, NOISE, (4, 2)))
    C, spread, _ = widened(found)
    away = 0.3 * np.linalg.cholesky(C)[:, 0]
    _, aside, _ = widened(replace(found, offsets=found.offsets + found.J @ away))
    # what is known before, 10 deviations, takes a part in 1e4 of it
    np.testing.assert_allclose(aside, spread + np.outer(away, away), atol=1e-3 * np.trace(C))


def test_of_few_features_thirteen_in_a_thousand_cut_the_truth_is_in_the_ellipsoid() -> None:
    rng, outside, plain = np.random.default_rng(1), 0, 0
    limit, trials = chdtri(6, 0.001), 4000
    for _ in range(trials):
        errors = rng.normal(0, NOISE, (5, 2))
        if rng.random() < 0.065:  # of five, each of thirteen in a thousand
            errors[rng.integers(5)] += rng.normal(0, rng.choice([0.1, 1.0], p=[10 / 13, 3 / 13]), 2)
        found, off = met(5, rng, errors)
        C, spread, factor = widened(found)
        outside += bool(off @ np.linalg.solve(factor * (C + spread), off) > limit)
        plain += bool(off @ np.linalg.solve(C, off) > limit)
    # as it is, ten times as many and more are beyond; 0.1 % and three deviations of that
    assert plain / trials > 0.01
    assert outside / trials < 0.0025


@pytest.mark.parametrize("chances", [(0.0, 0.0, 0.0), ErrorRules().chances])
def test_of_a_noise_that_few_residuals_tell_the_truth_is_in_the_ellipsoid(
    chances: tuple[float, float, float],
) -> None:
    rng, degrees, trials = np.random.default_rng(2), 6.0, 400_000
    found, _ = met(5, np.random.default_rng(0), np.zeros((5, 2)))
    C, spread, factor = widened(found, ErrorRules(chances=chances), degrees)
    off = rng.normal(size=(trials, 6)) @ np.linalg.cholesky(C).T
    told = rng.chisquare(degrees, trials) / degrees
    squares = np.vecdot(off, np.linalg.solve(factor * (C + spread), off.T).T) / told
    # 0.1 %, by chance to three deviations of 0.005 %; what may be cut makes it no wider than asked
    assert np.mean(squares > chdtri(6, 0.001)) < 0.00115


def pose_of(found: Matches, noise: float) -> ScoredPose:
    return replace(
        ScoredPose(np.eye(4), found, np.eye(6), 50.0), variances=np.full(1, noise * noise)
    )


def test_a_pose_is_open_where_what_would_fix_it_is_hidden_or_cut() -> None:
    rng = np.random.default_rng(2)
    found, _ = met(8, rng, np.zeros((8, 2)))
    shares, extra = np.array([[1.0] * 3 + [0.0] * 5]), np.zeros((1, 8))
    given = FREE, AcceptanceRules(), NoiseModel()
    assert not is_open(pose_of(found, 0.02), *given)
    cut = np.where(np.arange(8) < 2, 0.0, 4.0)[None]
    assert is_open(pose_of(replace(found, extra=cut), 0.02), *given)
    # three that are whole fix it by themselves
    assert not is_open(pose_of(replace(found, shares=shares, extra=extra), 0.02), *given)
    # and where noise is as small as a thousandth, what is cut by a tenth is known well enough
    slightly = np.where(np.arange(8) < 2, 0.0, 0.05**2)[None]
    assert not is_open(pose_of(replace(found, extra=slightly), 0.001), *given)
