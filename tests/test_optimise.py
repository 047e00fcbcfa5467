"""The ascent knows a function of a few numbers and nothing else."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import pytest
from numpy.typing import NDArray

from mixpose.objective import NormalPrior
from mixpose.optimise import (
    Ascent,
    LinearResiduals,
    NewtonOptions,
    Quadratic,
    Sum,
    Term,
    ascend,
    least_squares,
    stepped,
)
from mixpose.rigid import perturb, twist_between

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Function:
    """A term that is written down as a function of one state (q,)."""

    model: Callable[[Floats], tuple[float, Floats, Floats] | tuple[float, Floats, Floats, Floats]]
    asked: list[int] = field(default_factory=list)  # states per evaluation

    def linearise(self, states: Floats) -> Quadratic:
        self.asked.append(len(states))
        return Quadratic(*map(np.array, zip(*map(self.model, states), strict=True)))


def hill(x: Floats) -> tuple[float, Floats, Floats]:
    """A Gaussian hill with its peak at (1, -2) and very unlike scales."""
    A = np.diag([1.0, 1e4])
    away = x - [1.0, -2.0]
    value = float(np.exp(-0.5 * away @ A @ away))
    return value, -value * (A @ away), value * A


BOTH = np.ones(2, dtype=np.bool_)


def climbed(
    term: Term | Callable[[Floats], tuple[float, Floats, Floats]],
    *starts: Floats,
    free: NDArray[np.bool_] = BOTH,
    options: NewtonOptions = NewtonOptions(),
) -> Ascent:
    """Where the ascents of a function from some starts (q,) end."""
    term = Function(term) if callable(term) else term
    return ascend(term, np.array(starts), lambda x, step: x + step, free, options)


def test_a_hill_of_unlike_scales_is_climbed() -> None:
    ascent = climbed(hill, np.array([2.2, -2.015]))
    np.testing.assert_allclose(ascent.states[0], [1.0, -2.0], atol=1e-6)


STARTS = np.array([[2.2, -2.015], [1.001, -2.0], [-0.8, -2.01]])


def evaluations_from(start: Floats) -> int:
    """How often an ascent of the hill asks for a model."""
    term = Function(hill)
    climbed(term, start)
    return len(term.asked)


def test_climbs_side_by_side_end_where_each_ends_alone() -> None:
    term = Function(hill)
    found = climbed(term, *STARTS)
    alone = [climbed(hill, start) for start in STARTS]
    for k, one in enumerate(alone):
        np.testing.assert_allclose(found.states[k], one.states[0], rtol=0, atol=1e-12)
        assert found.values[k] == pytest.approx(one.values[0], rel=1e-12)
    # what has arrived is evaluated no further: the start that is near, soon
    evaluations = [evaluations_from(start) for start in STARTS]
    assert sum(term.asked) == sum(evaluations)
    assert evaluations[1] < evaluations[0]


def test_states_with_data_of_their_own_are_evaluated_until_all_have_arrived() -> None:
    term = Function(hill)
    found = climbed(term, *STARTS, options=NewtonOptions(together=True))
    assert term.asked == [3] * max(evaluations_from(start) for start in STARTS)
    np.testing.assert_array_equal(found.states, climbed(hill, *STARTS).states)


def test_steps_that_nobody_checks_are_as_many_as_were_asked_for() -> None:
    # value 10 - 50 x² by a curvature of 200: every step goes half of the way, but for the damping
    term = Function(bowl(200.0))
    found = stepped(term, np.array([[0.4], [0.0]]), lambda x, step: x + step, ONE, 3, damping=0.01)
    assert term.asked == [2, 2, 2]
    left = 0.4 * (1 - 100 / 202) ** np.array([2, 3])
    assert found.states[:, 0] == pytest.approx([left[1], 0.0])
    # of the last step what its model of curvature 200 expects
    expected = 10 - 50 * left[0] ** 2 + 100 * left[0] * (away := left[0] - left[1])
    assert found.values == pytest.approx([expected - 100 * away**2, 10.0])


@dataclass(frozen=True)
class Tape:
    """The distance of a point of the body from the world's origin, measured with a deviation."""

    point: Floats
    distance: float
    deviation: float

    def linearise(self, states: Floats) -> Quadratic:
        arms = states[:, :3, :3] @ self.point
        places = arms + states[:, :3, 3]
        far = np.linalg.norm(places, axis=1)
        along = places / far[:, None]
        J = np.concatenate([along, np.cross(arms, along)], axis=1) / self.deviation
        left = (self.distance - far) / self.deviation
        return Quadratic(-0.5 * left**2, left[:, None] * J, J[:, :, None] * J[:, None])


