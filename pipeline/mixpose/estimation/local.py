"""A pose near a start: annealed ascent of an objective."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from mixpose.body import Body
from mixpose.density import STEPS_PER_SIGMA
from mixpose.estimation.annealing import ladder
from mixpose.estimation.free_features import fit_freed
from mixpose.estimation.misfit import Sight, misfit
from mixpose.estimation.options import EstimatorOptions
from mixpose.estimation.prior import Prior, grid_likelihood, most_probable
from mixpose.objective import Gaze, View, build_objective, gazes_of, matched_objective
from mixpose.optimise import Ascent, NewtonOptions, ascend
from mixpose.records import GridPattern, PointPattern
from mixpose.rigid import TWIST_NAMES, perturb, transform

Floats: TypeAlias = NDArray[np.float64]

# bilinear values at n grid points per σ are up to 1/(8 n²) low along each of two axes, and squared
_VALUE_ERROR = 4.0 / (8 * STEPS_PER_SIGMA**2)
COARSE = NewtonOptions(iterations=10, tolerance=1e-3, value_error=_VALUE_ERROR)
_NEAR = 0.1  # value per sensor that says so: features have a third of their peak on average
# tiles have four times as many
FINE = NewtonOptions(iterations=40, tolerance=1e-8, value_error=_VALUE_ERROR / 16)

# between detections the Hessian is exact: after a step that gains 1e-6, 1e-5 σ are left to go
EXACT = NewtonOptions(iterations=40, tolerance=1e-6, value_error=1e-12)


@dataclass(frozen=True)
class Fit:
    """Where a descent through the blurs ended.

    Attributes
    ----------
    T_world_object : (4, 4) float64
    value : float
        Of the objective at the finest blur.
    converged : bool
    sigmas : tuple of float
        The finest blur per view.
    settled : bool
        Whether the body did not fit, and the pose was fitted to freed features.
    """

    T_world_object: Floats
    value: float
    converged: bool
    sigmas: tuple[float, ...]
    settled: bool = False


def fit_near(
    views: Sequence[View],
    body: Body,
    T_start: Floats,
    uncertainty: Floats,
    options: EstimatorOptions,
    samples: Floats,
    gazes: Sequence[Gaze] | None = None,
) -> Fit:
    """Descend from coarse blurs to σ_ε and climb the objective at each.

    Parameters
    ----------
    views : sequence of View
        At least one, none with an empty observation.
    body : Body
    T_start : (4, 4) array
    uncertainty : (6,) array
        Standard deviations of the start, lengths and radians.
    options : EstimatorOptions
    samples : (N, R, 3) array
        Samples of the body, for the objectives that integrate by sampling.
    gazes : sequence of Gaze or None
        Of the views' sensors at the body, where they are at hand.
    """
    free = free_mask(options)
    gazes = gazes_of([view.sensor for view in views], body) if gazes is None else gazes
    ascent = None
    if options.objective == "matched" and all_points(views):
        ascent = _straight(views, body, T_start, free, gazes)
    if ascent is None:
        ascent = _annealed(views, body, T_start, uncertainty, options, samples, gazes)
    T, settled = ascent.state, False
    if options.objective == "matched" and all_grids(views):
        prior = Prior(T_start, uncertainty, free)
        T, settled = _believed(views, body, T, prior)
    sigmas = tuple(view.observation.sigma for view in views)
    return Fit(T, ascent.value, ascent.converged, sigmas, settled)


def _straight(
    views: Sequence[View],
    body: Body,
    T_start: Floats,
    free: NDArray[np.bool_],
    gazes: Sequence[Gaze],
) -> Ascent[Floats] | None:
    """The ascent at σ_ε alone, where most features are near a detection at the start already."""
    sigmas = [view.observation.sigma for view in views]
    objective = matched_objective(views, body, sigmas, T_start, gazes=gazes)
    here = objective.linearise(T_start)
    if here.value < _NEAR * len(views):
        return None
    return ascend(objective.linearise, perturb, T_start, free, EXACT, here)


def _annealed(
    views: Sequence[View],
    body: Body,
    T_start: Floats,
    uncertainty: Floats,
    options: EstimatorOptions,
    samples: Floats,
    gazes: Sequence[Gaze],
) -> Ascent[Floats]:
    """The ascent at one blur after the other."""
    free = free_mask(options)
    levels = ladder(views, body, T_start, np.where(free, uncertainty, 0.0), gazes)
    sharp = options.objective == "matched" and all_points(views)
    ascent = Ascent(T_start, 0.0, False, 0)
    for k, sigmas in enumerate(levels):
        last = k == len(levels) - 1
        newton = (EXACT if sharp else FINE) if last else COARSE
        objective = build_objective(
            options.objective, views, body, samples, sigmas, ascent.state, last, gazes
        )
        ascent = ascend(objective.linearise, perturb, ascent.state, free, newton)
    return ascent


def _believed(views: Sequence[View], body: Body, T: Floats, prior: Prior) -> tuple[Floats, bool]:
    """The most probable pose, or the fit to freed features of a body that does not fit."""
    points = body.nodes.points
    T = most_probable(partial(grid_likelihood, views, body, 1.0), T, prior)
    likelihood = grid_likelihood(views, body, 1.0, T, True)
    gazes = gazes_of([view.sensor for view in views], body)
    all_seen = all(gaze.project(T).seen.all() for gaze in gazes)
    if likelihood is None or not all_seen or len(points) != len(body):
        return T, False
    extents = {view.name: view.observation.extent for view in views}
    here = [
        Sight(term.sensor, term.matched.sample, term.variance, noise, extents[term.name])
        for term, noise in zip(likelihood.objective.terms, likelihood.noise, strict=True)
    ]
    ratio = misfit(here, transform(T, points), int(prior.free.sum()))
    if ratio == 1:
        return T, False
    sigmas = [view.observation.sigma for view in views]
    everywhere = matched_objective(views, body, sigmas).terms
    whole = [
        replace(sight, density=term.matched.sample)
        for sight, term in zip(here, everywhere, strict=True)
    ]
    T_freed = fit_freed(whole, points, [T, *prior.points()], prior.free)
    if T_freed is not None:
        return T_freed, True
    # what is left at features is no noise of cells: in a body that does not fit it is as large
    return most_probable(partial(grid_likelihood, views, body, ratio), T, prior), False


def all_grids(views: Sequence[View]) -> bool:
    """Whether all sensors gave grey values or profiles, whose noise is that of their cells."""
    return all(isinstance(view.observation.pattern, GridPattern) for view in views)


def all_points(views: Sequence[View]) -> bool:
    """Whether all sensors gave detections."""
    return all(isinstance(view.observation.pattern, PointPattern) for view in views)


def free_mask(options: EstimatorOptions) -> NDArray[np.bool_]:
    """Which of the six directions are estimated."""
    return np.array([name in options.free for name in TWIST_NAMES])
