"""A pose near a start: ascent of an objective through narrowing blurs.

    draw C of every sensor at a blur → climb Σ_l ω_l S_l → narrow the blur → ... → σ_ε → ... → noise

Where most features are near a detection at the start already, it begins at σ_ε.  Where all of them
are met as closely as the detections' noise lets them, σ_ε is the end: narrower blurs would find the
same pose.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from mixpose.body import Body
from mixpose.constants import constant
from mixpose.fit.blur_schedule import ScheduleRules, blur_schedule
from mixpose.fit.misfit import MisfitRules
from mixpose.fit.options import EstimatorOptions, free_mask
from mixpose.fit.prior import believed, has_likelihood
from mixpose.matching import (
    AssociationRules,
    ErrorRules,
    Matches,
    NoiseEstimate,
    associate,
    errors_seen,
    log_likelihood,
)
from mixpose.objective import (
    MatchedObjective,
    NormalPrior,
    View,
    build_objective,
    matched_objective,
    together,
)
from mixpose.objective.matched import FINE_STEPS, STEPS_PER_SIGMA, value_error
from mixpose.optimise import Ascent, NewtonOptions, ascend
from mixpose.records import Floats
from mixpose.rigid import perturb, twist_between
from mixpose.sensors import Motion

Blurs: TypeAlias = list[float]

COARSE = NewtonOptions(iterations=10, tolerance=1e-3, value_error=value_error(STEPS_PER_SIGMA))
# what gains 5e-7 is 1e-3 σ long; gains shrink faster near the end, and a hundredth of it is left
SHARP = NewtonOptions(
    iterations=40, tolerance=1e-6, value_error=value_error(STEPS_PER_SIGMA), remaining=5e-7
)
FINE = NewtonOptions(iterations=40, tolerance=1e-8, value_error=value_error(FINE_STEPS))
_STEPS = 2  # of least squares: 0.80 of the way, of 70 features 0.89; after one 0.62 and 0.77


@dataclass(frozen=True)
class FitRules:
    """How a fit begins."""

    schedule: ScheduleRules = ScheduleRules()
    misfit: MisfitRules = MisfitRules()
    narrower: float = constant(0.8, "of a blur: the next is drawn where it is narrower by as much")
    moved: float = constant(
        0.5,
        "standard deviations by which narrower blurs have to move the pose: where all offsets are "
        "normal they do so, too, as they are 5 % less efficient in six directions",
    )
    near: float = constant(
        0.1,
        "value per sensor from which the fit begins at σ_ε: features have a third of their peak "
        "on average; below, it descends through the blurs",
    )
    same: float = constant(
        1e-5, "share of the value by which ascents that ended at one place differ: 0.003 σ_ε"
    )


@dataclass(frozen=True)
class Fit:
    """Where an ascent ended."""

    T_world_object: Floats  # (4, 4)
    value: float  # of the objective at that pose, at the finest blur
    converged: bool
    iterations: int  # evaluations at the finest blur
    freed: bool = False  # whether the body did not fit, and the pose was fitted to freed features
    motion: Motion | None = None  # of the body, where sensors see it at moments of their own
    matches: Matches | None = None  # at the pose, at σ_ε, where detections were looked at
    noise: NoiseEstimate | None = None  # as these show it
    blurs: tuple[Mapping[str, float], ...] = ()  # by view, of each objective that was climbed

    @classmethod
    def of(cls, ascent: Ascent, views: Sequence[View], levels: Sequence[Blurs]) -> Fit:
        """Where an ascent through blurs of the views ended."""
        blurs = tuple(dict(zip([view.name for view in views], one)) for one in levels)
        value, converged, iterations = ascent.values[0], ascent.converged[0], ascent.iterations[0]
        end = ascent.states[0], float(value), bool(converged), int(iterations)
        return cls(*end, blurs=blurs)


@dataclass(frozen=True)
class Climbed:
    """A fit, and the ascent at σ_ε that it went on from."""

    ascent: Ascent
    fit: Fit

    def begins_at(self, other: Ascent, rules: FitRules) -> bool:
        """Whether another ascent ended at the same place, so that it leads to the same fit."""
        away = twist_between(self.ascent.states[0], other.states[0])
        value = abs(float(other.values[0]))
        return float(away @ other.last.curvature[0] @ away) < rules.same * value


def fit_near(
    views: Sequence[View],
    body: Body,
    T_start: Floats,
    uncertainty: Floats,
    options: EstimatorOptions,
    samples: Floats,
    *,
    finest: MatchedObjective | None = None,
    begun: Ascent | None = None,
    climbed: list[Climbed] | None = None,
    blur: float = 1.0,
    noise: Floats | None = None,
    beside: float = 0.0,
    errors: ErrorRules = ErrorRules(),
    association: AssociationRules = AssociationRules(),
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
    begun : Ascent or None
        From the start, on that, where it is at hand.
    climbed : list of Climbed or None
        Fits to the same views and with the same noise; this one is added.  Where its ascent ends
        at σ_ε where one of theirs did, theirs is returned, the very same.
    blur : float
        In σ_ε, where the start is as close as that: what is coarser is left out.
    noise : (2, L) array or None
        Squares in σ_ε² and degrees of freedom of each view's noise so far; None: nothing.
    beside : float
        Standard deviation of what else features are off by, in σ_ε.
    errors : ErrorRules
    association : AssociationRules
    rules : FitRules
    """
    free = free_mask(options)
    levels: list[Blurs] = []  # blurs by view of each objective that is climbed
    start = views, body, T_start, uncertainty, options, samples, rules, levels
    descend = partial(_through_blurs, *start)
    sigmas = [blur * view.observation.sigma for view in views]
    if options.objective != "matched":
        return Fit.of(descend(None, FINE), views, [*levels, sigmas])
    at_blur = [view.observation.sigma for view in views]
    finest = finest or matched_objective(views, body, at_blur)
    first = finest if blur == 1 else matched_objective(views, body, sigmas)
    if has_likelihood(views):
        ascent = descend(finest, FINE)
        prior = NormalPrior(T_start, uncertainty, free)
        T, is_freed = believed(finest, ascent.states[0], prior, rules.misfit)
        return replace(Fit.of(ascent, views, [*levels, sigmas]), T_world_object=T, freed=is_freed)
    ascent = begun or _at_once(first, T_start, free, blur, rules) or descend(first, SHARP)
    climbed = climbed if climbed is not None and blur == 1 else []
    if known_fit := next((one.fit for one in climbed if one.begins_at(ascent, rules)), None):
        return known_fit
    known = np.zeros((2, len(views))) if noise is None else noise
    rest = known, beside, errors, association, rules, [*levels, sigmas], blur
    fit = _to_the_noise(ascent, finest, free, *rest)
    climbed.append(Climbed(ascent, fit))
    return fit