def test_a_new_kind_of_evidence_is_climbed_with_what_is_known_before() -> None:
    start = np.eye(4)
    start[:3, 3] = [300.0, 0.0, 0.0]
    prior = NormalPrior(start, np.repeat([2.0, 0.01], 3), np.ones(6, dtype=np.bool_))
    tape = Tape(np.zeros(3), 310.0, 1.0)
    starts = perturb(
        start, np.random.default_rng(0).normal(0, 1, (5, 6)) * [2, 2, 2, 0.1, 0.1, 0.1]
    )
    found = ascend(Sum((tape, prior)), starts, perturb, prior.free)
    # 300 ± 2 and 310 ± 1: (300/4 + 310) / (1/4 + 1) = 308
    expected = np.array([8.0, 0, 0, 0, 0, 0])
    for T in found.states:
        np.testing.assert_allclose(twist_between(start, T), expected, atol=1e-4)
    assert found.values == pytest.approx([-0.5 * (2.0**2 + 4.0**2)] * 5, rel=1e-6)


def test_a_sum_has_a_hessian_where_all_terms_know_theirs() -> None:
    prior = NormalPrior(np.eye(4), np.ones(6), np.ones(6, dtype=np.bool_))
    twice = Sum((prior, prior)).linearise(np.eye(4)[None])
    assert twice.hessian is not None
    np.testing.assert_allclose(twice.hessian[0], 2 * np.eye(6))
    assert Sum((prior, Tape(np.ones(3), 1.0, 1.0))).linearise(np.eye(4)[None]).hessian is None


def test_a_direction_that_is_not_free_is_left_alone() -> None:
    ascent = climbed(hill, np.array([2.0, -2.01]), free=np.array([True, False]))
    assert ascent.states[0, 1] == -2.01
    assert ascent.states[0, 0] == pytest.approx(1.0, abs=1e-5)


def test_a_direction_without_curvature_does_no_harm() -> None:
    def ridge(x: Floats) -> tuple[float, Floats, Floats]:
        value = float(np.exp(-0.5 * x[0] ** 2))
        return value, np.array([-x[0] * value, 0.0]), np.diag([value, 0.0])

    for starts in ([[0.8, 3.0]], [[0.8, 3.0], [-0.4, 3.0]]):
        ascent = climbed(ridge, *np.array(starts))
        np.testing.assert_allclose(ascent.states, [[0.0, 3.0]] * len(starts), atol=1e-6)


def test_values_with_interpolation_error_do_not_stop_the_ascent() -> None:
    def staircase(x: Floats) -> tuple[float, Floats, Floats]:
        value, gradient, curvature = hill(x)
        return round(value, 2), gradient, curvature

    start = np.array([1.3, -2.001])
    stuck = climbed(staircase, start)
    seeing = climbed(staircase, start, options=NewtonOptions(value_error=1e-2))
    np.testing.assert_allclose(seeing.states[0], [1.0, -2.0], atol=1e-6)
    assert np.linalg.norm(stuck.states[0] - [1.0, -2.0]) > 1e-5


def test_out_of_iterations_an_ascent_ends_where_it_last_looked() -> None:
    term = Function(hill)
    ascent = climbed(term, np.array([2.5, -2.02]), options=NewtonOptions(iterations=2))
    assert len(term.asked) == 2
    assert ascent.values[0] == hill(ascent.states[0])[0]


def bowl(claimed: float) -> Callable[[Floats], tuple[float, Floats, Floats]]:
    """Value 10 - 50 x², whose curvature is 100, with another curvature claimed for it."""

    def model(x: Floats) -> tuple[float, Floats, Floats]:
        return 10.0 - 50.0 * float(x[0] ** 2), -100.0 * x, np.array([[claimed]])

    return model


ONE = np.ones(1, dtype=np.bool_)


@pytest.mark.parametrize("starts", [[[0.3]], [[0.3], [-0.2]]])
def test_damping_grows_until_a_step_that_is_far_too_long_becomes_short_enough(
    starts: list[list[float]],
) -> None:
    # by the curvature claimed the first step is a hundred times too long
    ascent = climbed(bowl(1.0), *np.array(starts), free=ONE)
    assert ascent.states[:, 0] == pytest.approx([0.0] * len(starts), abs=1e-5)
    assert ascent.values == pytest.approx([10.0] * len(starts))


