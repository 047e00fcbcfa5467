"""Propose starts for fits in a frame, in the order in which they are tried.

A proposer yields starts for a frame, given the poses so far, and tests itself whether it applies.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
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
from mixpose.records import Floats, Mask, replace
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
from mixpose.tracking.frame import Frame, Start, gains_by
from mixpose.tracking.ranges import are_associated
from mixpose.tracking.track import likely_branches

# takes the poses so far, the most evident first
Proposer: TypeAlias = Callable[[Frame, list[ScoredPose]], Iterable[Start]]


def predicted(frame: Frame, ranked: list[ScoredPose]) -> Sequence[Start]:
    """Return the predictions of the track and of a companion; always applies.

    Where several bodies are fitted together, their common starts instead.
    """
    likely = frame.predictions
    if len(likely) > 1 and not _are_ranges(frame):
        likely = likely_branches(likely, frame.rules.acceptance.confidence)
    return frame.starts or [
        Start(branch.T_world_object, branch.uncertainty, branch)
        for branch in (*likely, frame.companion_prediction)
        if branch
    ]


def _are_ranges(frame: Frame) -> bool:
    return are_associated(frame.views, frame.body, frame.rules.ranges)


def is_doubtful(frame: Frame, ranked: Sequence[ScoredPose]) -> bool:
    """Test whether no pose convinces yet, so that the body is sought elsewhere.

    After some ok frames a pose also convinces that misses no more features all at once, and that
    one sensor alone meets no farther off than by chance.  Before, what all sensors meet farther off
    may be a reflection in a pane, or another thing.  Single ranges of a small body are met about as
    well at other turns: there the odds of a better pose elsewhere decide.
    """
    track, rules = frame.track, frame.rules
    if ranked and (odds := ranked[0].elsewhere) is not None:
        return odds > rules.acceptance.log_doubt
    is_new = track.ok_count < rules.proposals.believed
    is_far = bool(ranked) and _is_far(frame, ranked[0], is_new=is_new)
    if frame.is_found_by(ranked) and not is_far:
        return False
    if not ranked or not is_sure(ranked[0], frame.free, rules.acceptance):
        return True
    is_new |= len(track.branches) != 1
    before, used = sum(track.met_before.values()), ranked[0].used
    is_less = np.count_nonzero(used.shares) <= rules.acceptance.convincing * before
    misses_more = is_less and _leaves_any(frame, ranked[0])
    # a body that two sensors meet is bent, and not elsewhere
    is_off = ranked[0].residual_ratio > 1 and np.count_nonzero(ranked[0].used.met) < 2
    return bool(is_new or is_far or track.misses or track.doubted or misses_more or is_off)


def _leaves_any(frame: Frame, pose: ScoredPose) -> bool:
    """Test whether unmatched detections may show the body elsewhere; True for grey values."""
    if any(view.observation.points is None for view in frame.views):
        return True
    return bool((pose.matches.count > pose.matches.met + 0.5).any())


def is_convincing(frame: Frame, ranked: Sequence[ScoredPose]) -> bool:
    """Test whether the best pose convinces, or lies where expected and is not doubtful."""
    return frame.is_found_by(ranked) or not is_doubtful(frame, ranked)


def _is_far(frame: Frame, pose: ScoredPose, *, is_new: bool) -> bool:
    """Test whether a pose meets the body farther off, or less evidently, than a convincing one.

    For a new track, farther than by chance; a single sensor that disagrees is left out already.
    """
    rules = frame.rules
    if is_new and pose.residual_ratio > 1 and not pose.left_out:
        return True
    if pose.gained < rules.proposals.fallen * frame.track.gained:
        return True
    # much is met far off; or at an unexpected pose anything
    shares = pose.used.shares
    share = float(shares[_met_closely(frame, pose)].sum()) / max(float(shares.sum()), 1e-12)
    is_all = share * pose.coverage >= 1
    return share < rules.acceptance.convincing or not (
        is_all or frame.is_expected(pose.T_world_object)
    )


def _met_closely(frame: Frame, pose: ScoredPose) -> Mask:
    """Return which features (L, N) are met closely, by the noise before and in this frame."""
    errors, used = frame.rules.judgement.noise.errors, pose.used
    names = tuple([view.name for view in frame.views])
    before = dict(zip(names, frame.variances.tolist(), strict=True))
    known = [before.get(name, math.inf) for name in used.names]
    variances = np.minimum(known, pose.variances)
    return np.asarray((used.shares > 0) & ~errors.are_off(used, variances[:, None] + used.extra))


def multistart(frame: Frame, ranked: list[ScoredPose]) -> Iterable[Start]:
    """Yield promising poses around the first prediction, where the widest blurs may mislead."""
    if frame.predictions and is_doubtful(frame, ranked):
        first, rules = frame.predictions[0], frame.rules.proposals
        wide = np.where(frame.free, np.maximum(first.uncertainty, frame.start_uncertainty), 0.0)
        for start in _around(frame, first.T_world_object, wide, rules.kept):
            if is_doubtful(frame, ranked):
                yield start


def within(frame: Frame, ranked: list[ScoredPose]) -> Iterable[Start]:
    """Yield poses that the first prediction of single ranges allows: there may be many maxima.

    A prediction narrower than the noise leaves only one.
    """
    first = frame.predictions[0] if frame.predictions else None
    if first is None or first.spread is None or not _are_ranges(frame):
        return []
    uncertainty = np.where(frame.free, first.uncertainty, 0.0)
    T, wide = first.T_world_object, uncertainty[None]
    blurs = widest_blurs(frame.views, frame.body, T[None], wide, frame.rules.fit)
    if not (blurs > frame.sigmas).any():  # features may be off by no more than σ_ε
        return []
    return _around(frame, T, uncertainty, frame.rules.ranges.modes)


def _around(frame: Frame, T_world_object: Floats, wide: Floats, kept: int) -> list[Start]:
    """Return starts, `kept` at most, to which poses drawn around one descend, the best first."""
    rules, sigmas = frame.rules.proposals, np.array(frame.sigmas)
    narrow = wide / rules.narrowing
    stages = [
        (tuple(level / sigmas), rules.steps, kept)
        for level in blur_schedule(frame.views, frame.body, T_world_object, narrow)
    ]
    cube = np.random.default_rng(frame.options.seed).random((rules.drawn, 6))
    # uniform within √3 standard deviations each way
    drawn = perturb(T_world_object, (2 * cube - 1) * np.sqrt(3) * wide)
    sparse_body = thinned(frame.body, 8 * frame.rules.search.sample)  # some features, far apart
    descent = Descent(frame.views, sparse_body, frame.free, frame.rules.search)
    poses = np.concatenate([T_world_object[None], drawn])
    poses = descent.refine(poses, [(stages[0][0], 0, kept), *stages])
    values = descent.objective().value(poses)
    order = np.argsort(-values, kind="stable")
    near = values[order] > frame.rules.fit.near * len(frame.views)
    return [Start(T, narrow / rules.narrowing) for T in poses[order[near]]]


def searched(frame: Frame, ranked: list[ScoredPose]) -> Iterable[Start]:
    """Yield candidates of a search everywhere, while nothing convinces."""
    return starts_at(frame, candidates_of(frame)) if is_doubtful(frame, ranked) else []


def starts_at(frame: Frame, candidates: Sequence[Candidate]) -> Iterable[Start]:
    """Yield candidates as they are, and fitted: wider blurs of a fit reach false detections."""
    for candidate in candidates:
        yield Start(candidate.T_world_object)
        yield Start(candidate.T_world_object, frame.close_uncertainty)


def candidates_of(frame: Frame) -> list[Candidate]:
    """Return the candidates of the search, the most evident first, within its budget.

    Detections that did not move while the body was lost are left out at first.
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
        log_prior=lambda poses: np.asarray(gains_by([frame], poses)[0]),
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
    """Yield poses at which the body looks the same, or nearly so, as at the best pose.

    Met detections may lie like other features, as after a step of a chessboard's grid; a flat body
    that is small in an image looks almost the same tilted the other way.
    """
    kinds, behind = frame.rules.look_alikes.kinds, frame.rules.look_alikes.behind
    most = -behind / 2  # look-alikes of a pose that is this much likelier clutter are clutter too
    # again from a better look-alike; equally good ones would alternate for ever
    while "congruent" in kinds and ranked and ranked[0].log_evidence > most:
        most = ranked[0].log_evidence + 0.01
        for start in _as_evident(frame, ranked[0]):
            yield start
            if ranked[0].log_evidence > most + behind:
                break  # the remaining starts are rivals of the pose before
    if ranked and "tilted" in kinds:
        yield from _tilted(frame, ranked[0])
    if ranked and frame.T_reference is None and frame.body.asymmetry:
        best = ranked[0].T_world_object
        yield from (Start(best @ S) for S in frame.body.symmetries)


