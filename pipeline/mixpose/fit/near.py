"""Fit a pose near a start: climb an objective through narrowing blurs.

    draw C of every sensor at a blur → climb Σ_l ω_l S_l → narrow the blur → ... → σ_ε → ... → noise

Observation and prediction are widened alike: no blur moves the optimum, wider ones only reach
farther.  If most features are near a detection at the start already, the fit begins at σ_ε; if all
are met as closely as the noise of detections allows, it ends there.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Literal, TypeAlias

import numpy as np

from mixpose.body import Body
from mixpose.fit.probable import FitRules, believed
from mixpose.matching import (
    AssociationRules,
    ErrorRules,
    Matches,
    NoiseEstimate,
    associate,
    errors_seen,
    log_likelihood,
    welsch,
)
from mixpose.objective import (
    MatchedObjective,
    NormalPrior,
    ObjectiveName,
    PaperObjective,
    View,
    build_objective,
    matched_objective,
    project_body,
    together,
    with_heights,
)
from mixpose.optimise import Ascent, NewtonOptions, ascend
from mixpose.records import Floats, Mask, replace
from mixpose.rigid import TWIST_NAMES, perturb, twist_between
from mixpose.sensors import Motion

SearchName: TypeAlias = Literal["thorough", "live"]


@dataclass(frozen=True)
class EstimatorOptions:
    """The keys of ``[estimator]`` in a session file."""

    objective: ObjectiveName = "matched"
    free: tuple[str, ...] = TWIST_NAMES  # world directions that are estimated
    samples: int = 1000  # R per feature, where q is integrated by sampling
    seed: int = 0
    fuse: bool = True  # whether the previous pose is a prior in frames of single ranges
    # how long to search if no prediction is convincing; None: live for cameras and streams
    search: SearchName | None = None
    confidence: float | None = None  # from which a pose is ok; None: that of the rules
    mirrors: bool = False  # whether mirrors may show the body


def free_mask(options: EstimatorOptions) -> Mask:
    """Return a mask of the directions (6,) that are estimated; shared and read-only."""
    return _mask(tuple(options.free))


@lru_cache(maxsize=64)
def _mask(free: tuple[str, ...]) -> Mask:
    mask = np.array([name in free for name in TWIST_NAMES])
    mask.flags.writeable = False
    return mask


@dataclass(frozen=True)
class Fit:
    """The end of an ascent."""

    T_world_object: Floats  # (4, 4)
    blurs: tuple[Mapping[str, float], ...] = ()  # by view, of all objectives that were climbed
    freed: bool = False  # whether the body did not fit, and the pose was fitted to freed features
    motion: Motion | None = None  # of the body, if sensors see it at different moments
    matches: Matches | None = None  # at the pose, at σ_ε, if detections were matched
    noise: NoiseEstimate | None = None  # by these matches
    first: Ascent | None = None  # at σ_ε, before narrower blurs

    @classmethod
    def of(
        cls, ascent: Ascent, views: Sequence[View], levels: Sequence[Sequence[float]], **fields: Any
    ) -> Fit:
        """Return the fit that ends an ascent through blurs of the views."""
        return cls(ascent.states[0], blurs_by_view(views, levels), **fields)

    def is_begun_by(self, other: Ascent, tolerance: float) -> bool:
        """Test whether another ascent ended where this fit's first did, and leads to the same."""
        assert self.first is not None
        away = twist_between(self.first.states[0], other.states[0])
        # two ascents to the same maximum differ by the gains that they left: 0.003 σ_ε
        same = 10 * tolerance * abs(float(other.values[0]))
        return float(away @ other.last.curvature[0] @ away) < same


def blurs_by_view(
    views: Sequence[View], levels: Sequence[Sequence[float]]
) -> tuple[Mapping[str, float], ...]:
    """Return the blurs of levels by names of views."""
    names = [view.name for view in views]
    return tuple([dict(zip(names, level)) for level in levels])