def test_the_last_step_is_taken_and_its_gain_counted_though_it_is_not_looked_at() -> None:
    # 0.5 of 9.5 is to be gained, less than the tenth that the tolerance asks for
    options = NewtonOptions(tolerance=0.1, damping=1e-6)
    term = Function(bowl(100.0))
    ascent = climbed(term, np.array([0.1]), free=ONE, options=options)
    assert term.asked == [1]
    assert ascent.states[0, 0] == pytest.approx(0.0, abs=1e-6)
    assert ascent.values[0] == pytest.approx(10.0, abs=1e-6)


def test_a_definite_hessian_is_used_in_place_of_a_curvature_that_is_too_large() -> None:
    def with_hessian(x: Floats) -> tuple[float, Floats, Floats, Floats]:
        return *bowl(300.0)(x), np.array([[100.0]])

    start = np.array([[0.3]])
    slow, fast = (
        stepped(Function(model), start, lambda x, step: x + step, ONE, 1)
        for model in (bowl(300.0), with_hessian)
    )
    # a step of a third of the way leaves 0.2, Newton's the damping's 1e-4 of 0.3
    assert slow.states[0, 0] == pytest.approx(0.2, abs=1e-4)
    assert fast.states[0, 0] == pytest.approx(0.0, abs=1e-4)


def test_a_curvature_that_is_too_large_is_corrected_by_what_gradients_show() -> None:
    # nine times too large along one direction, right along the other: nine steps by it alone would
    # leave (8/9)^9 = 0.35 of the way
    def ridge(x: Floats) -> tuple[float, Floats, Floats]:
        bent = np.array([100.0, 4.0])
        return 10 - 0.5 * float(bent @ x**2), -bent * x, np.diag([900.0, 4.0])

    term = Function(ridge)
    ascent = climbed(term, np.array([0.03, 0.05]), options=NewtonOptions(tolerance=1e-8))
    assert len(term.asked) <= 10
    # where 1e-8 of the value is left to be gained, √(2e-7 / 4) of the way along the flat one is
    np.testing.assert_allclose(ascent.states[0], 0.0, atol=3e-4)


def test_a_gradient_that_hardly_falls_lengthens_steps_tenfold_at_most() -> None:
    # of a curvature of 100 gradients show 1: the second step is ten times as long, not a hundred
    def flat(x: Floats) -> tuple[float, Floats, Floats]:
        return 10 - 0.5 * float(x @ x), -x, np.array([[100.0]])

    seen = list[float]()

    def noted(x: Floats) -> tuple[float, Floats, Floats]:
        seen.append(float(x[0]))
        return flat(x)

    options = NewtonOptions(iterations=3, damping=1e-6)
    climbed(noted, np.array([1.0]), free=ONE, options=options)
    assert seen == pytest.approx([1.0, 0.99, 0.891], abs=1e-4)
    # a first step that gains 0.8 % of the value is not near the top: the next is no longer for it
    seen.clear()
    climbed(noted, np.array([3.0]), free=ONE, options=options)
    assert seen == pytest.approx([3.0, 2.97, 2.9403], abs=1e-4)


def test_a_hessian_that_is_not_definite_does_not_lead_to_the_valley_between_two_hills() -> None:
    def hills(x: Floats) -> tuple[float, Floats, Floats, Floats]:
        """Hills of height 2 at -1 and 1; at the start the second derivative is positive."""
        x0 = float(x[0])
        gradient = np.array([x0 - x0**3])
        hessian = np.array([[3 * x0**2 - 1]])
        return 2 - (x0**2 - 1) ** 2 / 4, gradient, np.array([[3 * x0**2 + 1]]), hessian

    ascent = climbed(Function(hills), np.array([0.1]), np.array([-0.7]), free=ONE)
    assert ascent.states[:, 0] == pytest.approx([1.0, -1.0], abs=1e-5)


def test_least_squares_are_climbed_in_one_step() -> None:
    rng = np.random.default_rng(0)
    J, residuals = rng.standard_normal((12, 4)), rng.standard_normal(12)
    known, free = LinearResiduals(np.eye(4) / 0.3, np.full(4, 0.1)), np.array([1, 1, 0, 1], bool)
    step = least_squares(LinearResiduals(J, residuals), known)[0]
    both = np.vstack([J, known.J]), np.append(residuals, known.residuals)
    # the damping of what has no curvature, a part in 1e12
    assert np.allclose(step, np.linalg.lstsq(*both)[0], rtol=1e-9)
    held = least_squares(LinearResiduals(J, residuals), free=free)[0]
    assert held[2] == 0
    assert np.allclose(held[free], np.linalg.lstsq(J[:, free], residuals)[0], rtol=1e-9)
