"""The last step where the body does not fit its observation: least squares of freed features.

The matched objective is least squares between densities.  Where the body is deformed by more than
a part of σ, features that lie further from their prediction than σ pull less than near ones, and
the pose is that of the features that fit.  Known correspondences would give all the same pull.  So
do the features once each is freed from the body and has moved to where it explains most: the pose
is then fitted to these places.

This is done only where freed features explain far more of the densities than noise would let them,
where each of them has a place to go to, and where these are so far apart that each is known by
itself: then no correspondence is in doubt.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from mixpose.body import Body
from mixpose.density import peak
from mixpose.estimation.guidance import cell_variance
from mixpose.estimation.meeting import LEAST_SHARE
from mixpose.objective import Quadratic, View, matched_objective, pose_jacobian
from mixpose.objective.overlaps import overlap_terms
from mixpose.objective.stack import MatchedTerm
from mixpose.optimise import NewtonOptions, ascend
from mixpose.rigid import perturb, transform

Floats: TypeAlias = NDArray[np.float64]

MISFIT = 10.0
"""Standard deviations of χ² by which freed features must explain more than noise would."""

NEGLIGIBLE = 1e-5
"""Share of the energy below which a misfit is rounding of densities."""

_REACH = 4.0  # standard deviations of the matched density that freed features can see
_FARTHEST = 5.5  # σ that a freed feature may have moved
_PULL_FADES = 0.7  # σ: nearer features pull as in least squares anyway
_APART = 0.3  # of the information that a feature without neighbours has about its place
_OPTIONS = NewtonOptions(iterations=60, tolerance=1e-11, value_error=2e-3)


@dataclass(frozen=True)
class Freed:
    """The features of one sensor, each where it explains most.

    Attributes
    ----------
    places : (n, m) float64
    bound, explained : float
        ⟨g, h⟩² / ⟨h, h⟩ of the features on the body, and freed.
    all_met : bool
        Whether every feature has found something of its own.
    """

    places: Floats
    bound: float
    explained: float
    all_met: bool


def settle(
    views: Sequence[View], body: Body, T_world_object: Floats, free: NDArray[np.bool_]
) -> Floats:
    """Fit the pose to freed features where they show that the body does not fit the data.

    Parameters
    ----------
    views : sequence of View
        All with grid patterns.
    body : Body
    T_world_object : (4, 4) array
        The maximum of the matched objective.
    free : (6,) bool

    Returns
    -------
    (4, 4) array
        The same pose where the body fits, or where a feature is missing.
    """
    sigmas = [view.observation.sigma for view in views]
    terms = matched_objective(views, body, sigmas, T_world_object, fine=True, reach=_REACH).terms
    if len(terms) != len(views):
        return T_world_object
    freed, statistic, freedom, share, farthest = [], 0.0, -int(free.sum()), 0.0, 0.0
    for term, view in zip(terms, views, strict=True):
        y, seen = term.sensor.project(transform(T_world_object, body.nodes.points))
        one = free_features(term, y, body.nodes.weights)
        moved = np.linalg.norm(one.places - y, axis=1) / view.observation.sigma
        if not seen.all() or moved.max() > _FARTHEST or one.explained <= 0:
            return T_world_object
        gain = max(one.explained - one.bound, 0.0)
        statistic += gain / cell_variance(term, view.observation, one.explained)
        freedom += y.size
        share = max(share, gain / term.energy)
        farthest = max(farthest, float(moved.max()))
        freed.append(one)
    misfit = (statistic - freedom) / np.sqrt(2 * max(freedom, 1))
    if share < NEGLIGIBLE or misfit < MISFIT or farthest < _PULL_FADES:
        return T_world_object
    return least_squares(terms, body, T_world_object, [one.places for one in freed], free)


def free_features(term: MatchedTerm, y: Floats, weights: Floats) -> Freed:
    """Let every feature (n, m) move by itself to where all explain most together."""
    n, m = y.shape
    select = np.eye(n * m).reshape(n, m, n * m)
    begun: list[float] = []

    def model(y: Floats) -> Quadratic:
        sampled = term.matched.sample(y).astype(np.float64)
        product = float(weights @ sampled[:, 0])
        overlap = overlap_terms(y, select, weights, term.variance)
        amplitude, half = product / overlap.norm, overlap.half_gradient
        by_place = (weights[:, None] * sampled[:, 1:]).ravel()
        begun.append(product * amplitude)
        return Quadratic(
            product * amplitude,
            2 * amplitude * (by_place - amplitude * half),
            2 * amplitude**2 * (overlap.gram - np.outer(half, half) / overlap.norm),
        )

    def move(y: Floats, step: Floats) -> Floats:
        return np.asarray(y + step.reshape(n, m))

    ascent = ascend(model, move, y, np.ones(n * m, dtype=np.bool_), _OPTIONS)
    here = term.matched.sample(ascent.state)[:, 0]
    all_met = bool(here.min() > LEAST_SHARE * np.median(here) > 0)
    overlap = overlap_terms(ascent.state, select, weights, term.variance)
    alone = np.repeat(weights**2, m) * peak(term.variance, m) / term.variance
    scale = 1 / np.sqrt(alone)
    apart = float(np.linalg.eigvalsh(overlap.gram * scale * scale[:, None])[0])
    return Freed(ascent.state, begun[0], ascent.value, all_met and apart > _APART)


def least_squares(
    terms: Sequence[MatchedTerm],
    body: Body,
    T_world_object: Floats,
    places: Sequence[Floats],
    free: NDArray[np.bool_],
) -> Floats:
    """The pose whose projections are nearest to given places (n, m) per sensor, in units of σ."""
    points = body.nodes.points

    def model(T: Floats) -> Quadratic:
        value, gradient, curvature = 0.0, np.zeros(6), np.zeros((6, 6))
        for term, place in zip(terms, places, strict=True):
            y, by_world, _ = term.sensor.linearise(transform(T, points))
            J = pose_jacobian(by_world, T, points).reshape(-1, 6)
            off = (place - y).ravel()
            value -= float(off @ off) / term.variance
            gradient += 2 * off @ J / term.variance
            curvature += 2 * J.T @ J / term.variance
        return Quadratic(value, gradient, curvature)

    options = NewtonOptions(iterations=60, tolerance=1e-13)
    return ascend(model, perturb, T_world_object, free, options).state
