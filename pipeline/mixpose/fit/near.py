"""A pose near a start: ascent of an objective through narrowing blurs.

    draw C of every sensor at a blur → climb Σ_l ω_l S_l → narrow the blur → ... → σ_ε → ... → noise

Where most features are near a detection at the start already, it begins at σ_ε.  Where all of them
are met as closely as the detections' noise lets them, σ_ε is the end: narrower blurs would find the
same pose.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from mixpose.body import Body
from mixpose.constants import constant
from mixpose.density import ErrorRules, Noise, Offsets, errors_seen, log_likelihood, sums_of
from mixpose.fit.blur_schedule import ScheduleRules, blur_schedule
from mixpose.fit.misfit import MisfitRules
from mixpose.fit.options import EstimatorOptions, free_mask
from mixpose.fit.prior import believed, has_likelihood
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
from mixpose.rigid import perturb, twist_between
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

    @classmethod
    def of(cls, ascent: Ascent) -> Fit:
        """Where an ascent ended."""
        value, converged, iterations = ascent.values[0], ascent.converged[0], ascent.iterations[0]
        return cls(ascent.states[0], float(value), bool(converged), int(iterations))


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
    noise: Sequence[Noise] | None = None,
    beside: float = 0.0,
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
    begun : Ascent or None
        From the start, on that, where it is at hand.
    climbed : list of Climbed or None
        Fits to the same views and with the same noise; this one is added.  Where its ascent ends
        at σ_ε where one of theirs did, theirs is returned, the very same.
    blur : float
        In σ_ε, where the start is as close as that: what is coarser is left out.
    noise : sequence of Noise or None
        What is known of each view's noise, in σ_ε; None: nothing.
    beside : float
        Standard deviation of what else features are off by, in σ_ε.
    errors : ErrorRules
    rules : FitRules
    """
    free = free_mask(options)
    descend = partial(_through_blurs, views, body, T_start, uncertainty, options, samples, rules)
    if options.objective != "matched":
        return Fit.of(descend(None, FINE))
    if finest is None or blur != 1:
        sigmas = [blur * view.observation.sigma for view in views]
        finest = matched_objective(views, body, sigmas)
    if has_likelihood(views):
        ascent = descend(finest, FINE)
        prior = NormalPrior(T_start, uncertainty, free)
        T, is_freed = believed(finest, ascent.states[0], prior, rules.misfit)
        return replace(Fit.of(ascent), T_world_object=T, freed=is_freed)
    ascent = begun or _at_once(finest, T_start, free, blur, rules) or descend(finest, SHARP)
    climbed = climbed if climbed is not None and blur == 1 else []
    for one in climbed:
        if one.begins_at(ascent, rules):
            return one.fit
    known = noise or [Noise()] * len(views)
    fit = Fit.of(_to_the_noise(ascent, finest, free, known, beside, errors, rules, blur))
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
        assert seen.at_hand is not None
        last = own.last._replace(source=seen.at_hand[1])
        own = own._replace(last=last, steps=np.zeros((1, 6)))
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
    finest: MatchedObjective | None,
    last: NewtonOptions,
) -> Ascent:
    """The ascent at one blur after the other, with options of the last one."""
    free = free_mask(options)
    spread = np.where(free, uncertainty, 0.0)
    *wider, narrowest = blur_schedule(views, body, T_start, spread, rules.schedule)
    build = partial(build_objective, options.objective, views, body, samples)
    states = T_start[None]
    for sigmas in wider:
        states = ascend(build(sigmas, states[0]), states, perturb, free, COARSE).states
    return ascend(finest or build(narrowest, states[0]), states, perturb, free, last)