def reason(frame: Frame, best: ScoredPose, rivals: Iterable[ScoredPose]) -> str:
    """Return why one of the rivals is a look-alike of the best pose; empty if none is."""
    body, alike = frame.body, congruent(frame, best)
    limit = frame.rules.look_alikes.alike * body.radius
    for rival, part in product(rivals, alike):
        places = transform(rival.T_world_object @ body.symmetries, body.means)
        distances = np.abs(transform(best.T_world_object @ part.T_body_other, body.means) - places)
        if distances.max(axis=(1, 2)).min() < limit:
            return part.reason
    return ""


def met_features(frame: Frame, judged: ScoredPose) -> frozenset[int]:
    """Return the numbers of features that any sensor meets within its errors.

    Features met farther off, or only by sensors that are left out, may be met by anything.
    """
    return frozenset(np.flatnonzero(_met_closely(frame, judged).any(axis=0)).tolist())


def _moves_alike(frame: Frame, T_world_object: Floats) -> Floats | None:
    """Return the pose, if earlier look-alikes are still open, which all move alike; else None."""
    return T_world_object if len(frame.track.branches) > 1 else None


def congruent(frame: Frame, best: ScoredPose) -> Sequence[LookAlike]:
    """Return motions under which the features met at a pose lie like other features of the body."""
    body = frame.body
    # single ranges do not show which features are met
    if not is_pointlike(body) or 1 in best.matches.dimensions.tolist():
        return ()
    met, rules = met_features(frame, best), frame.rules.look_alikes
    return like_features(body, met, body, tolerance_of(body, body, rules.alike))


