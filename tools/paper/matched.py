"""The matched estimate of a pose from densities on grids, near a start.

1. `descend`: maximum likelihood under pixel noise, the matched objective of
   `mixpose.objective` with look-ups by summation.  The start's uncertainty guides the descent as
   a prior that is faded out, so that where the data say little a distant noise peak is not taken
   for the pose; where they say much it changes nothing.
2. `settle`: when features, freed from the body, explain much more of the densities than noise
   would (the body is deformed), the pose is the least-squares fit to their places, as for known
   correspondences.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias, cast

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from mixpose.body import Body
from mixpose.density import Atlas
from mixpose.objective import Quadratic, View, pose_jacobian
from mixpose.objective.matched import MatchedObjective, MatchedTerm, overlap_terms
from mixpose.optimise import NewtonOptions, ascend
from mixpose.records import GridPattern
from mixpose.rigid import perturb, transform, twist_between
from paper.quadrature import Quadrature, cut

Floats: TypeAlias = NDArray[np.float64]

FADING = (1.0, 0.3, 0.1, 0.03, 0.0)
"""Strengths of the prior on the way."""

FARTHEST = float(chi2.ppf(0.99, 6))
"""Squared distance from the start, in its standard deviations, that is still believed."""

INFORMATIVE = 100.0
"""Information of the data over that of the start, from which no guidance is needed."""

MISFIT = 10.0
"""Standard deviations of χ² by which freed features must explain more than noise would."""

NEGLIGIBLE = 1e-9
"""Share of the energy below which a misfit is rounding."""

_MARGIN = 8.0  # standard deviations around predicted features that count as their surroundings
_ALL = np.ones(6, dtype=np.bool_)
_NATS = 1e-6  # gains of log-likelihood that do not matter: 0.001 standard deviations


@dataclass(frozen=True)
class Fit:
    """A pose with how it was found.

    Attributes
    ----------
    T_world_object : (4, 4) float64
    misfit : float
        Standard deviations of χ² by which freed features explain more than noise would.
    settled : bool
        Whether the pose was fitted to freed features.
    """

    T_world_object: Floats
    misfit: float
    settled: bool


def fit_grids(views: Sequence[View], body: Body, T_start: Floats, uncertainty: Floats) -> Fit:
    """Estimate a pose from grid patterns at their own blur.

    Parameters
    ----------
    views : sequence of View
        Observations are `GridPattern`.
    body : Body
    T_start : (4, 4) array
    uncertainty : (6,) array
        Standard deviations of the start, order of `mixpose.rigid`.
    """
    terms = grid_terms(views, body, T_start, uncertainty)
    T = descend(terms, body, T_start, uncertainty)
    return settle(terms, body, T)


def likeliest_near(views: Sequence[View], body: Body, T_truth: Floats) -> Floats:
    """The maximum of the likelihood that is reached from the true pose: a yardstick only."""
    terms = grid_terms(views, body, T_truth, np.zeros(6))
    likelihood = MatchedObjective(_weighed(terms, body, T_truth), body)
    return ascend(likelihood.linearise, perturb, T_truth, _ALL, _options(likelihood, T_truth)).state


def grid_terms(
    views: Sequence[View], body: Body, T_start: Floats, uncertainty: Floats
) -> list[MatchedTerm]:
    """Terms of the matched objective at σ_ε, of unit weight and energy."""
    terms = []
    for view in views:
        observation = view.observation
        sigma = observation.sigma
        assert isinstance(observation.pattern, GridPattern)
        points_world = transform(T_start, body.nodes.points)
        y, by_world, _ = view.sensor.linearise(points_world)
        J = pose_jacobian(by_world, T_start, body.nodes.points)
        spread = np.sqrt((J**2 @ uncertainty**2).max(axis=0))
        margin = _MARGIN * sigma + 3 * spread
        blur = float(np.sqrt(2 * sigma**2 - observation.intrinsic**2))
        sums = cut(observation.pattern, y.min(axis=0) - margin, y.max(axis=0) + margin, blur)
        # `Quadrature` has the two look-ups of an atlas
        terms.append(MatchedTerm(view.name, view.sensor, cast(Atlas, sums), 2 * sigma**2, 1.0, 1.0))
    return terms


@dataclass(frozen=True)
class _Guided:
    """Log-likelihood with a prior N(T_start, 1/information) of some strength."""

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


def descend(
    terms: Sequence[MatchedTerm], body: Body, T_start: Floats, uncertainty: Floats
) -> Floats:
    """Climb the likelihood from a start, under guidance where the data say little."""
    information = 1.0 / uncertainty**2
    T, strength = T_start, 0
    while True:
        likelihood = MatchedObjective(_weighed(terms, body, T), body)
        guided = _Guided(likelihood, T_start, FADING[strength] * information)
        ascent = ascend(guided.linearise, perturb, T, _ALL, _options(likelihood, T))
        away = twist_between(T_start, ascent.state)
        if strength > 0 and away @ (information * away) > FARTHEST:
            return T
        T = ascent.state
        if FADING[strength] == 0:
            return T
        scaled = likelihood.linearise(T).curvature * uncertainty * uncertainty[:, None]
        informative = np.linalg.eigvalsh(scaled)[0] > INFORMATIVE
        strength = len(FADING) - 1 if informative else strength + 1


def _options(likelihood: MatchedObjective, T: Floats) -> NewtonOptions:
    value = float(likelihood.value(T))
    return NewtonOptions(iterations=60, tolerance=max(1e-13, _NATS / max(value, _NATS)))


def _weighed(terms: Sequence[MatchedTerm], body: Body, T_world_object: Floats) -> list[MatchedTerm]:
    """Terms in units of log-likelihood: weight 1/(2 s²), s² the residual variance of a pixel."""
    weighed = []
    for term in terms:
        explained = float(MatchedObjective([term], body).value(T_world_object))
        variance = _pixel_variance(term, explained)
        weighed.append(replace(term, weight=0.5 / variance))
    return weighed


def _pixel_variance(term: MatchedTerm, explained: float) -> float:
    sums = _sums(term)
    energy = sums.energy
    left = max(energy - explained, 1e-14 * energy)
    return left / sums.values.size * sums.step ** len(sums.origin)


def _sums(term: MatchedTerm) -> Quadrature:
    return cast(Quadrature, term.matched)


def settle(terms: Sequence[MatchedTerm], body: Body, T_world_object: Floats) -> Fit:
    """Fit the pose to freed features where they show that the body does not fit the data."""
    places, statistic, freedom, share = [], 0.0, -6, 0.0
    for term in terms:
        y, _ = term.sensor.project(transform(T_world_object, body.nodes.points))
        bound = float(MatchedObjective([term], body).value(T_world_object))
        found, freed = locate(term, y, body.nodes.weights)
        places.append(found)
        gain = max(freed - bound, 0.0)
        statistic += gain / _pixel_variance(term, freed)
        freedom += y.size
        share = max(share, gain / _sums(term).energy)
    misfit = (statistic - freedom) / np.sqrt(2 * freedom)
    if share < NEGLIGIBLE or misfit < MISFIT:
        return Fit(T_world_object, float(misfit), False)
    return Fit(least_squares(terms, body, T_world_object, places), float(misfit), True)


def locate(term: MatchedTerm, y: Floats, weights: Floats) -> tuple[Floats, float]:
    """Places (n, m) where each feature by itself explains most, near (n, m), and ⟨g,h⟩²/⟨h,h⟩."""
    n, m = y.shape
    select = np.eye(n * m).reshape(n, m, n * m)

    def model(y: Floats) -> Quadratic:
        sampled = term.matched.sample(y).astype(np.float64)
        product = float(weights @ sampled[:, 0])
        by_place = (weights[:, None] * sampled[:, 1:]).ravel()
        overlap = overlap_terms(y, select, weights, term.variance)
        amplitude = product / overlap.norm
        half = overlap.half_gradient
        curvature = overlap.gram - np.outer(half, half) / overlap.norm
        return Quadratic(
            product * amplitude,
            2 * amplitude * (by_place - amplitude * half),
            2 * amplitude**2 * curvature,
        )

    ascent = ascend(
        model,
        lambda y, step: np.asarray(y + step.reshape(n, m)),
        y,
        np.ones(n * m, dtype=np.bool_),
        NewtonOptions(iterations=60, tolerance=1e-13),
    )
    return ascent.state, ascent.value


def least_squares(
    terms: Sequence[MatchedTerm], body: Body, T_world_object: Floats, places: Sequence[Floats]
) -> Floats:
    """The pose whose projections are nearest to given places (n, m) per sensor, in units of σ."""

    def model(T: Floats) -> Quadratic:
        value, gradient, curvature = 0.0, np.zeros(6), np.zeros((6, 6))
        for term, place in zip(terms, places, strict=True):
            y, by_world, _ = term.sensor.linearise(transform(T, body.nodes.points))
            J = pose_jacobian(by_world, T, body.nodes.points).reshape(-1, 6)
            off = (place - y).ravel()
            value -= float(off @ off) / term.variance
            gradient += 2 * off @ J / term.variance
            curvature += 2 * J.T @ J / term.variance
        return Quadratic(value, gradient, curvature)

    options = NewtonOptions(iterations=60, tolerance=1e-13)
    return ascend(model, perturb, T_world_object, _ALL, options).state
