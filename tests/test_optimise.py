"""The ascent knows a function of a few numbers and nothing else."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import pytest
from numpy.typing import NDArray

from mixpose.optimise import NewtonOptions, ascend, ascend_together

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


def test_climbs_side_by_side_end_where_each_ends_alone() -> None:
    free, options, asked = np.ones(2, dtype=np.bool_), NewtonOptions(), []

    def both(states: Sequence[Floats]) -> list[Model]:
        asked.append(len(states))
        return [hill(x) for x in states]

    starts = [np.array([2.2, -2.015]), np.array([1.001, -2.0])]
    found = ascend_together(
        both, lambda x, step: x + step, starts, free, options, [hill(x) for x in starts]
    )
    alone = [ascend(hill, lambda x, step: x + step, start, free, options) for start in starts]
    for one, other in zip(found, alone, strict=True):
        np.testing.assert_array_equal(one.state, other.state)
        assert one.iterations == other.iterations
    # the one that is near is long done when the other arrives: it asks no further
    assert len(asked) == max(one.iterations for one in alone) - 1
    assert alone[1].iterations < alone[0].iterations


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


def bowl(claimed: float, hessian: float | None = None) -> Callable[[Floats], Model]:
    """Value 10 - 50 x², whose curvature is 100, with another curvature claimed for it."""

    def model(x: Floats) -> Model:
        known = None if hessian is None else np.array([[hessian]])
        value = 10.0 - 50.0 * float(x[0] ** 2)
        return Model(value, -100.0 * x, np.array([[claimed]]), known)

    return model


ONE = np.ones(1, dtype=np.bool_)


def test_damping_grows_until_a_step_that_is_far_too_long_becomes_short_enough() -> None:
    # by the curvature claimed the first step is a hundred times too long
    ascent = ascend(bowl(1.0), lambda x, step: x + step, np.array([0.3]), ONE)
    assert ascent.converged
    assert ascent.state[0] == pytest.approx(0.0, abs=1e-5)
    assert ascent.value == pytest.approx(10.0)


def test_the_last_step_is_taken_and_its_gain_counted_though_it_is_not_looked_at() -> None:
    # 0.5 of 9.5 is to be gained, less than the tenth that the tolerance asks for
    start = np.array([0.1])
    ascent = ascend(
        bowl(100.0), lambda x, s: x + s, start, ONE, NewtonOptions(tolerance=0.1, damping=1e-6)
    )
    assert (ascent.converged, ascent.iterations) == (True, 1)
    assert ascent.state[0] == pytest.approx(0.0, abs=1e-6)
    assert ascent.value == pytest.approx(10.0, abs=1e-6)


def test_a_definite_hessian_is_used_in_place_of_a_curvature_that_is_too_large() -> None:
    start, options = np.array([0.3]), NewtonOptions(iterations=12)
    slow = ascend(bowl(300.0), lambda x, s: x + s, start, ONE, options)
    fast = ascend(bowl(300.0, hessian=100.0), lambda x, s: x + s, start, ONE, options)
    # steps of a third of the way leave (2/3)^11 = 0.01 of it, Newton's leave the damping's 1e-4
    assert not slow.converged
    assert fast.converged
    assert fast.iterations <= 4
    assert fast.state[0] == pytest.approx(0.0, abs=1e-6)


def test_a_hessian_that_is_not_definite_does_not_lead_to_the_valley_between_two_hills() -> None:
    def hills(x: Floats) -> Model:
        """Hills of height 2 at -1 and 1; at the start the second derivative is positive."""
        x0 = float(x[0])
        gradient = np.array([x0 - x0**3])
        hessian = np.array([[3 * x0**2 - 1]])
        return Model(2 - (x0**2 - 1) ** 2 / 4, gradient, np.array([[3 * x0**2 + 1]]), hessian)

    ascent = ascend(hills, lambda x, s: x + s, np.array([0.1]), ONE)
    assert ascent.converged
    assert ascent.state[0] == pytest.approx(1.0, abs=1e-5)