def _as_evident(frame: Frame, best: ScoredPose) -> Iterable[Start]:
    """Yield the best pose moved to look-alikes that meet as much; more if motion contradicts."""
    rules, T, alike = frame.rules, best.T_world_object, congruent(frame, best)
    if not alike:
        return
    poses = np.array([T, *(T @ part.T_body_other for part in alike)])
    most, prior, limits = best.matches.met.max(), frame.prior(T)[0], []
    for part, pose in zip(alike, poses[1:], strict=True):
        moved = _moves_alike(frame, T) if part.is_step else None
        against = prior - frame.prior(pose if moved is None else moved)[0]
        limits.append(1 - max(against, 0.0) / max(-rules.acceptance.log_doubt, 1.0))
    least = rules.look_alikes.fewer * np.array(limits)
    # detections nearby rule out most look-alikes, which is less work than looking up values
    near = _near_any(frame, poses)
    (chosen,) = (most * (1 - near[1:] / max(near[0], 1e-12)) < least).nonzero()
    if not chosen.size:
        return
    # the value grows as the square of the features met
    values = np.sqrt(frame.finest.shares(poses[[0, *(1 + chosen)]], whole=True).sum(axis=0))
    fewer = most * (1 - values[1:] / max(values[0], np.finfo(np.float64).tiny))
    for k in np.argsort(fewer, kind="stable").tolist():  # the best first
        if fewer[k] < least[chosen[k]]:
            moved = _moves_alike(frame, T) if alike[chosen[k]].is_step else None
            T_alike, out = poses[1 + chosen[k]], best.left_out
            yield frame.rival(best, T_alike, frame.close_uncertainty, T_moved=moved, left_out=out)


def _near_any(frame: Frame, poses: Floats) -> Floats:
    """Return how many features have a detection nearby at poses (H, 4, 4), or lie in grey values.

    The root of the sum of squares over sensors, like the objective's value.
    """
    images = frame.finest.projection.project(poses)
    near = images.seen.copy()
    for k, (view, variance) in enumerate(zip(frame.views, frame.finest.variances[:, 0])):
        points, m = view.observation.points, view.sensor.dimension
        if points is not None:
            reach = DRAWING.reach * np.sqrt(variance)
            away, _ = cKDTree(points).query(images.y[k, ..., :m], distance_upper_bound=reach)
            near[k] &= np.isfinite(away)
    return np.asarray(np.linalg.norm(near.sum(axis=2), axis=0))


def _tilted(frame: Frame, best: ScoredPose) -> Iterable[Start]:
    """Yield the pose tilted the other way, if cameras on one side meet nearly flat features."""
    body, views, T = frame.body, frame.views, best.T_world_object
    if len(views) > 1:
        least, seen = frame.rules.acceptance.agreeing, best.matches
        met = {name for name, share in zip(seen.names, seen.coverage) if share >= least}
        views = [view for view in views if view.name in met]
    if not views or any(view.sensor.dimension != 2 for view in views):
        return
    features, flat = frozenset(range(len(body))), frame.rules.look_alikes.flat
    # a wrong tilt may be why little of a flat body is met
    if thickness(body) > flat and is_pointlike(body):
        features = met_features(frame, best)
    if len(features) >= 3 and thickness(body, features) <= flat:
        middle = transform(T, body.means[sorted(features)].mean(axis=0, keepdims=True))
        directions = np.array([view.sensor.towards(middle)[0] for view in views])
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        axis = directions.mean(axis=0)
        if np.linalg.norm(axis) < math.cos(frame.rules.look_alikes.aside):
            return
        wide = frame.close_uncertainty * frame.rules.proposals.narrowing
        tilted = other_tilt(body, features, T, axis)
        yield frame.rival(best, tilted, wide, T_moved=_moves_alike(frame, T))


PROPOSERS: tuple[Proposer, ...] = (predicted, within, multistart, searched, look_alikes)
