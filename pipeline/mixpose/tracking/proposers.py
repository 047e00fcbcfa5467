"""Where the body of a frame may be: starts for fits, in the order in which they are tried.

A proposer yields starts for a frame, given the poses found so far, and says itself when it applies.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import partial
from itertools import product
from operator import add
from typing import TypeAlias

import numpy as np
from scipy.spatial import cKDTree

from mixpose.body import LookAlike, like_features, other_tilt, thickness, tolerance_of
from mixpose.density import DRAWING
from mixpose.fit import blur_schedule, widest_blurs
from mixpose.judgement import ScoredPose, is_sure
from mixpose.records import Floats, Mask
from mixpose.rigid import perturb, transform
from mixpose.search import (
    Candidate,
    Descent,
    SearchReport,
    SearchState,
    is_pointlike,
    search_frame,
    thinned,
)
from mixpose.tracking.frame import Frame, Start
from mixpose.tracking.ranges import are_associated
from mixpose.tracking.track import worth_telling

# from the poses found so far, the most evident first
Proposer: TypeAlias = Callable[[Frame, list[ScoredPose]], Iterable[Start]]


def predicted(frame: Frame, ranked: list[ScoredPose]) -> Sequence[Start]:
    """Where the branches of the track expect the body, and another body beside it; always.

    Or where it was found with all bodies at once.
    """
    likely = frame.predictions
    if len(likely) > 1 and not _are_ranges(frame):
        likely = worth_telling(likely, frame.rules.acceptance.confidence)
    return frame.starts or [
        Start(one.T_world_object, one.uncertainty, one) for one in (*likely, frame.beside) if one
    ]


def _are_ranges(frame: Frame) -> bool:
    return are_associated(frame.views, frame.body, frame.rules.ranges)


def is_doubtful(frame: Frame, ranked: Sequence[ScoredPose]) -> bool:
    """Whether no pose convinces yet, so that the body is to be looked for elsewhere.

    Once it was followed for some frames, a pose convinces that misses no more all at once and that
    one sensor alone meets no farther off than chance makes it.  Single ranges of a small body are
    met about as well at other turns: there it is asked whether a pose elsewhere may be as likely.
    Before, what all sensors are farther off than that may be its image in a pane, or another thing.
    """
    track, rules = frame.track, frame.rules
    if ranked and (odds := ranked[0].elsewhere) is not None:
        return odds > rules.acceptance.log_doubt
    is_new = track.believed < rules.proposals.believed
    is_far = bool(ranked) and _is_far(frame, ranked[0], is_new=is_new)
    if frame.first_is(frame.trusted, ranked) and not is_far:
        return False
    if not ranked or not is_sure(ranked[0], frame.free, rules.acceptance):
        return True
    is_new |= len(track.branches) != 1
    before, used = sum(track.met_before.values()), ranked[0].used
    is_less = np.count_nonzero(used.shares) <= rules.acceptance.convincing * before
    misses_more = is_less and _leaves_any(frame, ranked[0])
    # what two sensors meet is bent, and not elsewhere
    is_off = ranked[0].residual_ratio > 1 and np.count_nonzero(ranked[0].used.met) < 2
    return bool(is_new or is_far or track.misses or track.doubted or misses_more or is_off)


def _leaves_any(frame: Frame, pose: ScoredPose) -> bool:
    """Whether detections are left that may show the body elsewhere; of grey values nobody knows."""
    if any(view.observation.points is None for view in frame.views):
        return True
    return bool((pose.matches.count > pose.matches.met + 0.5).any())


def is_there(frame: Frame, ranked: Sequence[ScoredPose]) -> bool:
    """Whether what is found convinces, or lies where it was expected and casts no doubt."""
    return frame.first_is(frame.trusted, ranked) or not is_doubtful(frame, ranked)


def _is_far(frame: Frame, pose: ScoredPose, *, is_new: bool) -> bool:
    """Whether a pose meets the body farther off, or less evidently, than one that convinces.

    Of a track that `is_new`, by more than chance; what one sensor of several is off by is left out
    already.
    """
    rules = frame.rules
    if is_new and pose.residual_ratio > 1 and not pose.left_out:
        return True
    if pose.gained < rules.proposals.fallen * frame.track.gained:
        return True
    # much of it; or anything, where the frames before let nobody expect it
    close = _close(frame, pose)
    is_all = close * pose.coverage >= 1
    return close < rules.acceptance.convincing or not (
        is_all or frame.is_expected(pose.T_world_object)
    )


def _close(frame: Frame, pose: ScoredPose) -> float:
    """Share of what is met that is met as closely as the noise of the frames before has it."""
    shares = pose.used.shares
    return float(shares[_met_closely(frame, pose)].sum()) / max(float(shares.sum()), 1e-12)


def _met_closely(frame: Frame, pose: ScoredPose) -> Mask:
    """Which features (L, N) are met as closely as the noise has it, before the frame and in it."""
    errors, used = frame.rules.judgement.noise.errors, pose.used
    before = dict(zip((view.name for view in frame.views), frame.variances, strict=True))
    variances = np.minimum([before.get(name, np.inf) for name in used.names], pose.variances)
    return np.asarray((used.shares > 0) & ~errors.are_off(used, variances[:, None] + used.extra))


def multistart(frame: Frame, ranked: list[ScoredPose]) -> Iterable[Start]:
    """Promising poses around the first prediction, where the coarsest blurs may lead astray."""
    if frame.predictions and is_doubtful(frame, ranked):
        first, rules = frame.predictions[0], frame.rules.proposals
        wide = np.where(frame.free, np.maximum(first.uncertainty, frame.start_uncertainty), 0.0)
        for start in _around(frame, first.T_world_object, wide, rules.kept):
            if is_doubtful(frame, ranked):
                yield start


def within(frame: Frame, ranked: list[ScoredPose]) -> Iterable[Start]:
    """Poses that the first prediction allows, of single ranges: there may be several maxima.

    Where it is narrower than the noise there is only one.
    """
    first = frame.predictions[0] if frame.predictions else None
    if first is None or first.spread is None or not _are_ranges(frame):
        return []
    uncertainty = np.where(frame.free, first.uncertainty, 0.0)
    if not _is_wide(frame, first.T_world_object, uncertainty):
        return []
    return _around(frame, first.T_world_object, uncertainty, frame.rules.ranges.modes)


def _is_wide(frame: Frame, T_world_object: Floats, uncertainty: Floats) -> bool:
    """Whether features may be off by more than σ_ε at a pose with standard deviations (6,)."""
    given = T_world_object[None], uncertainty[None], frame.rules.fit
    blurs = widest_blurs(frame.views, frame.body, *given)
    return bool((blurs > frame.sigmas).any())


def _around(frame: Frame, T_world_object: Floats, wide: Floats, kept: int) -> list[Start]:
    """What poses lead to that are drawn around one with standard deviations (6,): so many at most.

    Those that meet anything, the best first.
    """
    rules, sigmas = frame.rules.proposals, np.array(frame.sigmas)
    narrow = wide / rules.narrowing
    stages = [
        (tuple(level / sigmas), rules.steps, kept)
        for level in blur_schedule(frame.views, frame.body, T_world_object, narrow)
    ]
    cube = np.random.default_rng(frame.options.seed).random((rules.drawn, 6))
    # uniform within √3 standard deviations each way
    drawn = perturb(T_world_object, (2 * cube - 1) * np.sqrt(3) * wide)
    few = thinned(frame.body, 8 * frame.rules.search.sample)  # of many, those far from one another
    descent = Descent(frame.views, few, frame.free, frame.rules.search)
    poses = np.concatenate([T_world_object[None], drawn])
    poses = descent.refine(poses, [(stages[0][0], 0, kept), *stages])
    values = descent.objective().value(poses)
    order = np.argsort(-values, kind="stable")
    near = values[order] > frame.rules.fit.near * len(frame.views)
    return [Start(T, narrow / rules.narrowing) for T in poses[order[near]]]


def searched(frame: Frame, ranked: list[ScoredPose]) -> Iterable[Start]:
    """Candidates of a search everywhere, where nothing convinces yet."""
    return starts_at(frame, candidates_of(frame)) if is_doubtful(frame, ranked) else []


def starts_at(frame: Frame, candidates: Sequence[Candidate]) -> Iterable[Start]:
    """Candidates as they are, and fitted: the wider blurs of a fit reach false detections."""
    for candidate in candidates:
        yield Start(candidate.T_world_object)
        yield Start(candidate.T_world_object, frame.close)


def candidates_of(frame: Frame) -> list[Candidate]:
    """What the search finds, the most evident first, as far as the budget reaches.

    Detections that stayed where they are while the body was lost are left out at first.
    """
    live = frame.options.search == "live"
    budget = frame.rules.live if live else frame.rules.search
    state = frame.track.search if live else SearchState()
    search = partial(
        search_frame,
        body=frame.body,
        free=frame.free,
        T_reference=frame.T_reference,
        rules=frame.rules.judgement,
        seed=frame.options.seed,
        log_prior=frame.gains,
    )
    among_moving, spent = list[Candidate](), SearchReport()
    moving = frame.track.clutter.without(frame.views, frame.rules.proposals.static)
    if any(view is not whole for view, whole in zip(moving, frame.views, strict=True)):
        budget = replace(budget, max_guesses=budget.max_guesses / 2)
        among_moving, spent, _ = search(moving, budget=budget)
        if among_moving and among_moving[0].evidence > budget.beyond_doubt:
            frame.searches.append((spent, SearchState()))
            return among_moving
    candidates, report, state = search(frame.views, budget=budget, state=state)
    frame.searches.append((SearchReport(*map(add, spent, report)), state))
    return among_moving + candidates


def look_alikes(frame: Frame, ranked: list[ScoredPose]) -> Iterable[Start]:
    """Poses at which the body looks the same, or nearly so, as at the best pose of the frame.

    What is met may lie like other features, as a step of its grid off on a chessboard; a flat body
    that is small in an image looks almost the same tilted the other way.
    """
    kinds, behind = frame.rules.look_alikes.kinds, frame.rules.look_alikes.behind
    most = -behind / 2  # what is so much likelier clutter has no look-alike that is not
    # once more, where what is moved is better: two that are as good would take turns for ever
    while "congruent" in kinds and ranked and ranked[0].log_evidence > most:
        most = ranked[0].log_evidence + 0.01
        for start in _as_evident(frame, ranked[0]):
            yield start
            if ranked[0].log_evidence > most + behind:
                break  # the rest are rivals of what is no rival
    if ranked and "tilted" in kinds:
        yield from _tilted(frame, ranked[0])
    if ranked and frame.T_reference is None and frame.body.asymmetry:
        best = ranked[0].T_world_object
        yield from (Start(best @ one) for one in frame.body.symmetries)


def reason(frame: Frame, best: ScoredPose, rivals: Iterable[ScoredPose]) -> str:
    """In words, if one of the rivals is a look-alike of the best pose; else empty."""
    body, alike = frame.body, congruent(frame, best)
    limit = frame.rules.look_alikes.alike * body.radius
    for rival, one in product(rivals, alike):
        there = transform(rival.T_world_object @ body.symmetries, body.means)
        away = np.abs(transform(best.T_world_object @ one.T_body_other, body.means) - there)
        if away.max(axis=(1, 2)).min() < limit:
            return one.reason
    return ""


def met_features(frame: Frame, judged: ScoredPose) -> frozenset[int]:
    """Numbers of the features that any sensor meets, no farther off than errors put them.

    Of those that are farther off, or that only sensors meet which are left out, nobody knows what
    meets them.
    """
    return frozenset(np.flatnonzero(_met_closely(frame, judged).any(axis=0)).tolist())


def _moves_alike(frame: Frame, T_world_object: Floats) -> Floats | None:
    """The pose, where the frame before left open which look-alike is right: they move alike."""
    return T_world_object if len(frame.track.branches) > 1 else None


def congruent(frame: Frame, best: ScoredPose) -> Sequence[LookAlike]:
    """Motions under which what is met at a pose lies like other features of the body."""
    body = frame.body
    # single ranges do not say what is met
    if not is_pointlike(body) or 1 in best.matches.dimensions.tolist():
        return ()
    met, rules = met_features(frame, best), frame.rules.look_alikes
    return like_features(body, met, body, tolerance_of(body, body, rules.alike))


def _as_evident(frame: Frame, best: ScoredPose) -> Iterable[Start]:
    """The best pose moved, where it meets as much, and more where motion tells against it."""
    rules, T, alike = frame.rules, best.T_world_object, congruent(frame, best)
    if not alike:
        return
    poses = np.array([T, *(T @ one.T_body_other for one in alike)])
    most, own, limits = best.matches.met.max(), frame.prior(T)[0], []
    for one, pose in zip(alike, poses[1:], strict=True):
        moved = _moves_alike(frame, T) if one.is_step else None
        against = own - frame.prior(pose if moved is None else moved)[0]
        limits.append(1 - max(against, 0.0) / max(-rules.acceptance.log_doubt, 1.0))
    least = rules.look_alikes.fewer * np.array(limits)
    # mostly what has no detection near it tells, which is less than to look all up
    near = _near_any(frame, poses)
    (few,) = (most * (1 - near[1:] / max(near[0], 1e-12)) < least).nonzero()
    if not few.size:
        return
    # the value grows as the square of the features met
    values = np.sqrt(frame.finest.shares(poses[[0, *(1 + few)]], whole=True).sum(axis=0))
    fewer = most * (1 - values[1:] / max(values[0], np.finfo(np.float64).tiny))
    for k in np.argsort(fewer, kind="stable").tolist():  # the best first
        if fewer[k] < least[few[k]]:
            moved = _moves_alike(frame, T) if alike[few[k]].is_step else None
            there, out = poses[1 + few[k]], best.left_out
            yield frame.rival(best, there, frame.close, T_moved=moved, left_out=out)


def _near_any(frame: Frame, poses: Floats) -> Floats:
    """How many features have a detection near them at poses (H, 4, 4), or grey values may be.

    The root of the sum of squares over sensors, as the value goes.
    """
    at = frame.finest.projection.project(poses)
    near = at.seen.copy()
    for k, (view, variance) in enumerate(zip(frame.views, frame.finest.variances[:, 0])):
        points, m = view.observation.points, view.sensor.dimension
        if points is not None:
            reach = DRAWING.reach * np.sqrt(variance)
            away, _ = cKDTree(points).query(at.y[k, ..., :m], distance_upper_bound=reach)
            near[k] &= np.isfinite(away)
    return np.asarray(np.linalg.norm(near.sum(axis=2), axis=0))


def _tilted(frame: Frame, best: ScoredPose) -> Iterable[Start]:
    """The pose tilted the other way, where cameras from one side meet what is nearly flat."""
    body, views, T = frame.body, frame.views, best.T_world_object
    if len(views) > 1:
        least, seen = frame.rules.acceptance.agreeing, best.matches
        met = {name for name, share in zip(seen.names, seen.coverage) if share >= least}
        views = [view for view in views if view.name in met]
    if not views or any(view.sensor.dimension != 2 for view in views):
        return
    some, flat = frozenset(range(len(body))), frame.rules.look_alikes.flat
    # a wrong tilt may be why little of a flat body is met
    if thickness(body) > flat and is_pointlike(body):
        some = met_features(frame, best)
    if len(some) >= 3 and thickness(body, some) <= flat:
        middle = transform(T, body.means[sorted(some)].mean(axis=0, keepdims=True))
        sights = np.array([view.sensor.towards(middle)[0] for view in views])
        sights /= np.linalg.norm(sights, axis=1, keepdims=True)
        away = sights.mean(axis=0)
        if np.linalg.norm(away) < math.cos(frame.rules.look_alikes.aside):
            return
        wide = frame.close * frame.rules.proposals.narrowing
        tilted = other_tilt(body, some, T, away)
        yield frame.rival(best, tilted, wide, T_moved=_moves_alike(frame, T))


PROPOSERS: tuple[Proposer, ...] = (predicted, within, multistart, searched, look_alikes)
