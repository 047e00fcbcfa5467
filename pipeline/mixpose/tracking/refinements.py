"""Refine judged poses: without a sensor, with merged features, where most detections agree.

A refinement yields starts that may do better than a judged pose, and tests itself if it applies.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from itertools import combinations
from typing import TypeAlias

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.special import fdtri

from mixpose.fit import Fit, FitRules
from mixpose.judgement import AcceptanceRules, NoiseModel, ScoredPose, inverted
from mixpose.matching import LEAST_VARIANCE, ErrorRules, Matches, log_likelihood, welsch
from mixpose.optimise import LinearResiduals, least_squares
from mixpose.records import Floats, Indices, Mask, replace
from mixpose.rigid import perturb
from mixpose.tracking.frame import Frame, Start
from mixpose.tracking.likelihood import Likelihood, met_at
from mixpose.tracking.proposers import predicted

Refinement: TypeAlias = Callable[[Frame, Likelihood, ScoredPose], Iterable[Start]]

OUT_OF_STEP = "out of step or bumped"
BY_CHANCE = "it meets little of the body, as by chance"


def without_sensor(frame: Frame, likelihood: Likelihood, judged: ScoredPose) -> Iterable[Start]:
    """Yield the pose without sensors that disagree with others or meet the body by chance."""
    if len(frame.views) < 2 or judged.left_out:
        return
    rules, matches = frame.rules.acceptance, judged.matches
    if apart := disagreeing(matches, rules, frame.rules.judgement.noise):
        left_out = dict.fromkeys(apart, OUT_OF_STEP)
    else:
        left_out = dict.fromkeys(by_chance(matches, rules), BY_CHANCE)
    if left_out:
        yield Start(judged.T_world_object, frame.close_uncertainty, left_out=left_out)


def by_chance(matches: Matches, rules: AcceptanceRules) -> list[str]:
    """Return sensors that meet little of a body that another one meets, with unmatched detections.

    They may be covered or out of step; a pose that others leave open bends to their detections.
    """
    coverage = matches.covered
    spare = matches.summed(matches.count) > matches.summed(matches.met)
    little = (coverage > 0) & (coverage < rules.agreeing) & spare
    names = [matches.names[k] for k in np.flatnonzero(little[matches.owner])]
    return names if np.count_nonzero(coverage >= rules.agreeing) else []


def disagreeing(matches: Matches, rules: AcceptanceRules, model: NoiseModel) -> list[str]:
    """Return sensors that see the body elsewhere than two or more others do.

    They meet little of it beside as many unmatched detections, or residuals are too large for
    chance.
    """
    summed = matches.summed
    agreeing = matches.covered >= rules.agreeing
    apart = ~agreeing & (summed(matches.expected) > 0)
    apart &= summed(matches.unmatched_nearby) >= rules.agreeing * summed(matches.missed)
    squares, degrees = summed(matches.squares) * agreeing, summed(matches.measurements) * agreeing
    if np.count_nonzero(agreeing) > 2:
        other_degrees = degrees.sum() - degrees
        variances = (squares.sum() - squares) / np.maximum(other_degrees, 1e-12)
        # NaN without degrees of freedom: nothing is larger
        limits = np.maximum(rules.disagreeing, fdtri(degrees, other_degrees, model.by_chance))
        apart |= squares > degrees * limits * np.maximum(variances, LEAST_VARIANCE)
    names = [matches.names[k] for k in np.flatnonzero(apart[matches.owner])]
    return names if np.count_nonzero(agreeing & ~apart) >= 2 else []


def merged_pair(frame: Frame, likelihood: Likelihood, judged: ScoredPose) -> Iterable[Start]:
    """Yield least-squares poses that put the middle of two features at one merged detection.

    First with the nearest pair in each sensor, then with all possible ones.
    """
    rules, before = frame.rules.judgement.association, 0
    for most in (1, len(frame.body)):
        paired, is_far = _paired(judged.matches, rules.reach_squared, rules.middle, most)
        if (pairs := int(paired.merged.sum())) == before:
            return
        before = pairs
        # distant pairs, within the width of their spot, pull either from there or not at all
        for widest in (0.0, 1.0) if is_far else (0.0,):
            if (T := _with_pairs(frame, judged.T_world_object, paired, widest)) is not None:
                yield Start(T)


def _with_pairs(
    frame: Frame, T_world_object: Floats, paired: Matches, widest: float
) -> Floats | None:
    """Return the pose (4, 4) after two least-squares steps, the first at least at blur `widest`."""
    T, matches = T_world_object, paired
    narrow = frame.rules.judgement.noise.errors.blur * np.sqrt(frame.variances)
    for least in (widest, 0.0):  # the first ends within 0.01 σ_ε of the optimum
        if T is not T_world_object:
            T, matches = met_at(frame, Fit(T))
        if not np.count_nonzero(matches.merged):
            break
        weights = welsch(matches.squared, np.maximum(narrow, least))
        T = _by_least_squares(frame, T, replace(matches, shares=matches.shares * weights))
    return None if T is T_world_object else T


def _paired(seen: Matches, reach: float, middle: float, most: int) -> tuple[Matches, bool]:
    """Pair missed features with nearby features whose detection is their own.

    Nearest first, at most `most` per sensor.  `reach` is the largest squared distance in variances
    of C, of detections without a size.  Also return whether any pair is farther off.
    """
    if not np.count_nonzero(seen.missed):
        return seen, False
    shares, offsets, J = seen.shares.copy(), seen.offsets.copy(), seen.J.copy()
    merged, extra, is_far = seen.merged.copy(), seen.extra.copy(), False
    for k in np.flatnonzero((seen.missed > 0) & (seen.met > 0)):
        detections = seen.detections[k]
        counts = (detections[:, None] == detections).sum(axis=1)
        met = np.flatnonzero((detections >= 0) & (counts == 1))
        lost = np.flatnonzero((seen.weights[k] > 0) & (shares[k] == 0))
        gaps = (seen.places[k, met] - seen.places[k, lost, None]) / seen.sigmas[k] + offsets[k, met]
        squared = (gaps * gaps).sum(axis=2) / 2
        # centres of two touching disks are √2 times as far apart as the radius of their joint area
        squared[squared > np.maximum(reach, (seen.radii[k, met] / seen.sigmas[k]) ** 2)] = np.inf
        for _ in range(most):
            if squared.min(initial=np.inf) == np.inf:
                break
            i, j = np.unravel_index(int(squared.argmin()), squared.shape)
            is_far |= bool(squared[i, j] > reach)
            pair = [lost[i], met[j]]
            shares[k, pair] = shares[k, met[j]] / 2
            offsets[k, pair] = (gaps[i, j] + offsets[k, met[j]]) / 2
            J[k, pair] = J[k, pair].mean(axis=0)
            merged[k], extra[k, pair] = merged[k] + 1, middle**2
            squared[i], squared[:, j] = np.inf, np.inf
    return replace(seen, shares=shares, offsets=offsets, J=J, merged=merged, extra=extra), is_far


def all_near(frame: Frame, likelihood: Likelihood, judged: ScoredPose) -> Iterable[Start]:
    """Yield the least-squares pose with detections near missed features: all errors may be larger.

    A fit that met most features to less than noise stays there, and leaves the others out.
    """
    matches = judged.matches
    if judged.left_out or matches.measurements.sum() <= np.count_nonzero(frame.free):
        return
    if (near := _with_near(frame, matches)) is not matches:
        T = _by_least_squares(frame, judged.T_world_object, near)
        # again with the detections met there
        again = _with_near(frame, met_at(frame, Fit(T))[1])
        yield Start(_by_least_squares(frame, T, again))


def _by_least_squares(frame: Frame, T_world_object: Floats, matches: Matches) -> Floats:
    """Return the pose (4, 4) nearest in least squares to the matches at another pose."""
    J, offsets = matches.rows()
    residuals = LinearResiduals(J.reshape(-1, 6), offsets.ravel())
    return perturb(T_world_object, least_squares(residuals, free=frame.free)[0])


def _with_near(frame: Frame, matches: Matches) -> Matches:
    """Return matches extended by pairs of missed features and unmatched detections.

    Such a pair is within twice the reach of a match: with twice as many coordinates as free
    directions a match that least squares leave out is off twice as far.
    """
    reach = 2 * math.sqrt(2 * frame.rules.judgement.association.reach_squared)  # in σ_ε
    lost = (matches.weights > 0) & (matches.shares == 0) & (matches.neighbour_distance < reach)
    if not np.count_nonzero(lost):
        return matches
    shares, offsets = matches.shares.copy(), matches.offsets.copy()
    for k in np.flatnonzero(lost.any(axis=1)).tolist():
        if (points := frame.views[k].observation.points) is None:
            continue
        unmatched = np.setdiff1d(np.arange(len(points)), matches.detections[k])
        missed, m = np.flatnonzero(lost[k]), points.shape[1]
        offsets_to = (points[unmatched] - matches.places[k, missed, None, :m]) / matches.sigmas[k]
        distances = np.linalg.norm(offsets_to, axis=2)
        i, j = linear_sum_assignment(np.minimum(distances, reach))
        is_near = distances[i, j] < reach
        chosen = missed[i[is_near]]
        shares[k, chosen] = matches.weights[k, chosen]
        offsets[k, chosen, :m] = offsets_to[i[is_near], j[is_near]]
    is_more = np.count_nonzero(shares) > np.count_nonzero(matches.shares)
    return replace(matches, shares=shares, offsets=offsets) if is_more else matches


def agreed(frame: Frame, likelihood: Likelihood, judged: ScoredPose) -> Iterable[Start]:
    """Yield poses fixed by some of the met detections with which the other ones agree.

    Several detections that are cut, or another body's, may pull a fit so that all are a little off,
    while most agree elsewhere.  Modes are sought by one least-squares step from each of many sets.
    """
    errors, used = frame.rules.judgement.noise.errors, judged.used
    # the noise of earlier frames tells which detections are off: the frame's own includes them
    if judged.proposer != predicted.__name__ or judged.left_out or not frame.track.ok_count:
        return
    variances = np.minimum(frame.variances, judged.variances)
    if judged.residual_ratio <= 1:
        off = errors.are_off(used, variances[:, None]) & (used.detections >= 0)
        if not np.count_nonzero(off):
            return
        noise = np.sqrt(variances)[:, None, None]
        J, r = used.J[..., frame.free] / noise[..., None], used.offsets / noise
        if not _has_leverage(J[used.shares > 0], J[off], r[off], frame.rules.fit):
            return
    T = judged.T_world_object
    yield from _modes(frame, likelihood, T, used, variances)
    # such detections may have pulled the fit away from the predicted pose
    for prediction in frame.predictions[:1]:
        seen = met_at(frame, Fit(prediction.T_world_object))[1]
        if np.count_nonzero(seen.detections != used.detections):
            yield from _modes(frame, likelihood, T, _moved_to(used, seen), variances)


def _moved_to(used: Matches, matches: Matches) -> Matches:
    """Return the matches seen at another pose as matches of the judged pose, with its sensors."""
    shift = (matches.places - used.places) / used.sigmas[:, None, None]
    shares = np.where(used.weights > 0, matches.shares, 0.0)
    offsets = matches.offsets + shift
    return replace(matches, shares=shares, places=used.places, offsets=offsets, J=used.J)


def _modes(
    frame: Frame, likelihood: Likelihood, T_world_object: Floats, seen: Matches, variances: Floats
) -> Iterator[Start]:
    """Yield modes of the likelihood by one step from a pose with these matches; noise (L,)."""
    errors, rules, noise = frame.rules.judgement.noise.errors, frame.rules, np.sqrt(variances)
    is_met = (seen.shares > 0) & (seen.detections >= 0)
    sensors = is_met.nonzero()[0]
    J = seen.J[is_met][..., frame.free] / noise[sensors, None, None]
    r = seen.offsets[is_met] / noise[sensors, None]
    size = -(-J.shape[2] // int(seen.dimensions.min()))
    if (sets := _some_sets(len(r), size, rules.proposals.sets, frame.options.seed)) is None:
        return
    known = frame.predictions[0].uncertainty if frame.predictions else frame.start_uncertainty
    rows = J[sets].reshape(len(sets), -1, J.shape[2])
    information = rows.swapaxes(1, 2) @ rows + np.diag(known[frame.free] ** -2.0)
    twists = np.linalg.solve(information, rows.swapaxes(1, 2) @ r[sets].reshape(*rows.shape[:2], 1))
    twists = np.concatenate([np.zeros((1, J.shape[2])), twists[..., 0]])
    moved = np.einsum("nmk,sk->snm", J, twists)  # in deviations of the noise
    offsets = np.zeros((len(twists), *seen.offsets.shape))
    offsets[:, is_met] = (r - moved) * noise[sensors, None]
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
            start = Start(poses[k], frame.close_uncertainty, blur=errors.blur * float(noise.max()))
            T, matches = met_at(frame, fit := likelihood.fit(start))
            if not _is_out_of_step(matches, frame.variances, errors).any():
                yield Start(T, matches=matches, noise=fit.noise if matches is fit.matches else None)


def _is_out_of_step(matches: Matches, variances: Floats, errors: ErrorRules) -> Mask:
    """Test for each sensor (..., L) whether most matches are off: other poses do not help there."""
    off = errors.are_off(matches, variances[:, None] + matches.extra).sum(axis=-1)
    return np.asarray(2 * off > np.count_nonzero(matches.shares, axis=-1))


def _some_sets(count: int, size: int, most: int, seed: int) -> Indices | None:
    """Return sets (S, size) of numbers below a count: all, or some at random; None for too few."""
    if count <= size:
        return None
    if math.comb(count, size) <= most:
        return np.array([*combinations(range(count), size)])
    return np.random.default_rng(seed).random((most, count)).argsort(axis=1)[:, :size]


def _has_leverage(met: Floats, J: Floats, offsets: Floats, rules: FitRules) -> bool:
    """Test whether detections that are off move any met feature by a relevant share of the noise.

    Least squares by Jacobians (M, m, k) of all met features, and of those that are off with their
    offsets, in deviations of the noise.  If they do not, all modes are one.
    """
    rows = met.reshape(-1, met.shape[-1])
    pull = np.einsum("nmk,nm->k", J, offsets)
    moved = (rows @ (inverted(rows.T @ rows) @ pull)).reshape(met.shape[:2])
    return bool(np.vecdot(moved, moved).max() > rules.moved**2)


REFINEMENTS: tuple[Refinement, ...] = (without_sensor, merged_pair, all_near, agreed)