def _to_the_noise(
    ascent: Ascent,
    objective: MatchedObjective,
    free: NDArray[np.bool_],
    noise: Sequence[Noise],
    beside: float,
    errors: ErrorRules,
    rules: FitRules,
    blur: float = 1.0,
) -> Ascent:
    """The ascent from a blur in σ_ε on, while offsets that are no noise move the pose."""
    known = sums_of(noise)
    sigmas = np.array([view.observation.sigma for view in objective.views])
    blurs, count = np.full(len(sigmas), blur), int(free.sum())
    likeliest, best = -np.inf, ascent
    while True:
        met = _met(objective, ascent, sigmas, beside, errors)
        seen = errors_seen(met.offsets, count, known, errors)
        # offsets of a bent pose hide how small the noise is
        variances = np.minimum(seen.variances, (seen.before / errors.blur) ** 2)
        end = np.minimum(np.minimum(seen.blurs, seen.before), blurs)
        narrower = np.maximum(end, blurs / rules.schedule.ratio)
        is_end = met.is_noise(variances, errors) or bool((narrower > rules.narrower * blurs).all())
        if best is ascent and is_end:
            return ascent
        # blurs that shrink unlike each other make sensors weigh otherwise than by their σ_ε
        alike = (end / blurs).min() > rules.narrower * (end / blurs).max()
        if best is ascent and alike and met.moved(free, blurs, end, variances) < rules.moved**2:
            return ascent
        likelihood = log_likelihood(seen.blurs, met.offsets, count, errors)
        if likelihood > likeliest:
            likeliest, best = likelihood, ascent
        if is_end:
            return best
        blurs = narrower
        # a fine grid has to hold no more than what was detected around the features
        near = [
            replace(view, observation=view.observation.around(places, errors.reach))
            for view, places in zip(objective.views, met.places, strict=True)
        ]
        objective = matched_objective(near, objective.projection.body, (blurs * sigmas).tolist())
        ascent = ascend(objective, ascent.states, perturb, free, SHARP)


class _Met(NamedTuple):
    """Where the features are met in each sensor; without share where they are not."""

    offsets: Offsets
    away: Floats  # (L, n, 2) the offsets themselves, in σ_ε
    J: Floats  # (L, n, 2, 6) of the features by the pose, in σ_ε
    places: list[Floats]  # (k, m) of all features that a sensor sees, in its units

    def is_noise(self, variances: Floats, errors: ErrorRules) -> bool:
        """Whether no offset is larger than noise of variances (L,) lets it be."""
        limits = errors.outlying**2 * variances[:, None]
        return not self.offsets.shares[self.offsets.squared > limits].any()

    def moved(
        self, free: NDArray[np.bool_], blurs: Floats, narrower: Floats, variances: Floats
    ) -> float:
        """About how far narrower blurs (L,) move the pose, in squared standard deviations."""
        squared, weights = self.offsets.squared, self.offsets.shares / variances[:, None]
        now, then = (np.exp(-0.25 * squared / one[:, None] ** 2) for one in (blurs, narrower))
        J = self.J[..., free].reshape(self.away.size, -1)
        gradient = (weights * (then - now)).repeat(2) * self.away.ravel() @ J
        rows = (weights * then).repeat(2)[:, None] * J
        return float(gradient @ np.linalg.lstsq(rows.T @ J, gradient)[0])


def _met(
    objective: MatchedObjective,
    ascent: Ascent,
    sigmas: Floats,
    beside: float,
    errors: ErrorRules,
) -> _Met:
    """How far off features are met, as the density around them shows it: v ∇C / C.

    What was looked up is where the last step began; the step is taken off.
    """
    at, sampled, _ = ascent.last.source
    seen, C, y = at.seen[:, 0], sampled[:, 0, :, 0], at.y[:, 0]
    J = at.J[:, 0] / sigmas[:, None, None, None]
    is_near = C > 0
    scale = objective.variances / (np.where(is_near, C, 1.0) * sigmas[:, None])
    away = sampled[:, 0, :, 1:] * scale[..., None]
    away -= J @ ascent.steps[0]
    squared = (away * away).sum(axis=2)
    is_near &= squared < errors.met**2
    shares = at.weights[:, 0] * is_near
    dimensions = objective.projection.dimensions
    places = [one[of, :m] for one, of, m in zip(y, seen, dimensions.tolist(), strict=True)]
    finest = [
        view.observation.narrowest(errors.narrowest, one)
        for view, one in zip(objective.views, places, strict=True)
    ]
    least = np.minimum(np.maximum(errors.blur * beside, finest), 1.0)
    return _Met(Offsets(squared, shares, dimensions, least), away, J, places)
