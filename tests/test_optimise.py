"""The ascent knows a function of a few numbers and nothing else."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from numpy.typing import NDArray

from mixpose.optimise import NewtonOptions, ascend

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Model:
    value: float
    gradient: Floats
    curvature: Floats
    hessian: Floats | None = None


def hill(x: Floats) -> Model:
    """A Gaussian hill with its peak at (1, -2) and very unlike scales."""
    A = np.diag([1.0, 1e4])
    away = x - [1.0, -2.0]
    value = float(np.exp(-0.5 * away @ A @ away))
    return Model(value, -value * (A @ away), value * A)


def test_a_hill_of_unlike_scales_is_climbed() -> None:
    start = np.array([2.2, -2.015])
    ascent = ascend(hill, lambda x, step: x + step, start, np.ones(2, dtype=np.bool_))
    assert ascent.converged
    np.testing.assert_allclose(ascent.state, [1.0, -2.0], atol=1e-6)


def test_a_direction_that_is_not_free_is_left_alone() -> None:
    start = np.array([2.0, -2.01])
    ascent = ascend(hill, lambda x, step: x + step, start, np.array([True, False]))
    assert ascent.state[1] == -2.01
    assert ascent.state[0] == pytest.approx(1.0, abs=1e-5)


def test_a_direction_without_curvature_does_no_harm() -> None:
    def ridge(x: Floats) -> Model:
        value = float(np.exp(-0.5 * x[0] ** 2))
        return Model(value, np.array([-x[0] * value, 0.0]), np.diag([value, 0.0]))

    ascent = ascend(ridge, lambda x, s: x + s, np.array([0.8, 3.0]), np.ones(2, dtype=np.bool_))
    np.testing.assert_allclose(ascent.state, [0.0, 3.0], atol=1e-6)


def test_values_with_interpolation_error_do_not_stop_the_ascent() -> None:
    def staircase(x: Floats) -> Model:
        exact = hill(x)
        return Model(round(exact.value, 2), exact.gradient, exact.curvature)

    start = np.array([1.3, -2.001])
    free = np.ones(2, dtype=np.bool_)
    stuck = ascend(staircase, lambda x, s: x + s, start, free)
    seeing = ascend(staircase, lambda x, s: x + s, start, free, NewtonOptions(value_error=1e-2))
    np.testing.assert_allclose(seeing.state, [1.0, -2.0], atol=1e-6)
    assert np.linalg.norm(stuck.state - [1.0, -2.0]) > 1e-5


def test_running_out_of_iterations_is_told() -> None:
    start = np.array([2.5, -2.02])
    ascent = ascend(
        hill, lambda x, s: x + s, start, np.ones(2, dtype=np.bool_), NewtonOptions(iterations=2)
    )
    assert not ascent.converged
