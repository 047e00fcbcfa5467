"""The most probable pose: against normal distributions worked out by hand, and Bessel's bound."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import cast

import numpy as np
import pytest
from numpy.typing import NDArray

from mixpose.fit import probable
from mixpose.fit.probable import cell_variances, most_probable
from mixpose.objective import MatchedObjective, NormalPrior
from mixpose.optimise import Quadratic
from mixpose.rigid import perturb, twist_between

Floats = NDArray[np.float64]
FREE = np.ones(6, dtype=np.bool_)


@dataclass(frozen=True)
class Normals:
    """A likelihood that is a sum of normal distributions of the shift, as high as given."""

    centres: Floats
    heights: Floats
    sigma: float
    is_alone: bool = False

    def linearise(self, poses: Floats) -> Quadratic:
        away = self.centres - poses[:, None, :3, 3]
        bells = self.heights * np.exp(-0.5 * (away**2).sum(axis=2) / self.sigma**2)
        value = bells.sum(axis=1)
        gradient, curvature = np.zeros((len(poses), 6)), np.zeros((len(poses), 6, 6))
        gradient[:, :3] = (bells[..., None] * away).sum(axis=1) / self.sigma**2
        curvature[:, :3, :3] = np.eye(3) * value[:, None, None] / self.sigma**2
        return Quadratic(value, gradient, curvature)


@dataclass(frozen=True)
class Parabola:
    """The likelihood of a normal measurement of the pose."""

    measured: Floats
    information: Floats
    is_alone: bool = True

    def linearise(self, poses: Floats) -> Quadratic:
        away = -twist_between(self.measured, poses)
        pull = away @ self.information
        C = np.broadcast_to(self.information, (len(poses), 6, 6))
        return Quadratic(-0.5 * (away * pull).sum(axis=1), pull, C)


Toy = Normals | Parabola
MostProbable = Callable[[Toy, Floats, NormalPrior], Floats]


@dataclass(frozen=True)
class Drawn:
    """A likelihood as it is at a pose: the same everywhere."""

    objective: Toy

    @property
    def is_alone(self) -> bool:
        return self.objective.is_alone


@pytest.fixture
def most_probable_of(monkeypatch: pytest.MonkeyPatch) -> MostProbable:
    """The most probable pose of a likelihood that is given, not drawn."""

    def maximise(toy: Toy, T: Floats, prior: NormalPrior) -> Floats:
        monkeypatch.setattr(probable, "likelihood_at", lambda *_: Drawn(toy))
        return most_probable(cast(MatchedObjective, None), T, prior)

    return maximise


def test_of_two_normal_distributions_the_mean_weighted_by_information_is_most_probable(
    most_probable_of: MostProbable,
) -> None:
    # shifts: start 0 ± 2 and measurement 10 ± 1 → (0/4 + 10/1) / (1/4 + 1/1) = 8
    # turns: start 0 ± 0.1 and measurement 0.02 ± 0.1 → 0.01
    prior = NormalPrior(np.eye(4), np.array([2.0] * 3 + [0.1] * 3), FREE)
    measured = perturb(np.eye(4), np.array([10.0, 0, 0, 0, 0, 0.02]))
    likelihood = Parabola(measured, np.diag([1.0] * 3 + [100.0] * 3))
    T = most_probable_of(likelihood, measured, prior)
    assert twist_between(np.eye(4), T) == pytest.approx([8, 0, 0, 0, 0, 0.01], abs=1e-6)


def test_directions_that_are_not_free_stay(most_probable_of: MostProbable) -> None:
    free = np.array([True, False, True, True, True, True])
    prior = NormalPrior(np.eye(4), np.array([2.0] * 3 + [0.1] * 3), free)
    measured = perturb(np.eye(4), np.array([10.0, 10.0, 0, 0, 0, 0]))
    likelihood = Parabola(measured, np.diag([1.0] * 3 + [100.0] * 3))
    T = most_probable_of(likelihood, np.eye(4), prior)
    assert T[:3, 3] == pytest.approx([8, 0, 0], abs=1e-6)


@pytest.mark.parametrize(("near", "far", "expected"), [(9.0, 10.0, 2.0), (5.0, 20.0, -6.0)])
def test_the_highest_of_several_maxima_is_taken(
    near: float, far: float, expected: float, most_probable_of: MostProbable
) -> None:
    # log-likelihoods at x = 2 and x = -6; the start 0 ± 3 costs 0.2 and 2 nats there
    prior = NormalPrior(np.eye(4), np.array([3.0] * 3 + [0.1] * 3), FREE)
    centres = np.array([[2.0, 0, 0], [-6.0, 0, 0]])
    likelihood = Normals(centres, np.array([near, far]), 1.0)
    T = most_probable_of(likelihood, np.eye(4), prior)
    # the prior draws by x σ² / (9 height) at the most
    assert T[0, 3] == pytest.approx(expected, abs=0.1)


def test_points_of_the_prior_have_its_mean_and_its_covariance() -> None:
    uncertainty = np.array([1.0, 2, 3, 0.01, 0.02, 0.03])
    prior = NormalPrior(np.eye(4), uncertainty, FREE)
    twists = np.array([twist_between(np.eye(4), T) for T in prior.points()[1:]])
    assert twists.mean(axis=0) == pytest.approx(np.zeros(6), abs=1e-12)
    assert twists.T @ twists / len(twists) == pytest.approx(np.diag(uncertainty**2), abs=1e-9)


def test_a_prior_alone_is_its_own_maximum(most_probable_of: MostProbable) -> None:
    prior = NormalPrior(np.eye(4), np.ones(6), FREE)
    nothing = Parabola(np.eye(4), np.zeros((6, 6)))
    begin = perturb(np.eye(4), np.full(6, 0.3))
    assert most_probable_of(nothing, begin, prior) == pytest.approx(np.eye(4), abs=1e-6)


def test_noise_of_a_cell_is_the_energy_left_over_the_number_of_cells() -> None:
    # white noise of standard deviation 3 on 1000 cells of size 0.5: energy 1000 · 9 · 0.5
    found = cell_variances(np.array([4500.0 / 0.6]), np.array([0.4]), np.array([1000]))
    assert found == pytest.approx([9 * 0.5])
