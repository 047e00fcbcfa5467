"""Where the body of a frame may be: starts for fits, in the order in which they are tried.

A proposer yields starts for a frame, given the poses found so far.  A refinement yields starts that
may do better than a judged pose: without a sensor, with merged features, at narrow blurs.  Each
says itself when it applies.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import partial
from itertools import combinations, product
from operator import add
from typing import TypeAlias

import numpy as np
from scipy.spatial import cKDTree
from scipy.special import fdtri

from mixpose.body import LookAlike, like_features, other_tilt, thickness, tolerance_of
from mixpose.density import DRAWING
from mixpose.fit import Fit, blur_schedule
from mixpose.judgement import AcceptanceRules, NoiseModel, ScoredPose, inverted, is_sure
from mixpose.matching import LEAST_VARIANCE, ErrorRules, Matches, log_likelihood, welsch
from mixpose.optimise import LinearResiduals, least_squares
from mixpose.records import Floats, Indices, Mask
from mixpose.rigid import perturb, transform
from mixpose.search import Candidate, Descent, SearchReport, SearchState, search_frame, sparse
from mixpose.tracking.frame import Frame, Start
from mixpose.tracking.likelihood import Likelihood, met_at

# from the poses found so far, the most evident first
Proposer: TypeAlias = Callable[[Frame, list[ScoredPose]], Iterable[Start]]
Refinement: TypeAlias = Callable[[Frame, Likelihood, ScoredPose], Iterable[Start]]

OUT_OF_STEP = "out of step or bumped"


def predicted(frame: Frame, ranked: list[ScoredPose]) -> Sequence[Start]:
    """Where the branches of the track expect the body, and another body beside it; always.

    Or where it was found with all bodies at once.
    """
    return frame.starts or [
        Start(one.T_world_object, one.uncertainty, one)
        for one in (*frame.predictions, frame.beside)
        if one
    ]


def is_doubtful(frame: Frame, ranked: list[ScoredPose]) -> bool:
    """Whether no pose convinces yet, so that the body is to be looked for elsewhere.

    Once it was followed for some frames, a pose convinces that misses no more all at once.
    """
    track, rules = frame.track, frame.rules
    if frame.first_is(frame.trusted, ranked):
        return False
    if not ranked or not is_sure(ranked[0], frame.free, rules.acceptance):
        return True
    is_new = track.believed < rules.proposals.believed or len(track.branches) != 1
    before = sum(track.met_before.values())
    misses_more = np.count_nonzero(ranked[0].used.shares) <= rules.acceptance.convincing * before
    return bool(is_new or track.misses or track.doubted or misses_more)


def multistart(frame: Frame, ranked: list[ScoredPose]) -> Iterable[Start]:
    """Promising poses around the first prediction, where the coarsest blurs may lead astray."""
    if not frame.predictions or not is_doubtful(frame, ranked):
        return
    first, rules = frame.predictions[0], frame.rules.proposals
    wide = np.where(frame.free, np.maximum(first.uncertainty, frame.start_uncertainty), 0.0)
    narrow, sigmas = wide / rules.narrowing, np.array(frame.sigmas)
    stages = [
        (tuple(level / sigmas), rules.steps, rules.kept)
        for level in blur_schedule(frame.views, frame.body, first.T_world_object, narrow)
    ]
    cube = np.random.default_rng(frame.options.seed).random((rules.drawn, 6))
    # uniform within √3 standard deviations each way
    drawn = perturb(first.T_world_object, (2 * cube - 1) * np.sqrt(3) * wide)
    few = sparse(frame.body, 8 * frame.rules.search.sample)  # of many, those far from one another
    descent = Descent(frame.views, few, frame.free, frame.rules.search)
    poses = np.concatenate([first.T_world_object[None], drawn])
    poses = descent.refine(poses, [(stages[0][0], 0, rules.kept), *stages])
    values = descent.objective().value(poses)
    order = np.argsort(-values, kind="stable")
    # those that meet anything, best first
    for T in poses[order[values[order] > frame.rules.fit.near * len(frame.views)]]:
        if is_doubtful(frame, ranked):
            yield Start(T, narrow / rules.narrowing)


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


def reason(frame: Frame, best: ScoredPose, rivals: Iterable[ScoredPose]) -> str:
    """In words, if one of the rivals is a look-alike of the best pose; else empty."""
    body, alike = frame.body, _congruent(frame, best)
    limit = frame.rules.look_alikes.alike * body.radius
    for rival, one in product(rivals, alike):
        there = transform(rival.T_world_object @ body.symmetries, body.means)
        away = np.abs(transform(best.T_world_object @ one.T_body_other, body.means) - there)
        if away.max(axis=(1, 2)).min() < limit:
            return one.reason
    return ""


def met_features(judged: ScoredPose) -> frozenset[int]:
    """Numbers of the features that any sensor meets."""
    return frozenset(judged.matches.met_by.nonzero()[0].tolist())


def _moves_alike(frame: Frame, T_world_object: Floats) -> Floats | None:
    """The pose, where the frame before left open which look-alike is right: they move alike."""
    return T_world_object if len(frame.track.branches) > 1 else None


def _congruent(frame: Frame, best: ScoredPose) -> Sequence[LookAlike]:
    """Motions under which what is met at a pose lies like other features of the body."""
    body = frame.body
    # single ranges do not say what is met
    if len(body.nodes.points) != len(body) or 1 in best.matches.dimensions.tolist():
        return ()
    met, rules = met_features(best), frame.rules.look_alikes
    return like_features(body, met, body, tolerance_of(body, body, rules.alike))


def _as_evident(frame: Frame, best: ScoredPose) -> Iterable[Start]:
    """The best pose moved, where it meets as much, and more where motion tells against it."""
    rules, T, alike = frame.rules, best.T_world_object, _congruent(frame, best)
    if not alike:
        return
    poses = np.array([T, *(T @ one.T_body_other for one in alike)])
    most, own, limits = best.matches.met.max(), frame.prior(T)[0], []
    for one, pose in zip(alike, poses[1:], strict=True):
        moved = _moves_alike(frame, T) if one.is_step else None
        against = own - frame.prior(pose if moved is None else moved)[0]
        limits.append(1 + max(against, 0.0) / rules.acceptance.log_doubt)
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
            yield frame.rival(best, poses[1 + few[k]], frame.close, T_moved=moved)


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
    """The pose tilted the other way, where one camera alone meets a nearly flat body."""
    body, views, T = frame.body, frame.views, best.T_world_object
    if len(views) > 1:
        least, seen = frame.rules.acceptance.agreeing, best.matches
        met = {name for name, share in zip(seen.names, seen.coverage) if share >= least}
        views = [view for view in views if view.name in met]
    if len(views) != 1 or views[0].sensor.dimension != 2 or len(body) < 3:
        return
    if thickness(body) <= frame.rules.look_alikes.flat:
        away = views[0].sensor.towards(transform(T, body.means.mean(axis=0)[None]))[0]
        wide = frame.close * frame.rules.proposals.narrowing
        tilted = other_tilt(body, T, away)
        yield frame.rival(best, tilted, wide, T_moved=_moves_alike(frame, T))


def without_sensor(frame: Frame, likelihood: Likelihood, judged: ScoredPose) -> Iterable[Start]:
    """The pose fitted without the sensors that disagree with two others or more."""
    if len(frame.views) < 3 or judged.left_out:
        return
    if apart := disagreeing(judged.matches, frame.rules.acceptance, frame.rules.judgement.noise):
        yield Start(judged.T_world_object, frame.close, left_out=dict.fromkeys(apart, OUT_OF_STEP))


def disagreeing(seen: Matches, rules: AcceptanceRules, model: NoiseModel) -> list[str]:
    """Sensors that see the body elsewhere than two others or more do.

    They meet little of it, with as many detections beside it that belong to nothing, or with
    residuals that are far larger than the others', more than chance would make them.
    """
    agreeing = seen.coverage >= rules.agreeing
    apart = ~agreeing & (seen.expected > 0)
    apart &= seen.unmatched_nearby >= rules.agreeing * seen.missed
    squares, degrees = seen.squares * agreeing, seen.measurements * agreeing
    if np.count_nonzero(agreeing) > 2:
        rest = degrees.sum() - degrees
        variances = (squares.sum() - squares) / np.maximum(rest, 1e-12)
        # NaN without degrees of freedom, which nothing is larger than
        limits = np.maximum(rules.disagreeing, fdtri(degrees, rest, model.by_chance))
        apart |= squares > degrees * limits * np.maximum(variances, LEAST_VARIANCE)
    names = [seen.names[k] for k in np.flatnonzero(apart)]
    return names if np.count_nonzero(agreeing & ~apart) >= 2 else []


def merged_pair(frame: Frame, likelihood: Likelihood, judged: ScoredPose) -> Iterable[Start]:
    """Least squares with the middles of features that run into each other in one detection.

    Of the nearest pair in each sensor, and of all that may be.
    """
    rules, before = frame.rules.judgement.association, 0
    for most in (1, len(frame.body)):
        paired, is_far = _paired(judged.matches, rules.reach_squared, rules.middle, most)
        if (pairs := int(paired.merged.sum())) == before:
            return
        before = pairs
        # pairs that are as far off as their spot is wide pull from there, or not at all
        for widest in (0.0, 1.0) if is_far else (0.0,):
            if (T := _with_pairs(frame, judged.T_world_object, paired, widest)) is not None:
                yield Start(T)


def _with_pairs(
    frame: Frame, T_world_object: Floats, paired: Matches, widest: float
) -> Floats | None:
    """The pose (4, 4) by two steps of least squares, the first at that blur or the noise's."""
    T, seen = T_world_object, paired
    narrow = frame.rules.judgement.noise.errors.blur * np.sqrt(frame.variances)
    for least in (widest, 0.0):  # the second starts within 0.01 σ_ε of the first's end
        if T is not T_world_object:
            T, seen = met_at(frame, Fit(T))
        if not np.count_nonzero(seen.merged):
            break
        weights = welsch(seen.squared, np.maximum(narrow, least))
        J, offsets = replace(seen, shares=seen.shares * weights).rows()
        rest = LinearResiduals(J.reshape(-1, 6), offsets.ravel())
        T = perturb(T, least_squares(rest, free=frame.free)[0])
    return None if T is T_world_object else T


