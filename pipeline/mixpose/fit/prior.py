"""Grey values and profiles: the most probable pose, also of a body that does not fit.

Under white noise half of the energy ⟨g, h⟩² / ⟨h, h⟩ that a pose explains, over the noise of a
cell, is the log-likelihood with the amplitude at its best; the Gaussian prior of the start comes on
top.  Under heavy noise the sum has several maxima: they are sought from the maximum of the
objective, and from the points of the cubature rule of third degree, which has mean and covariance
of the prior.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.special import chdtri

from mixpose.fit.misfit import SensorDensity, fit_freed, misfit
from mixpose.fit.options import FitRules
from mixpose.objective import (
    AmplitudesObjective,
    MatchedObjective,
    NormalPrior,
    View,
    matched_objective,
)
from mixpose.objective.matched import FINE_STEPS, STEPS_PER_SIGMA, value_error
from mixpose.optimise import NewtonOptions, Sum, Term, ascend
from mixpose.records import Floats, Indices
from mixpose.rigid import perturb, transform

NATS = 1e-6
"""Gains of log-likelihood that do not matter: 0.001 standard deviations; and shares of the energy:
a part in a thousand of heights, which drawing may be off by."""


@dataclass(frozen=True)
class Likelihood:
    """Log-likelihood of densities with noise in every cell."""

    objective: MatchedObjective  # in nats
    shares: Floats  # (L,) of each sensor's energy ⟨g, g⟩, explained by the pose
    noise: Floats  # (L,) variance of a cell's noise times the size of a cell

    @property
    def is_alone(self) -> bool:
        """Whether no other pose can be as likely: it explains more than half of each density.

        Shares that orthogonal predictions explain sum to 1 at the most (Bessel's inequality).
        """
        return bool(self.shares.min() > 0.5)


def has_likelihood(views: Sequence[View]) -> bool:
    """Whether all sensors gave grey values or profiles, whose noise is that of their cells."""
    return all(view.observation.cell is not None for view in views)


def likelihood_at(
    objective: MatchedObjective, T_world_object: Floats, misfit: float = 1.0
) -> Likelihood:
    """The log-likelihood; what an objective at σ_ε leaves at a pose (4, 4) is taken for noise.

    `misfit`, χ² per degree of freedom of a body that does not fit, is a factor on its variance.
    """
    plain = replace(objective, weights=np.ones_like(objective.weights))
    shares = plain.shares(T_world_object[None])[:, 0]
    noise = cell_variances(objective.energies[:, 0], shares, _cells(objective))
    weights = (0.5 * objective.energies[:, 0] / (misfit * noise))[:, None]
    return Likelihood(replace(objective, weights=weights), shares, noise)


def cell_variances(energies: Floats, shares: Floats, cells: Indices) -> Floats:
    """Variance of a cell's noise times its size (L,): the unexplained of energies, over cells."""
    # shares are quotients of single-precision numbers: nothing below 1e-9 is known of a rest
    return np.asarray(np.maximum(1 - shares, 1e-9) * energies / cells)


def most_probable(
    objective: MatchedObjective, T_world_object: Floats, prior: NormalPrior, misfit: float = 1.0
) -> Floats:
    """The pose (4, 4) that maximises likelihood and prior, from a maximum of the objective."""
    T = T_world_object
    likelihood = likelihood_at(objective, T, misfit)
    if not likelihood.is_alone:
        starts = np.concatenate([T[None], prior.points()])
        # roughly: it is asked which of several maxima is highest
        T = _climbed(likelihood.objective, prior, starts, 1e4 * NATS)
    for _ in range(2):  # the second time with the noise that the maximum leaves
        T = _climbed(likelihood_at(objective, T, misfit).objective, prior, T[None], NATS)
    return T


def believed(
    objective: MatchedObjective,
    T_world_object: Floats,
    prior: NormalPrior,
    rules: FitRules = FitRules(),
) -> tuple[Floats, bool]:
    """The most probable pose (4, 4) near a maximum of an objective at σ_ε, whose cells have noise.

    Or the fit to freed features of a body that does not fit, and whether it is that.
    """
    projection, body = objective.projection, objective.projection.body
    T = most_probable(objective, T_world_object, prior)
    T_unlike, noises = with_amplitudes(objective, T, prior, rules)
    if not projection.project(T[None]).seen.all() or len(body.nodes.points) != len(body):
        return T_unlike, False
    densities = _densities(objective, noises)
    points = transform(T_unlike, body.nodes.points)
    ratio = misfit(densities, points, int(prior.free.sum()), rules)
    if ratio == 1:
        return T_unlike, False
    sigmas = [view.observation.sigma for view in objective.views]
    # to look for peaks everywhere
    rough = matched_objective(objective.views, body, sigmas, steps_per_sigma=STEPS_PER_SIGMA)
    starts = np.concatenate([T[None], prior.points()])
    T_freed = fit_freed(projection, _densities(rough, noises), starts, prior.free)
    if T_freed is not None:
        return T_freed, True
    # what is left at features is no noise of cells: in a body that does not fit it is as large
    T = most_probable(objective, T, prior, ratio)
    return with_amplitudes(objective, T, prior, rules, ratio)[0], False


def with_amplitudes(
    objective: MatchedObjective,
    T_world_object: Floats,
    prior: NormalPrior,
    rules: FitRules,
    misfit: float = 1.0,
) -> tuple[Floats, Floats]:
    """The most probable pose near that of equally bright features, and the noise (L,) of cells."""
    T, equal = T_world_object, likelihood_at(objective, T_world_object).noise
    noise, cells = equal, _cells(objective)
    smallest = NATS * objective.energies[:, 0] / cells
    for _ in range(3):  # noise and pose by turns: the noise holds to a part in a hundred
        unlike = AmplitudesObjective(objective, noise, rules.unlike)
        noise = np.maximum(unlike.unexplained(T) / cells, smallest)
        T = _climbed(replace(unlike, noise=misfit * noise), prior, T[None], NATS)
    # twice the logarithm of the ratio of likelihoods, each with its own noise
    gain = float(cells @ np.log(np.maximum(equal, smallest) / noise))
    freedom = len(cells) * (len(objective.projection.body.nodes.points) - 1)
    is_equal = gain < float(chdtri(freedom, 1 - rules.believed))
    return (T_world_object, equal) if is_equal else (T, noise)


def _cells(objective: MatchedObjective) -> Indices:
    return np.array([view.observation.cells for view in objective.views])


def _densities(objective: MatchedObjective, noises: Floats) -> list[SensorDensity]:
    """The densities that an objective has drawn."""

    def sampled(sensor: int, y: Floats) -> Floats:
        padded = np.zeros((len(objective.views), 1, len(y), 2))
        padded[sensor, 0, :, : y.shape[1]] = y
        return objective.atlas.look_up(padded)[sensor, 0, :, : 1 + y.shape[1]]

    each = zip(objective.views, objective.variances[:, 0].tolist(), noises.tolist(), strict=True)
    return [
        SensorDensity(view.sensor, partial(sampled, k), variance, noise, view.observation.extent)
        for k, (view, variance, noise) in enumerate(each)
    ]


def _climbed(likelihood: Term, prior: NormalPrior, starts: Floats, nats: float) -> Floats:
    """The highest maximum (4, 4) of likelihood and prior near starts (H, 4, 4), to some nats."""
    options = NewtonOptions(60, 1e-11, value_error=value_error(FINE_STEPS), negligible=nats)
    ends = ascend(Sum((likelihood, prior)), starts, perturb, prior.free, options)
    return np.asarray(ends.states[int(np.argmax(ends.values))])
