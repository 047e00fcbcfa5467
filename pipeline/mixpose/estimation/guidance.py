"""Ascent of a noisy likelihood, guided by how far off the start may be.

Under heavy noise the likelihood has many peaks within the uncertainty of the start, and in
directions of which the data say little a distant one may be as high as that of the truth.  The
start's uncertainty acts as a prior that is faded out: each peak is followed from a stronger prior
to a weaker one, and a peak farther from the start than it may be off is not believed.  Where the
data say much, the prior changes nothing and is left out at once.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from mixpose.body import Body
from mixpose.density import Observation
from mixpose.objective import MatchedObjective, Quadratic, View, matched_objective
from mixpose.objective.stack import MatchedTerm
from mixpose.optimise import NewtonOptions, ascend
from mixpose.records import GridPattern
from mixpose.rigid import perturb, twist_between

Floats: TypeAlias = NDArray[np.float64]

FADING = (1.0, 0.3, 0.1, 0.03, 0.0)
"""Strengths of the prior on the way."""

INFORMATIVE = 100.0
"""Information of the data over that of the start, from which no guidance is needed."""

_BELIEVED = 0.99  # share of the start's own distribution within which a peak is believed
_VALUE_ERROR = 2e-3  # of bilinear values on tiles; below it the gradient judges
_NATS = 1e-6  # gains of log-likelihood that do not matter: 0.001 standard deviations


@dataclass(frozen=True)
class _Guided:
    """Log-likelihood with a prior N(T_start, 1/information)."""

    likelihood: MatchedObjective
    T_start: Floats
    information: Floats

    def linearise(self, T_world_object: Floats) -> Quadratic:
        one = self.likelihood.linearise(T_world_object)
        away = twist_between(self.T_start, T_world_object)
        P = np.diag(self.information)
        return Quadratic(
            one.value - 0.5 * float(away @ (self.information * away)),
            one.gradient - self.information * away,
            one.curvature + P,
            None if one.hessian is None else one.hessian + P,
        )


def all_grids(views: Sequence[View]) -> bool:
    """Whether all sensors gave grey values or profiles, whose noise is that of their cells."""
    return all(isinstance(view.observation.pattern, GridPattern) for view in views)


def ascend_guided(
    views: Sequence[View],
    body: Body,
    T_world_object: Floats,
    T_start: Floats,
    uncertainty: Floats,
    free: NDArray[np.bool_],
) -> Floats:
    """Climb the likelihood of grid patterns at their own blur.

    Parameters
    ----------
    views : sequence of View
        All with grid patterns.
    body : Body
    T_world_object : (4, 4) array
        Where to begin.
    T_start : (4, 4) array
        Mean of the prior.
    uncertainty : (6,) array
        Its standard deviations; positive where free.
    free : (6,) bool
    """
    sigmas = [view.observation.sigma for view in views]
    terms = matched_objective(views, body, sigmas, T_world_object, fine=True).terms
    observations = {view.name: view.observation for view in views}
    if not terms:
        return T_world_object
    spread = np.where(free, uncertainty, 1.0)
    information = np.where(free, 1.0 / spread**2, 0.0)
    farthest = float(chdtri(int(free.sum()), 1 - _BELIEVED))
    T, step, informative = T_world_object, 0, False
    while True:
        likelihood = MatchedObjective(_weighed(terms, observations, body, T), body)
        guided = _Guided(likelihood, T_start, FADING[step] * information)
        value = float(likelihood.value(T[None])[0])
        options = NewtonOptions(
            iterations=60,
            tolerance=max(1e-11, _NATS / max(value, _NATS)),
            value_error=_VALUE_ERROR,
        )
        found = ascend(guided.linearise, perturb, T, free, options).state
        away = twist_between(T_start, found)
        if step > 0 and not informative and away @ (information * away) > farthest:
            return T
        T = found
        if FADING[step] == 0:
            return T
        scaled = likelihood.linearise(T).curvature * spread * spread[:, None]
        informative = bool(np.linalg.eigvalsh(scaled[np.ix_(free, free)])[0] > INFORMATIVE)
        step = len(FADING) - 1 if informative else step + 1


def cell_variance(term: MatchedTerm, observation: Observation, explained: float) -> float:
    """Variance of a cell's noise times its size, from the energy left unexplained.

    Parameters
    ----------
    term : MatchedTerm
    observation : Observation
        Of a grid pattern.
    explained : float
        ⟨g, h⟩² / ⟨h, h⟩.
    """
    pattern = observation.pattern
    assert isinstance(pattern, GridPattern)
    left = max(term.energy - explained, 1e-9 * term.energy)
    return left / pattern.values.size * pattern.step ** len(pattern.origin)


def _weighed(
    terms: Sequence[MatchedTerm], observations: dict[str, Observation], body: Body, T: Floats
) -> list[MatchedTerm]:
    """Terms in units of log-likelihood: ⟨g, h⟩² / ⟨h, h⟩ over twice the noise."""
    weighed = []
    for term in terms:
        plain = replace(term, weight=term.energy)
        explained = float(MatchedObjective([plain], body).value(T[None])[0])
        variance = cell_variance(term, observations[term.name], explained)
        weighed.append(replace(term, weight=0.5 * term.energy / variance))
    return weighed
