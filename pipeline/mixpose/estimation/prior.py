"""The most probable pose, where it is known how far off the start may be.

The matched objective of a sensor is ⟨g, h⟩² / ⟨h, h⟩, the energy of its density g that a pose
explains.  Under white noise half of it over the noise of a cell is the log-likelihood, with the
amplitude at its best.  To this the Gaussian prior of the start is added, and the sum is maximised.

Under heavy noise the sum has several maxima.  They are sought from the start, from the maximum of
the objective through the blurs, and from the points of the cubature rule of third degree, which
has the mean and the covariance of the prior; the highest is taken.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

from mixpose.body import Body
from mixpose.objective import MatchedObjective, Quadratic, View, matched_objective
from mixpose.objective.stack import MatchedTerm
from mixpose.optimise import NewtonOptions, ascend
from mixpose.records import GridPattern
from mixpose.rigid import perturb, twist_between

Floats: TypeAlias = NDArray[np.float64]
Mask: TypeAlias = NDArray[np.bool_]

# gains of 1e-6 nats do not matter: 0.001 standard deviations; bilinear values on tiles err by 2e-3
_NATS = 1e-6
_VALUE_ERROR = 2e-3


class LogLikelihood(Protocol):
    """A log-likelihood of the pose, in nats."""

    def linearise(self, T_world_object: Floats) -> Quadratic:
        """Value, gradient and curvature at one pose (4, 4)."""
        ...


@dataclass(frozen=True)
class Prior:
    """A normal distribution of the pose.

    Attributes
    ----------
    T_world_object : (4, 4) float64
        Its mean.
    uncertainty : (6,) float64
        Standard deviations, lengths and radians; positive where free.
    free : (6,) bool
        Directions in which the pose may change.
    """

    T_world_object: Floats
    uncertainty: Floats
    free: Mask

    def information(self) -> Floats:
        """Inverse variances (6,), 0 where not free."""
        return np.where(self.free, 1 / np.where(self.free, self.uncertainty, 1.0) ** 2, 0.0)

    def points(self) -> list[Floats]:
        """The mean, and √k standard deviations to either side along each of k directions."""
        count = int(self.free.sum())
        steps = np.sqrt(count) * np.diag(np.where(self.free, self.uncertainty, 0.0))[self.free]
        around = [perturb(self.T_world_object, s * step) for step in steps for s in (1, -1)]
        return [self.T_world_object, *around]


@dataclass(frozen=True)
class Posterior:
    """Log-likelihood and prior, up to a constant."""

    likelihood: LogLikelihood
    prior: Prior

    def linearise(self, T_world_object: Floats) -> Quadratic:
        """Value, gradient and curvature at one pose (4, 4)."""
        one = self.likelihood.linearise(T_world_object)
        information = self.prior.information()
        away = twist_between(self.prior.T_world_object, T_world_object)
        return Quadratic(
            one.value - 0.5 * float(away @ (information * away)),
            one.gradient - information * away,
            one.curvature + np.diag(information),
            None if one.hessian is None else one.hessian + np.diag(information),
        )

    def highest(self, starts: Sequence[Floats]) -> Floats:
        """The highest of the maxima (4, 4) that are reached from starts (4, 4)."""
        ascents = [self._ascend(T) for T in starts]
        return max(ascents, key=lambda one: one[1])[0]

    def _ascend(self, T: Floats) -> tuple[Floats, float]:
        scale = max(abs(self.linearise(T).value), 1.0)
        options = NewtonOptions(60, max(1e-11, _NATS / scale), value_error=_VALUE_ERROR)
        found = ascend(self.linearise, perturb, T, self.prior.free, options)
        return found.state, found.value


def most_probable(
    likelihood_near: Callable[[Floats, bool], LogLikelihood | None],
    T_world_object: Floats,
    prior: Prior,
    *,
    alone: bool,
) -> Floats:
    """The maximum of the posterior.

    Parameters
    ----------
    likelihood_near : callable
        The log-likelihood around a pose (4, 4), if true drawn so finely around it that nothing of
        the drawing is left in its maximum; None where nothing is seen there.
    T_world_object : (4, 4) array
        A maximum of the likelihood.
    prior : Prior
    alone : bool
        Whether no other pose can be as likely.

    Returns
    -------
    (4, 4) array
    """
    T = T_world_object
    if not alone:
        likelihood = likelihood_near(T, False)
        if likelihood is not None:
            T = Posterior(likelihood, prior).highest([T, *prior.points()])
    # noise is known from the second time on, and drawn places are those asked for
    for _ in range(3):
        likelihood = likelihood_near(T, True)
        if likelihood is None:
            return T
        T = Posterior(likelihood, prior).highest([T])
    return T


@dataclass(frozen=True)
class GridLikelihood:
    """Log-likelihood of grey values and profiles.

    Attributes
    ----------
    views : sequence of View
        All with grid patterns.
    body : Body
    """

    views: Sequence[View]
    body: Body

    def terms(self, T_world_object: Floats, fine: bool) -> Sequence[MatchedTerm]:
        """The terms at σ_ε, each with the energy that the pose explains as its value."""
        sigmas = [view.observation.sigma for view in self.views]
        objective = matched_objective(self.views, self.body, sigmas, T_world_object, fine=fine)
        return [replace(term, weight=term.energy) for term in objective.terms]

    def near(self, T_world_object: Floats, fine: bool) -> MatchedObjective | None:
        """The log-likelihood around a pose, with the noise that the pose leaves."""
        terms = self.terms(T_world_object, fine)
        if not terms:
            return None
        noise = [
            cell_variance(term, self.cells(term), self.explained(term, T_world_object))
            for term in terms
        ]
        weighted = [
            replace(term, weight=0.5 * term.energy / variance)
            for term, variance in zip(terms, noise, strict=True)
        ]
        return MatchedObjective(weighted, self.body)

    def explained(self, term: MatchedTerm, T_world_object: Floats) -> float:
        """⟨g, h⟩² / ⟨h, h⟩ of one of the `terms`."""
        return float(MatchedObjective([term], self.body).value(T_world_object[None])[0])

    def cells(self, term: MatchedTerm) -> int:
        """Grid points of the pattern that a term is of."""
        pattern = next(v.observation.pattern for v in self.views if v.name == term.name)
        assert isinstance(pattern, GridPattern)
        return int(pattern.values.size)

    def is_alone(self, T_world_object: Floats) -> bool:
        """Whether no other pose can explain as much.

        The shares of one density that orthogonal predictions explain sum to 1 at the most
        (Bessel's inequality): a pose that explains more than half of each is alone.
        """
        terms = self.terms(T_world_object, True)
        return all(self.explained(term, T_world_object) > 0.5 * term.energy for term in terms)


def cell_variance(term: MatchedTerm, cells: int, explained: float) -> float:
    """Variance of a cell's noise times its size, from the energy left unexplained.

    Parameters
    ----------
    term : MatchedTerm
    cells : int
    explained : float
        ⟨g, h⟩² / ⟨h, h⟩.
    """
    # the energy is a difference of single-precision numbers' sums: nothing below 1e-9 is known
    return max(term.energy - explained, 1e-9 * term.energy) / cells
