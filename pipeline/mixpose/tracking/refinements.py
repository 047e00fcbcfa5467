"""Where a pose that was judged may be better: starts for further fits.

A refinement yields starts that may do better than a judged pose, and says itself when it applies:
without a sensor, with merged features, where most detections agree.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from itertools import combinations
from typing import TypeAlias

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.special import fdtri

from mixpose.fit import Fit, FitRules
from mixpose.judgement import AcceptanceRules, NoiseModel, ScoredPose, inverted
from mixpose.matching import LEAST_VARIANCE, ErrorRules, Matches, log_likelihood, welsch
from mixpose.optimise import LinearResiduals, least_squares
from mixpose.records import Floats, Indices, Mask
from mixpose.rigid import perturb
from mixpose.tracking.frame import Frame, Start
from mixpose.tracking.likelihood import Likelihood, met_at
from mixpose.tracking.proposers import predicted

Refinement: TypeAlias = Callable[[Frame, Likelihood, ScoredPose], Iterable[Start]]

OUT_OF_STEP = "out of step or bumped"
BY_CHANCE = "it meets little of the body, as by chance"


def without_sensor(frame: Frame, likelihood: Likelihood, judged: ScoredPose) -> Iterable[Start]:
    """The pose fitted without the sensors that disagree with others, or may meet it by chance."""
    if len(frame.views) < 2 or judged.left_out:
        return
    rules, seen = frame.rules.acceptance, judged.matches
    if apart := disagreeing(seen, rules, frame.rules.judgement.noise):
        yield Start(judged.T_world_object, frame.close, left_out=dict.fromkeys(apart, OUT_OF_STEP))
    elif chance := by_chance(seen, rules):
        left_out = dict.fromkeys(chance, BY_CHANCE)
        yield Start(judged.T_world_object, frame.close, left_out=left_out)


def by_chance(seen: Matches, rules: AcceptanceRules) -> list[str]:
    """Sensors that meet little of a body that another one meets, beside detections of no feature.

    They may be covered or out of step, and a pose that others leave open bends to what is there.
    """
    coverage = seen.covered
    spare = seen.summed(seen.count) > seen.summed(seen.met)
    little = (coverage > 0) & (coverage < rules.agreeing) & spare
    names = [seen.names[k] for k in np.flatnonzero(little[seen.owner])]
    return names if np.count_nonzero(coverage >= rules.agreeing) else []


def disagreeing(seen: Matches, rules: AcceptanceRules, model: NoiseModel) -> list[str]:
    """Sensors that see the body elsewhere than two others or more do.

    They meet little of it, with as many detections beside it that belong to nothing, or with
    residuals that are far larger than the others', more than chance would make them.
    """
    summed = seen.summed
    agreeing = seen.covered >= rules.agreeing
    apart = ~agreeing & (summed(seen.expected) > 0)
    apart &= summed(seen.unmatched_nearby) >= rules.agreeing * summed(seen.missed)
    squares, degrees = summed(seen.squares) * agreeing, summed(seen.measurements) * agreeing
    if np.count_nonzero(agreeing) > 2:
        rest = degrees.sum() - degrees
        variances = (squares.sum() - squares) / np.maximum(rest, 1e-12)
        # NaN without degrees of freedom, which nothing is larger than
        limits = np.maximum(rules.disagreeing, fdtri(degrees, rest, model.by_chance))
        apart |= squares > degrees * limits * np.maximum(variances, LEAST_VARIANCE)
    names = [seen.names[k] for k in np.flatnonzero(apart[seen.owner])]
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
        T = _by_least_squares(frame, T, replace(seen, shares=seen.shares * weights))
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


def all_near(frame: Frame, likelihood: Likelihood, judged: ScoredPose) -> Iterable[Start]:
    """Least squares with detections near features that are missed: all errors may be larger now.

    A fit that met most of them to less than noise stays there, and leaves the others out.
    """
    seen = judged.matches
    if judged.left_out or seen.measurements.sum() <= np.count_nonzero(frame.free):
        return
    if (near := _with_near(frame, seen)) is not seen:
        T = _by_least_squares(frame, judged.T_world_object, near)
        # once more, of what is met there
        again = _with_near(frame, met_at(frame, Fit(T))[1])
        yield Start(_by_least_squares(frame, T, again))


def _by_least_squares(frame: Frame, T_world_object: Floats, seen: Matches) -> Floats:
    """The pose (4, 4) that is nearest to what another one meets."""
    J, offsets = seen.rows()
    rest = LinearResiduals(J.reshape(-1, 6), offsets.ravel())
    return perturb(T_world_object, least_squares(rest, free=frame.free)[0])


def _with_near(frame: Frame, seen: Matches) -> Matches:
    """What a pose meets, and what it nearly does: features missed by detections of none.

    Such a pair is within twice the reach of one that is met: what least squares leave out of as
    many coordinates as are twice those free is off twice as far.
    """
    reach = 2 * math.sqrt(2 * frame.rules.judgement.association.reach_squared)  # in σ_ε
    lost = (seen.weights > 0) & (seen.shares == 0) & (seen.neighbour_distance < reach)
    if not np.count_nonzero(lost):
        return seen
    shares, offsets = seen.shares.copy(), seen.offsets.copy()
    for k in np.flatnonzero(lost.any(axis=1)).tolist():
        if (points := frame.views[k].observation.points) is None:
            continue
        rest = np.setdiff1d(np.arange(len(points)), seen.detections[k])
        which, m = np.flatnonzero(lost[k]), points.shape[1]
        away = (points[rest] - seen.places[k, which, None, :m]) / seen.sigmas[k]
        distances = np.linalg.norm(away, axis=2)
        i, j = linear_sum_assignment(np.minimum(distances, reach))
        is_near = distances[i, j] < reach
        found = which[i[is_near]]
        shares[k, found] = seen.weights[k, found]
        offsets[k, found, :m] = away[i[is_near], j[is_near]]
    is_more = np.count_nonzero(shares) > np.count_nonzero(seen.shares)
    return replace(seen, shares=shares, offsets=offsets) if is_more else seen


def agreed(frame: Frame, likelihood: Likelihood, judged: ScoredPose) -> Iterable[Start]:
    """Where some of the detections that are met fix the pose, and others agree with them.

    Several that are cut, or another's, may pull a fit together, all a little off then; the rest
    agrees elsewhere.  Modes of the likelihood are sought by one step of least squares from each of
    many sets.
    """
    errors, used = frame.rules.judgement.noise.errors, judged.used
    # what is off is told by the noise of frames before
    if judged.proposer != predicted.__name__ or judged.left_out or not frame.track.believed:
        return
    variances = np.minimum(frame.variances, judged.variances)  # this frame's has what is off
    if judged.residual_ratio <= 1:
        off = errors.are_off(used, variances[:, None]) & (used.detections >= 0)
        if not np.count_nonzero(off):
            return
        noise = np.sqrt(variances)[:, None, None]
        J, r = used.J[..., frame.free] / noise[..., None], used.offsets / noise
        if not _carry(J[used.shares > 0], J[off], r[off], frame.rules.fit):
            return
    T = judged.T_world_object
    yield from _modes(frame, likelihood, T, used, variances)
    # what pulls a fit together may have pulled it away from where the pose was expected
    for one in frame.predictions[:1]:
        seen = met_at(frame, Fit(one.T_world_object))[1]
        if np.count_nonzero(seen.detections != used.detections):
            yield from _modes(frame, likelihood, T, _moved_to(used, seen), variances)


def _moved_to(used: Matches, seen: Matches) -> Matches:
    """What a pose meets of what another one is seen to meet by the same sensors."""
    shift = (seen.places - used.places) / used.sigmas[:, None, None]
    shares = np.where(used.weights > 0, seen.shares, 0.0)
    return replace(seen, shares=shares, places=used.places, offsets=seen.offsets + shift, J=used.J)


def _modes(
    frame: Frame, likelihood: Likelihood, T_world_object: Floats, seen: Matches, variances: Floats
) -> Iterator[Start]:
    """Modes of the likelihood by one step from a pose that meets this; noise of variances (L,)."""
    errors, rules, noise = frame.rules.judgement.noise.errors, frame.rules, np.sqrt(variances)
    is_met = (seen.shares > 0) & (seen.detections >= 0)
    by = is_met.nonzero()[0]
    J = seen.J[is_met][..., frame.free] / noise[by, None, None]
    r = seen.offsets[is_met] / noise[by, None]
    few = -(-J.shape[2] // int(seen.dimensions.min()))
    if (sets := _some_sets(len(r), few, rules.proposals.sets, frame.options.seed)) is None:
        return
    known = frame.predictions[0].uncertainty if frame.predictions else frame.start_uncertainty
    rows = J[sets].reshape(len(sets), -1, J.shape[2])
    information = rows.swapaxes(1, 2) @ rows + np.diag(known[frame.free] ** -2.0)
    twists = np.linalg.solve(information, rows.swapaxes(1, 2) @ r[sets].reshape(*rows.shape[:2], 1))
    twists = np.concatenate([np.zeros((1, J.shape[2])), twists[..., 0]])
    moved = np.einsum("nmk,sk->snm", J, twists)  # in deviations of the noise
    offsets = np.zeros((len(twists), *seen.offsets.shape))
    offsets[:, is_met] = (r - moved) * noise[by, None]
    others = replace(seen, offsets=offsets)
    likely = log_likelihood(errors.blur * noise, others, J.shape[2], errors)
    likely[_is_out_of_step(others, variances, errors).any(axis=1)] = -np.inf
    poses = perturb(T_world_object, twists @ np.eye(6)[frame.free])
    least, modes = float(likely.max()) + rules.acceptance.log_doubt, [0]
    for k in np.argsort(-likely, kind="stable").tolist():
        if not likely[k] > least or len(modes) > rules.proposals.kept:
            break
        apart = moved[modes] - moved[k]
        if np.vecdot(apart, apart).max(axis=1).min() > errors.outlying**2:
            modes.append(k)
            start = Start(poses[k], frame.close, blur=errors.blur * float(noise.max()))
            T, found = met_at(frame, fit := likelihood.fit(start))
            if not _is_out_of_step(found, frame.variances, errors).any():
                yield Start(T, matches=found, noise=fit.noise if found is fit.matches else None)


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


def _carry(met: Floats, J: Floats, offsets: Floats, rules: FitRules) -> bool:
    """Whether what is off carries any of what is met away, by a part of the noise that matters.

    By Jacobians (M, m, k) of all that is met, and of what is off with its offsets, in deviations of
    the noise.  It does so by least squares at the most.  Where it does not, all modes are one.
    """
    rows = met.reshape(-1, met.shape[-1])
    pull = np.einsum("nmk,nm->k", J, offsets)
    moved = (rows @ (inverted(rows.T @ rows) @ pull)).reshape(met.shape[:2])
    return bool(np.vecdot(moved, moved).max() > rules.moved**2)


REFINEMENTS: tuple[Refinement, ...] = (without_sensor, merged_pair, all_near, agreed)