def fit_together(
    objectives: Sequence[MatchedObjective],
    starts: Sequence[Floats],
    free: NDArray[np.bool_],
    rules: FitRules = FitRules(),
) -> list[tuple[MatchedObjective, Ascent] | None]:
    """Climb the objectives of several bodies at σ_ε at once, as `fit_near` begins.

    Parameters
    ----------
    objectives : sequence of MatchedObjective
        On the same densities.
    starts : sequence of (4, 4) array
    free : (6,) bool
    rules : FitRules

    Returns
    -------
    list of (MatchedObjective, Ascent) or None
        With what is seen where the ascent ends; None for a body that has to descend through the
        blurs.
    """
    joint, states = together(objectives), np.array(starts)
    here = joint.linearise(states)
    options = replace(SHARP, together=True)
    ends = ascend(joint, states, perturb, free, options, here)
    found: list[tuple[MatchedObjective, Ascent] | None] = []
    for k, seen in enumerate(joint.seen(objectives, ends.states)):
        own = ends.of(slice(k, k + 1))
        is_near = here.value[k] >= rules.near * len(seen.views)
        found.append((seen, own) if is_near else None)
    return found


def _at_once(
    objective: MatchedObjective,
    T_start: Floats,
    free: NDArray[np.bool_],
    blur: float,
    rules: FitRules,
) -> Ascent | None:
    """The ascent from a start where most features are near a detection, or said to be."""
    here = objective.linearise(T_start[None])
    if blur == 1 and here.value[0] < rules.near * len(objective.views):
        return None
    return ascend(objective, T_start[None], perturb, free, SHARP, here)