def widest_blurs(
    views: Sequence[View],
    body: Body,
    poses: Floats,  # (H, 4, 4)
    uncertainties: Floats,  # (H, 6), their standard deviations
    rules: FitRules = FitRules(),
) -> Floats:
    """Return blurs (H, L) that cover the root mean square error of predicted features.

    They are at least σ_ε and not much wider than the extent of a view's observation.
    """
    match = project_body(tuple(view.sensor for view in views), body).project(poses)
    # (L, H, n), of all coordinates
    variances = (match.J**2 @ (uncertainties**2)[:, None, :, None])[..., 0].sum(axis=3)
    dimensions = np.array([[view.sensor.dimension] for view in views])
    counts = np.maximum(match.seen.sum(axis=2), 1)
    spreads = np.sqrt((variances * match.seen).sum(axis=2) / counts / dimensions)
    finest = np.array([[view.observation.sigma] for view in views])
    extents = [[np.subtract(*view.observation.extent[::-1]).max()] for view in views]
    widest = np.minimum(spreads, np.maximum(rules.widest * np.array(extents), finest))
    return np.asarray(np.maximum(widest, finest).T)


def blur_schedule(
    views: Sequence[View],
    body: Body,
    T_world_object: Floats,
    uncertainty: Floats,
    rules: FitRules = FitRules(),
) -> list[list[float]]:
    """Return blurs per level and view, from coarse to σ_ε.

    The coarsest are `widest_blurs` at a start (4, 4) with standard deviations (6,).
    """
    finest = np.array([view.observation.sigma for view in views])
    wider = widest_blurs(views, body, T_world_object[None], uncertainty[None], rules)[0] / finest
    return [(finest * wider**share).tolist() for share in narrowing(float(wider.max()), rules)]


def narrowing(wider: float, rules: FitRules = FitRules()) -> list[float]:
    """Return powers, from 1 to 0, of a blur so much `wider` than σ_ε: the levels of a schedule."""
    count = int(np.ceil(np.log(wider) / np.log(rules.ratio)))
    return [k / max(count, 1) for k in range(count, -1, -1)]


def fit_near(
    views: Sequence[View],  # at least one, none with an empty observation
    body: Body,
    T_start: Floats,  # (4, 4)
    uncertainty: Floats,  # (6,) its standard deviations
    options: EstimatorOptions,
    samples: Floats,  # (N, R, 3) of the body, for the objectives that integrate by sampling
    *,
    finest: MatchedObjective | None = None,  # at σ_ε, if known
    begun: Ascent | None = None,  # from the start at σ_ε, if known
    climbed: list[Fit] | None = None,  # fits with the same views and noise; this one is added
    blur: float = 1.0,  # in σ_ε, as close as the start is: coarser levels are left out
    least: float = -math.inf,  # log likelihood at σ_ε below which the fit ends there
    noise: Floats = np.zeros((2, 1)),  # (2, L) squares, σ_ε², and degrees of earlier frames
    fields: float = 1.0,  # share of the noise by calibration, in no sensor's own noise
    extra_sigma: float = 0.0,  # standard deviation of other errors of features, in σ_ε
    wide: float = 1.0,  # blur in σ_ε at which the fit ends, if features are off by more than σ_ε
    errors: ErrorRules = ErrorRules(),
    association: AssociationRules = AssociationRules(),
    rules: FitRules = FitRules(),
) -> Fit:
    """Climb the objective from coarse blurs to the noise, or reuse a fit that begins alike."""
    free, sigmas = free_mask(options), [view.observation.sigma for view in views]
    blur = blur if wide <= 1 else wide
    levels, begins = list[list[float]](), [blur * sigma for sigma in sigmas]

    def sampled(level: Sequence[float], T: Floats) -> MatchedObjective | PaperObjective:
        seed = options.seed
        return build_objective(options.objective, views, body, samples, level, T, seed)

    def descended(last: MatchedObjective | None, newton: NewtonOptions) -> Ascent:
        states, spread = T_start[None], np.where(free, uncertainty, 0.0)
        for level in blur_schedule(views, body, T_start, spread, rules)[:-1]:
            if level[0] <= begins[0]:
                break
            levels.append(level)
            objective = sampled(level, states[0])
            states = ascend(objective, states, perturb, free, rules.coarse).states
        end = last or sampled(sigmas, states[0])
        return ascend(end, states, perturb, free, newton)

    if options.objective != "matched":
        return Fit.of(descended(None, rules.fine), views, [*levels, sigmas])
    finest = finest or matched_objective(views, body, sigmas)
    if finest.are_grids.all():  # noise is that of cells
        fit = Fit.of(descended(finest, rules.fine), views, [*levels, sigmas])
        prior = NormalPrior(T_start, uncertainty, free)
        T, is_freed = believed(finest, fit.T_world_object, prior, rules)
        return replace(fit, T_world_object=T, freed=is_freed)
    first = finest if blur == 1 else matched_objective(views, body, begins)
    ascent = begun or _at_once(first, T_start, free, rules, blur < 1)
    ascent = ascent or descended(first, rules.sharp)
    fits = climbed if climbed is not None and blur == 1 else []
    for fit in fits:
        if fit.is_begun_by(ascent, rules.sharp.tolerance):
            return fit
    if wide > 1:
        matches = associate(first, ascent.states[0], association, errors.narrowest)
        return Fit.of(ascent, views, [*levels, begins], matches=matches)
    arguments = finest, free, least, noise, fields, extra_sigma, errors, association, rules
    fits.append(_to_the_noise(ascent, [*levels, begins], blur, first, *arguments))
    return fits[-1]


