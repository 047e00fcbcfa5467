"""Features that are not equally bright: amplitudes, value and slopes against the image itself."""

from __future__ import annotations

import numpy as np
import pytest

from mixpose.body import Body, PointFeature
from mixpose.density import Observation
from mixpose.objective import AmplitudesObjective, MatchedObjective, View, matched_objective
from mixpose.objective.matched import FINE_STEPS
from mixpose.records import Floats, GridPattern
from mixpose.rigid import perturb
from mixpose.sensors import ParallelBeam

PLACES = np.array([[0.0, 0.0, 0.0], [4.0, 1.0, 3.0], [-12.0, 9.0, -5.0]])
BODY = Body("three", tuple(PointFeature(place) for place in PLACES))
BEAM = ParallelBeam(1.0, np.array([40.0, 40.0]), (81, 81), np.eye(4))
BRIGHT = np.array([1.0, 0.6, 0.8])
V, U = np.mgrid[:81, :81] - 40.0


def bells(T: Floats) -> Floats:
    """Images of the features (3, 81, 81), spots of σ = 2 px."""
    at = PLACES @ T[:3, :3].T + T[:3, 3]
    return np.stack([np.exp(-((U - x) ** 2 + (V - y) ** 2) / 8) for x, y, _ in at])


IMAGE = np.tensordot(BRIGHT, bells(np.eye(4)), 1)


def matched() -> MatchedObjective:
    pattern = GridPattern(IMAGE.astype(np.float32), np.zeros(2), 1.0)
    view = View("grey", BEAM, Observation(pattern, 2.0, intrinsic=2.0))
    return matched_objective([view], BODY, [2.0], steps_per_sigma=FINE_STEPS)


def squares_left(T: Floats) -> float:
    """Share of the image that no amplitudes of its features explain, by least squares."""
    columns = bells(T).reshape(3, -1).T
    rest = IMAGE.ravel() - columns @ np.linalg.lstsq(columns, IMAGE.ravel())[0]
    return float(rest @ rest / (IMAGE.ravel() @ IMAGE.ravel()))


AWAY = perturb(np.eye(4), np.array([0.5, -0.3, 0.2, 0.02, -0.03, 0.04]))


def test_free_amplitudes_leave_what_least_squares_on_the_image_leaves() -> None:
    objective = matched()
    free = AmplitudesObjective(objective, 1e-9 * objective.energies[:, 0], 10.0)
    left = free.unexplained(AWAY) / objective.energies[:, 0]
    assert left[0] == pytest.approx(squares_left(AWAY), rel=1e-3)
    assert free.unexplained(np.eye(4))[0] / objective.energies[0, 0] < 1e-5


def test_equal_amplitudes_are_the_matched_kernel() -> None:
    objective = matched()
    noise = 1e-3 * objective.energies[:, 0]
    equal = AmplitudesObjective(objective, noise, 1e-6).linearise(AWAY[None])
    weights = (0.5 * objective.energies[:, 0] / noise)[:, None]
    kernel = MatchedObjective(
        objective.views,
        objective.projection,
        objective.atlas,
        objective.variances,
        objective.tops,
        objective.energies,
        weights,
    ).linearise(AWAY[None])
    assert equal.value == pytest.approx(kernel.value, rel=1e-6)
    np.testing.assert_allclose(equal.gradient, kernel.gradient, rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("spread", [1e-3, 0.3, 10.0])
def test_the_gradient_is_that_of_the_value(spread: float) -> None:
    objective = matched()
    some = AmplitudesObjective(objective, 1e-3 * objective.energies[:, 0], spread)
    found = some.linearise(AWAY[None]).gradient[0]
    steps = np.diag(np.repeat([2e-2, 2e-3], 3))
    ahead, behind = (some.linearise(perturb(AWAY, sign * steps)).value for sign in (1, -1))
    numeric = (ahead - behind) / (2 * np.diag(steps))
    # looked-up values err by 1e-7 of their height; third derivatives by less than a part in 1000
    np.testing.assert_allclose(found, numeric, rtol=3e-3, atol=3e-3 * np.abs(numeric).max())


def test_gauss_newton_finds_the_place_in_a_few_steps() -> None:
    objective = matched()
    free = np.array([True, True, False, False, False, True])
    some = AmplitudesObjective(objective, 1e-6 * objective.energies[:, 0], 0.3)
    T = perturb(np.eye(4), np.array([0.5, -0.3, 0.0, 0.0, 0.0, 0.04]))
    for _ in range(6):
        model = some.linearise(T[None])
        C = model.curvature[0]
        assert np.linalg.eigvalsh(C).min() > -1e-6 * np.abs(C).max()
        step = np.zeros(6)
        step[free] = np.linalg.solve(C[np.ix_(free, free)], model.gradient[0, free])
        T = perturb(T, step)
    np.testing.assert_allclose(T, np.eye(4), atol=2e-3)