def _paired(seen: Matches, reach: float, middle: float, most: int) -> tuple[Matches, bool]:
    """In each sensor features missed near detections of single ones, as one with these.

    The nearest first, so many at most; `reach` is how far that may be, squared, in variances of C,
    of detections without a size.  And whether any are farther off.
    """
    if not np.count_nonzero(seen.missed):
        return seen, False
    shares, offsets, J = seen.shares.copy(), seen.offsets.copy(), seen.J.copy()
    merged, extra, is_far = seen.merged.copy(), seen.extra.copy(), False
    for k in np.flatnonzero((seen.missed > 0) & (seen.met > 0)):
        by = seen.detections[k]
        met = np.flatnonzero((by >= 0) & ((by[:, None] == by).sum(axis=1) == 1))
        lost = np.flatnonzero((seen.weights[k] > 0) & (shares[k] == 0))
        away = (seen.places[k, met] - seen.places[k, lost, None]) / seen.sigmas[k] + offsets[k, met]
        squared = (away * away).sum(axis=2) / 2
        # of two disks that touch the centres are √2 times as far apart as their joint area is wide
        squared[squared > np.maximum(reach, (seen.radii[k, met] / seen.sigmas[k]) ** 2)] = np.inf
        for _ in range(most):
            if squared.min(initial=np.inf) == np.inf:
                break
            i, j = np.unravel_index(int(squared.argmin()), squared.shape)
            is_far |= bool(squared[i, j] > reach)
            pair = [lost[i], met[j]]
            shares[k, pair] = shares[k, met[j]] / 2
            offsets[k, pair] = (away[i, j] + offsets[k, met[j]]) / 2
            J[k, pair] = J[k, pair].mean(axis=0)
            merged[k], extra[k, pair] = merged[k] + 1, middle**2
            squared[i], squared[:, j] = np.inf, np.inf
    return replace(seen, shares=shares, offsets=offsets, J=J, merged=merged, extra=extra), is_far


