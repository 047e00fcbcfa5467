"""A pose near a start: ascent of an objective through narrowing blurs.

    draw C of every sensor at a blur → climb Σ_l ω_l S_l → narrow the blur → ... → σ_ε → ... → noise

Where most features are near a detection at the start already, it begins at σ_ε.  Where all of them
are met as closely as the detections' noise lets them, σ_ε is the end: narrower blurs would find the
same pose.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from mixpose.body import Body
from mixpose.constants import constant
from mixpose.density import ErrorRules, Noise, Offsets, errors_seen, known_blurs
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
    narrower: float = constant(0.8, "of a blur: the next is drawn where it is narrower by as much")
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
    noise: Sequence[Noise] | None = None,
    least: Floats | None = None,
    errors: ErrorRules = ErrorRules(),
    rules: FitRules = FitRules(),
) -> Fit:
    """Descend from coarse blurs to the detections' noise and climb the objective at each.

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
    noise : sequence of Noise or None
        What is known of each view's noise, in σ_ε; None: nothing.
    least : (L,) array or None
        Standard deviation of what else features of each view are off by, in σ_ε.
    errors : ErrorRules
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
    if matched and any(view.observation.cell is None for view in views):
        known = noise or [Noise()] * len(views)
        beside = np.zeros(len(views)) if least is None else least
        ascent = _to_the_noise(views, body, ascent, free, finest, known, beside, errors, rules)
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


def _to_the_noise(
    views: Sequence[View],
    body: Body,
    ascent: Ascent[Floats],
    free: NDArray[np.bool_],
    finest: MatchedObjective | None,
    noise: Sequence[Noise],
    beside: Floats,
    errors: ErrorRules,
    rules: FitRules,
) -> Ascent[Floats]:
    """The ascent from σ_ε on, while detections are farther off than their noise lets them be."""
    known = np.array([(one.squares, one.degrees) for one in noise]).T
    sigmas = np.array([view.observation.sigma for view in views])
    blurs, best = np.ones(len(views)), None
    objective = finest or matched_objective(views, body, sigmas.tolist())
    while True:
        offsets = _offsets(objective, ascent.state, errors)
        finest_blurs = np.clip(errors.blur * beside, offsets.finest, 1.0)
        offsets = offsets._replace(finest=finest_blurs)
        seen = errors_seen(offsets, int(free.sum()), known, errors)
        if best is None or seen.log_likelihood > best[0]:
            best = (seen.log_likelihood, ascent)
        # offsets of a bent pose hide how small the noise is
        least = known_blurs(offsets.finest, known, errors)
        noise_seen = np.minimum(seen.variances, (least / errors.blur) ** 2)
        limits = errors.outlying**2 * noise_seen[offsets.sensor]
        clear = (offsets.squared <= limits) | (offsets.shares == 0)
        least = np.maximum(least, blurs / rules.schedule.ratio)
        narrower = np.minimum(np.minimum(seen.blurs, least), blurs)
        if clear.all() or (narrower > rules.narrower * blurs).all():
            return best[1]
        blurs = narrower
        near = _around_the_body(objective, ascent.state, errors.reach)
        objective = matched_objective(near, body, (blurs * sigmas).tolist())
        ascent = ascend(objective.linearise, perturb, ascent.state, free, SHARP)


def _offsets(objective: MatchedObjective, T: Floats, errors: ErrorRules) -> Offsets:
    """How far off features are met, as the density around them shows it: v ∇C / C."""
    at, sampled, _ = objective.match(T[None])
    sensor, feature = np.nonzero(at.seen[:, 0] & (sampled[:, 0, :, 0] > 0))
    C, slope = sampled[sensor, 0, feature, 0], sampled[sensor, 0, feature, 1:]
    sigmas = np.array([view.observation.sigma for view in objective.views])
    away = slope * (objective.variances[sensor, 0] / C / sigmas[sensor])[:, None]
    squared = (away * away).sum(axis=1)
    shares = np.where(squared < errors.met**2, at.weights[sensor, 0, feature], 0.0)
    dimensions = objective.projection.dimensions
    finest = [
        view.observation.narrowest(errors.narrowest, y[0, seen[0], :m])
        for view, y, seen, m in zip(objective.views, at.y, at.seen, dimensions, strict=True)
    ]
    return Offsets(squared, shares, sensor, dimensions, np.array(finest))


def _around_the_body(objective: MatchedObjective, T: Floats, reach: float) -> list[View]:
    """Views with what was detected around the features alone: a fine grid has to hold no more."""
    at = objective.projection.project(T[None])
    return [
        replace(view, observation=view.observation.around(y[0, seen[0], :m], reach))
        for view, y, seen, m in zip(
            objective.views, at.y, at.seen, objective.projection.dimensions, strict=True
        )
    ]
