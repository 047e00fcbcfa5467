"""A pose near a start: ascent of an objective through narrowing blurs.

    draw C of every sensor at a blur → climb Σ_l ω_l S_l → narrow the blur → ... → σ_ε

Where most features are near a detection at the start already, σ_ε alone will do.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from mixpose.body import Body
from mixpose.constants import constant
from mixpose.fit.blur_schedule import ScheduleRules, blur_schedule
from mixpose.fit.misfit import MisfitRules
from mixpose.fit.misfitting_body import believed
from mixpose.fit.options import EstimatorOptions, free_mask
from mixpose.fit.prior import Prior, has_likelihood
from mixpose.objective import MatchedObjective, Objective, View, build_objective, matched_objective
from mixpose.objective.matched import FINE_STEPS, STEPS_PER_SIGMA, value_error
from mixpose.optimise import Ascent, NewtonOptions, ascend
from mixpose.rigid import perturb
from mixpose.sensors import Motion

Floats: TypeAlias = NDArray[np.float64]


COARSE = NewtonOptions(iterations=10, tolerance=1e-3, value_error=value_error(STEPS_PER_SIGMA))
# what gains 5e-7 is 1e-3 σ long; gains shrink faster near the end, and a hundredth of it is left
SHARP = NewtonOptions(
    iterations=40, tolerance=1e-6, value_error=value_error(STEPS_PER_SIGMA), remaining=5e-7
)
FINE = NewtonOptions(iterations=40, tolerance=1e-8, value_error=value_error(FINE_STEPS))


@dataclass(frozen=True)
class FitRules:
    """How a fit begins."""

    schedule: ScheduleRules = ScheduleRules()
    misfit: MisfitRules = MisfitRules()
    near: float = constant(
        0.1,
        "value per sensor from which the fit begins at σ_ε: features have a third of their peak "
        "on average; below, it descends through the blurs",
    )


@dataclass(frozen=True)
class Fit:
    """Where an ascent ended.

    Attributes
    ----------
    T_world_object : (4, 4) float64
    value : float
        Of the objective at that pose, at the finest blur.
    converged : bool
    iterations : int
        Evaluations at the finest blur.
    freed : bool
        Whether the body did not fit, and the pose was fitted to freed features.
    motion : Motion or None
        Of the body, where sensors see it at moments of their own.
    """

    T_world_object: Floats
    value: float
    converged: bool
    iterations: int
    freed: bool = False
    motion: Motion | None = None


def fit_near(
    views: Sequence[View],
    body: Body,
    T_start: Floats,
    uncertainty: Floats,
    options: EstimatorOptions,
    samples: Floats,
    *,
    finest: MatchedObjective | None = None,
    rules: FitRules = FitRules(),
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
    finest : MatchedObjective or None
        At σ_ε, where it is at hand.
    rules : FitRules
    """
    free = free_mask(options)
    matched = options.objective == "matched"
    ascent = None
    if matched:
        finest = finest or matched_objective(views, body, [v.observation.sigma for v in views])
    if finest and not has_likelihood(views):
        here = finest.linearise(T_start)
        if here.value >= rules.near * len(views):
            ascent = ascend(finest.linearise, perturb, T_start, free, SHARP, here)
    if ascent is None:
        ascent = _through_blurs(views, body, T_start, uncertainty, options, samples, finest, rules)
    T, is_freed = ascent.state, False
    if finest and has_likelihood(views):
        T, is_freed = believed(finest, T, Prior(T_start, uncertainty, free), rules.misfit)
    return Fit(T, ascent.value, ascent.converged, ascent.iterations, freed=is_freed)


def _through_blurs(
    views: Sequence[View],
    body: Body,
    T_start: Floats,
    uncertainty: Floats,
    options: EstimatorOptions,
    samples: Floats,
    finest: MatchedObjective | None,
    rules: FitRules,
) -> Ascent[Floats]:
    """The ascent at one blur after the other."""
    free = free_mask(options)
    spread = np.where(free, uncertainty, 0.0)
    fine = has_likelihood(views) or options.objective != "matched"
    ascent = Ascent(T_start, 0.0, False, 0)
    schedule = blur_schedule(views, body, T_start, spread, rules.schedule)
    for k, sigmas in enumerate(schedule):
        last = k == len(schedule) - 1
        newton = (FINE if fine else SHARP) if last else COARSE
        objective: Objective | None = finest if last else None
        if objective is None:
            name, near = options.objective, ascent.state
            objective = build_objective(name, views, body, samples, sigmas, near)
        ascent = ascend(objective.linearise, perturb, ascent.state, free, newton)
    return ascent