def agreed(frame: Frame, likelihood: Likelihood, judged: ScoredPose) -> Iterable[Start]:
    """Where some of the detections that are met fix the pose, and others agree with them.

    Several that are cut, or another's, may pull a fit together, all a little off then; the rest
    agrees elsewhere.  Modes of the likelihood are sought by one step of least squares from each of
    many sets.
    """
    errors, rules, used = frame.rules.judgement.noise.errors, frame.rules, judged.used
    # what is off is told by the noise of frames before
    if judged.proposer != predicted.__name__ or judged.left_out or not frame.track.believed:
        return
    noise = np.sqrt(np.minimum(frame.variances, judged.variances))  # this frame's has what is off
    off = errors.are_off(used, noise[:, None] ** 2) & (used.detections >= 0)
    if judged.residual_ratio <= 1 and not _carry(off, used, noise, frame):
        return
    is_met = (used.shares > 0) & (used.detections >= 0)
    J = (used.J[..., frame.free] / noise[:, None, None, None])[is_met]
    r = (used.offsets / noise[:, None, None])[is_met]
    few = -(-J.shape[2] // int(used.dimensions.min()))
    if (sets := _some_sets(len(r), few, rules.proposals.sets, frame.options.seed)) is None:
        return
    known = frame.predictions[0].uncertainty if frame.predictions else frame.start_uncertainty
    rows = J[sets].reshape(len(sets), -1, J.shape[2])
    information = rows.swapaxes(1, 2) @ rows + np.diag(known[frame.free] ** -2.0)
    twists = np.linalg.solve(information, rows.swapaxes(1, 2) @ r[sets].reshape(*rows.shape[:2], 1))
    twists = np.concatenate([np.zeros((1, J.shape[2])), twists[..., 0]])
    moved = np.einsum("nmk,sk->snm", J, twists)  # in deviations of the noise
    offsets = np.zeros((len(twists), *used.offsets.shape))
    offsets[:, is_met] = (r - moved) * noise[is_met.nonzero()[0], None]
    others = replace(used, offsets=offsets)
    likely = log_likelihood(errors.blur * noise, others, J.shape[2], errors)
    likely[_is_out_of_step(others, noise**2, errors).any(axis=1)] = -np.inf
    poses = perturb(judged.T_world_object, twists @ np.eye(6)[frame.free])
    least, modes = float(likely.max()) + rules.acceptance.log_doubt, [0]
    for k in np.argsort(-likely, kind="stable").tolist():
        if not likely[k] > least or len(modes) > rules.proposals.kept:
            break
        apart = moved[modes] - moved[k]
        if np.vecdot(apart, apart).max(axis=1).min() > errors.outlying**2:
            modes.append(k)
            start = Start(poses[k], frame.close, blur=errors.blur * float(noise.max()))
            T, seen = met_at(frame, fit := likelihood.fit(start))
            if not _is_out_of_step(seen, frame.variances, errors).any():
                yield Start(T, matches=seen, noise=fit.noise if seen is fit.matches else None)


def _is_out_of_step(seen: Matches, variances: Floats, errors: ErrorRules) -> Mask:
    """Of which sensors (..., L) most are off by more than noise: others are no better for it."""
    off = errors.are_off(seen, variances[:, None] + seen.extra).sum(axis=-1)
    return np.asarray(2 * off > np.count_nonzero(seen.shares, axis=-1))


def _some_sets(count: int, few: int, most: int, seed: int) -> Indices | None:
    """All sets (S, few) of so many numbers below a count, or some at random; None for too few."""
    if count <= few:
        return None
    if math.comb(count, few) <= most:
        return np.array([*combinations(range(count), few)])
    return np.random.default_rng(seed).random((most, count)).argsort(axis=1)[:, :few]


def _carry(off: Mask, used: Matches, noise: Floats, frame: Frame) -> bool:
    """Whether features (L, N) that are off carry any away, by a part of the noise that matters.

    They do so by least squares at the most.  Where they do not, all modes are one.
    """
    if not np.count_nonzero(off):
        return False
    J = used.J[..., frame.free] / noise[:, None, None, None]
    met = J[used.shares > 0].reshape(-1, J.shape[-1])
    pull = np.einsum("nmk,nm->k", J[off], (used.offsets / noise[:, None, None])[off])
    moved = (met @ (inverted(met.T @ met) @ pull)).reshape(-1, J.shape[-2])
    return bool(np.vecdot(moved, moved).max() > frame.rules.fit.moved**2)


PROPOSERS: tuple[Proposer, ...] = (predicted, multistart, searched, look_alikes)
REFINEMENTS: tuple[Refinement, ...] = (without_sensor, merged_pair, agreed)
