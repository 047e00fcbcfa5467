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
from mixpose.optimise import NewtonOptions, ascend
from mixpose.records import GridPattern
from mixpose.rigid import perturb, twist_between

Floats: TypeAlias = NDArray[np.float64]
Mask: TypeAlias = NDArray[np.bool_]

# gains of 1e-6 nats do not matter: 0.001 standard deviations; bilinear values on tiles err by 2e-3
_NATS = 1e-6
_ROUGH = 1e-2  # that tell which of several maxima is the highest
_VALUE_ERROR = 2e-3


class LogLikelihood(Protocol):
    """A log-likelihood of the pose, in nats."""

    @property
    def is_alone(self) -> bool:
        """Whether no other pose can be as likely as the one around which it was made."""
        ...

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

    def highest(self, starts: Sequence[Floats], nats: float = _NATS) -> Floats:
        """The highest of the maxima (4, 4) reached from starts (4, 4), but for some nats."""
        ends = []
        for T in starts:
            scale = max(abs(self.linearise(T).value), 1.0)
            options = NewtonOptions(60, max(1e-11, nats / scale), value_error=_VALUE_ERROR)
            ends.append(ascend(self.linearise, perturb, T, self.prior.free, options))
        return max(ends, key=lambda end: end.value).state


def most_probable(
    likelihood_near: Callable[[Floats, bool], LogLikelihood | None],
    T_world_object: Floats,
    prior: Prior,
) -> Floats:
    """Maximise the posterior.

    Parameters
    ----------
    likelihood_near : callable
        The log-likelihood around a pose (4, 4), with the noise that this pose leaves, and if true
        drawn finely close to it; None where nothing is seen there.
    T_world_object : (4, 4) array
        A maximum of the likelihood.
    prior : Prior

    Returns
    -------
    (4, 4) array
    """
    T, likelihood = T_world_object, likelihood_near(T_world_object, True)
    if likelihood is not None and not likelihood.is_alone:
        wide = likelihood_near(T, False)
        if wide is not None:
            T = Posterior(wide, prior).highest([T, *prior.points()], _ROUGH)
            likelihood = likelihood_near(T, True)
    for _ in range(2):  # the second is drawn around the maximum and knows the noise there
        if likelihood is None:
            return T
        T = Posterior(likelihood, prior).highest([T])
        likelihood = likelihood_near(T, True)
    return T


@dataclass(frozen=True)
class GridLikelihood:
    """Log-likelihood of grey values and profiles, made around a pose.

    Attributes
    ----------
    objective : MatchedObjective
        In nats.
    shares : tuple of float
        Of each sensor's energy ⟨g, g⟩, explained by the pose: ⟨g, h⟩² / (⟨g, g⟩ ⟨h, h⟩).
    noise : tuple of float
        Variance of a cell's noise times the size of a cell, per sensor.
    """

    objective: MatchedObjective
    shares: tuple[float, ...]
    noise: tuple[float, ...]

    @property
    def is_alone(self) -> bool:
        """Whether no other pose can be as likely.

        The shares of one density that orthogonal predictions explain sum to 1 at the most
        (Bessel's inequality): a pose that explains more than half of each is alone.
        """
        return min(self.shares) > 0.5

    def linearise(self, T_world_object: Floats) -> Quadratic:
        """Value, gradient and curvature at one pose (4, 4)."""
        return self.objective.linearise(T_world_object)


def grid_likelihood(
    views: Sequence[View], body: Body, misfit: float, T_world_object: Floats, fine: bool
) -> GridLikelihood | None:
    """Make the log-likelihood of grid patterns at σ_ε around a pose.

    Parameters
    ----------
    views : sequence of View
        All with grid patterns.
    body : Body
    misfit : float
        Factor on the variance of the noise: χ² per degree of freedom of a body that does not fit.
    T_world_object : (4, 4) array
        What it leaves unexplained is taken for noise.
    fine : bool
        Whether densities are drawn finely, close to the features at that pose.
    """
    sigmas = [view.observation.sigma for view in views]
    patterns = {view.name: view.observation.pattern for view in views}
    terms, shares, noise = [], [], []
    for term in matched_objective(views, body, sigmas, T_world_object, fine=fine).terms:
        plain = MatchedObjective([replace(term, weight=1.0)], body)
        shares.append(float(plain.value(T_world_object[None])[0]))
        pattern = patterns[term.name]
        assert isinstance(pattern, GridPattern)
        noise.append(cell_variance(term.energy, shares[-1], pattern.values.size))
        terms.append(replace(term, weight=0.5 * term.energy / (misfit * noise[-1])))
    objective = MatchedObjective(terms, body)
    return GridLikelihood(objective, tuple(shares), tuple(noise)) if terms else None


def cell_variance(energy: float, share: float, cells: int) -> float:
    """Variance of a cell's noise times the size of a cell, from the energy left unexplained.

    Parameters
    ----------
    energy : float
        ⟨g, g⟩, the integral of g² over all cells.
    share : float
        Of it, explained.
    cells : int
    """
    # shares are quotients of single-precision numbers: nothing below 1e-9 is known of a rest
    return max(1 - share, 1e-9) * energy / cells