def fit_together(
    objectives: Sequence[MatchedObjective],  # on the same densities
    starts: Sequence[Floats],  # (4, 4) each
    free: Mask,
    rules: FitRules = FitRules(),
) -> list[tuple[MatchedObjective, Ascent] | None]:
    """Climb the objectives of several bodies at σ_ε at once, as `fit_near` begins.

    Returns objectives with their match at the end; None for a body that has to descend to σ_ε.
    """
    joint, states = together(objectives), np.array(starts)
    start = joint.linearise(states)
    ends = ascend(joint, states, perturb, free, replace(rules.sharp, together=True), start)
    is_near = start.value >= rules.near * np.array([len(o.views) for o in objectives])
    return [
        (objective, ends.of(slice(k, k + 1))) if is_near[k] else None
        for k, objective in enumerate(joint.split(objectives, ends.states))
    ]


def _at_once(
    objective: MatchedObjective, T_start: Floats, free: Mask, rules: FitRules, anywhere: bool
) -> Ascent | None:
    """Climb from a start, if it is near by its value per sensor, or if it may be `anywhere`."""
    start = objective.linearise(T_start[None])
    is_near = anywhere or start.value[0] >= rules.near * len(objective.views)
    return ascend(objective, T_start[None], perturb, free, rules.sharp, start) if is_near else None


def _to_the_noise(
    ascent: Ascent,
    levels: list[list[float]],
    blur: float,
    objective: MatchedObjective,  # that was climbed
    finest: MatchedObjective,
    free: Mask,
    least: float,
    known: Floats,
    fields: float,
    extra_sigma: float,
    errors: ErrorRules,
    association: AssociationRules,
    rules: FitRules,
) -> Fit:
    """Continue an ascent from a blur in σ_ε while outliers, or weights by noise, move the pose.

    Near its maximum a sensor's value falls by r²/4σ², and its log-likelihood by r²/2s².
    """
    sigmas = np.array([view.observation.sigma for view in finest.views])
    blurs, count, first = np.array([blur] * len(sigmas)), int(np.count_nonzero(free)), ascent
    likeliest, best, counted = -np.inf, None, np.ones(len(sigmas))
    while True:
        matches = wide = associate(finest, ascent.states[0], association, errors.narrowest)
        if extra_sigma:
            wide = replace(matches, finest=np.clip(matches.finest, errors.blur * extra_sigma, 1.0))
        estimate = _, variances, narrow, before = errors_seen(wide, count, known, errors)
        noise = None if extra_sigma else estimate
        fit = Fit.of(ascent, finest.views, levels, matches=matches, noise=noise, first=first)
        # offsets at a pose bent by outliers hide how small the noise is
        variances = np.minimum(variances, (before / errors.blur) ** 2)
        weighed = errors.counted(variances, fields)
        end = np.minimum(np.minimum(narrow, before), blurs)
        is_noise, is_pulled = _are_noise(matches, variances, blurs, errors, rules)
        ratios, counted = weighed / counted, weighed
        # weights have to be those of the noise; at first features of a grid have equal heights
        is_rough = best is None and bool(finest.are_grids.any())
        are_right = not is_rough and bool(ratios.min() > rules.narrower**2 * ratios.max())
        is_end = is_noise or bool((end > rules.narrower * blurs).all())
        is_end = is_end and (are_right or best is not None)
        straight, is_clear, ahead = np.inf, are_right and not is_pulled, None
        if not is_end and (best is None or is_clear):
            moved, shift, _ = ahead = _moved(matches, free, end, variances)
            is_end = best is None and moved < rules.moved**2
            # the next blur is as narrow as features are off by then, if no other detection pulls
            straight = shift if is_clear else np.inf
        narrower = np.maximum(end, np.minimum(blurs / rules.ratio, straight))
        is_only = best is None and is_end
        likelihood = np.inf if is_only else float(log_likelihood(narrow, matches, count, errors))
        if best is None or likelihood > likeliest:
            likeliest, best = likelihood, fit
        if is_end:
            return best
        if likeliest < least:  # end if narrower blurs cannot reach `least` either
            *_, offsets = ahead or _moved(matches, free, end, variances)
            shifted = replace(matches, offsets=offsets)
            narrow = errors_seen(shifted, count, known, errors)[2]
            if log_likelihood(narrow, shifted, count, errors) < least:
                return best
        likeliest = -np.inf if is_rough else likeliest
        if not is_noise:
            blurs, levels = narrower, [*levels, (narrower * sigmas).tolist()]
            views = _around(finest.views, matches, errors.reach)
            objective = matched_objective(views, finest.projection.body, levels[-1])
        by_noise = with_heights(objective.in_nats(blurs * blurs / weighed), rules.unlike)
        ascent = ascend(by_noise, ascent.states, perturb, free, rules.sharp)