def _through_blurs(
    views: Sequence[View],
    body: Body,
    T_start: Floats,
    uncertainty: Floats,
    options: EstimatorOptions,
    samples: Floats,
    rules: FitRules,
    levels: list[Blurs],
    finest: MatchedObjective | None,
    last: NewtonOptions,
) -> Ascent:
    """The ascent at one blur after the other, with options of the last one."""
    free = free_mask(options)
    spread = np.where(free, uncertainty, 0.0)
    *wider, narrowest = blur_schedule(views, body, T_start, spread, rules.schedule)
    build = partial(build_objective, options.objective, views, body, samples)
    states = T_start[None]
    levels += wider
    for sigmas in wider:
        states = ascend(build(sigmas, states[0]), states, perturb, free, COARSE).states
    return ascend(finest or build(narrowest, states[0]), states, perturb, free, last)


def _to_the_noise(
    ascent: Ascent,
    finest: MatchedObjective,
    free: NDArray[np.bool_],
    known: Floats,
    beside: float,
    errors: ErrorRules,
    association: AssociationRules,
    rules: FitRules,
    levels: list[Blurs],
    blur: float,
) -> Fit:
    """The ascent from a blur in σ_ε on, while offsets that are no noise move the pose."""
    sigmas = np.array([view.observation.sigma for view in finest.views])
    blurs, count = np.full(len(sigmas), blur), int(free.sum())
    likeliest, best = -np.inf, None
    while True:
        matches = associate(finest, ascent.states[0], association, errors.narrowest)
        fit, wide = replace(Fit.of(ascent, finest.views, levels), matches=matches), matches
        if beside:
            least = np.minimum(np.maximum(errors.blur * beside, matches.finest), 1.0)
            wide = replace(matches, finest=least)
        noise = errors_seen(wide, count, known, errors)
        if not beside:
            fit = replace(fit, noise=noise)
        # offsets of a bent pose hide how small the noise is
        variances = np.minimum(noise.variances, (noise.before / errors.blur) ** 2)
        end = np.minimum(np.minimum(noise.blurs, noise.before), blurs)
        narrower = np.maximum(end, blurs / rules.schedule.ratio)
        is_noise = not (matches.squared > errors.outlying**2 * variances[:, None]).any()
        is_end = is_noise or bool((narrower > rules.narrower * blurs).all())
        if best is None and is_end:
            return fit
        # blurs that shrink unlike each other make sensors weigh otherwise than by their σ_ε
        alike = (end / blurs).min() > rules.narrower * (end / blurs).max()
        moved = _moved(matches, free, end, variances) if best is None and alike else np.inf
        if moved < rules.moved**2:
            return fit
        likelihood = log_likelihood(noise.blurs, matches, count, errors)
        if best is None or likelihood > likeliest:
            likeliest, best = likelihood, fit
        if is_end:
            return best
        blurs = narrower
        levels.append((blurs * sigmas).tolist())
        objective = _narrowed(finest, matches, levels[-1], errors.reach)
        ascent = ascend(objective, ascent.states, perturb, free, SHARP)


def _narrowed(
    finest: MatchedObjective, matches: Matches, sigmas: Sequence[float], reach: float
) -> MatchedObjective:
    """At narrower blurs, of what was detected around the features: a fine grid holds no more."""
    near = []
    for k, view in enumerate(finest.views):
        places = matches.places[k, matches.weights[k] > 0, : matches.dimensions[k]]
        near.append(replace(view, observation=view.observation.around(places, reach)))
    return matched_objective(near, finest.projection.body, sigmas)


def _moved(matches: Matches, free: NDArray[np.bool_], narrower: Floats, variances: Floats) -> float:
    """About how far narrower blurs (L,) move the pose, in squared standard deviations.


    By iterated least squares, at the end of an ascent at wider ones.
    """
    J = matches.J[..., free].reshape(matches.offsets.size, -1)
    offsets, twist = matches.offsets, np.zeros(J.shape[1])
    for _ in range(_STEPS):
        squared = (offsets * offsets).sum(axis=2)
        weights = matches.shares * np.exp(-0.25 * squared / narrower[:, None] ** 2)
        rows = (weights / variances[:, None]).repeat(2)[:, None] * J
        information = rows.T @ J
        twist += np.linalg.lstsq(information, rows.T @ offsets.ravel())[0]
        offsets = matches.offsets - (J @ twist).reshape(offsets.shape)
    return float(twist @ information @ twist)