def _are_noise(
    matches: Matches, variances: Floats, blurs: Floats, errors: ErrorRules, rules: FitRules
) -> tuple[bool, bool]:
    """Test whether offsets are noise (L,) and nothing else pulls at blurs (L,); and whether it
    does.

    A pose moves by at most as many of its deviations as all pulls together are of the noise.
    """
    far = np.count_nonzero(errors.are_off(matches, variances[:, None] + matches.extra)) > 0
    squared = np.square(matches.neighbour_distance)  # NaN of features that are not in view
    pulls = squared * np.exp(squared / (-2 * blurs * blurs)[:, None])
    pull = np.nansum(pulls, axis=1) + _pulls_of_missed(matches, blurs)
    is_pulled = bool((pull >= rules.moved**2 * variances).any())
    return not (far or is_pulled), is_pulled


def _pulls_of_missed(matches: Matches, blurs: Floats) -> Floats:
    """Return squared pulls (L,), σ_ε², between missed features that overlap at blurs (L,).

    The prediction is normalised, so that moving two features apart gains where no detection is.
    """
    pulls = np.zeros(len(blurs))
    for k in np.flatnonzero(matches.missed > 1.5):
        is_missed = (matches.weights[k] > 0) & (matches.shares[k] == 0)
        y = matches.places[k, is_missed] / matches.sigmas[k]
        squared = np.vecdot(away := y[:, None] - y, away)
        pulls[k] = np.vdot(squared, np.exp(squared / (-2 * blurs[k] ** 2)))
    return pulls


def _around(views: Sequence[View], matches: Matches, reach: float) -> list[View]:
    """Return views of the detections around features in view: a fine grid holds no more."""
    near = zip(views, matches.places, matches.weights > 0, matches.dimensions, strict=True)
    return [
        replace(view, observation=view.observation.around(y[seen, :m], reach))
        for view, y, seen, m in near
    ]


def _moved(
    matches: Matches, free: Mask, narrower: Floats, variances: Floats
) -> tuple[float, float, Floats]:
    """Estimate how far narrower blurs (L,) move the pose, in squared standard deviations.

    Also returns the largest shift of a feature met, in σ_ε, and the remaining offsets (L, N, m).
    """
    J = matches.J[..., free].reshape(matches.offsets.size, -1)
    offsets, twist = matches.offsets, np.zeros(J.shape[1])
    # two steps of least squares go 0.80 of the way, of 70 features 0.89; one goes 0.62 and 0.77
    for _ in range(2):
        weights = matches.shares * welsch((offsets * offsets).sum(axis=2), narrower)
        rows = (weights / (variances[:, None] + matches.extra)).repeat(2)[:, None] * J
        information = rows.T @ J
        twist += np.linalg.lstsq(information, rows.T @ offsets.ravel())[0]
        offsets = matches.offsets - (J @ twist).reshape(offsets.shape)
    away = matches.offsets - offsets
    shift = np.sqrt(np.vecdot(away, away).max(initial=0.0, where=matches.shares > 0))
    return float(twist @ information @ twist), float(shift), offsets
