"""How a body moves, by maximum likelihood from a recording of it.

The likelihood of a model is that of the innovations of a Kalman filter (F. Schweppe, 1965), as many
models at once as are compared.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import minimize_scalar

from mixpose.constants import constant
from mixpose.records import Floats, Indices
from mixpose.trajectories.motion import ORDERS, foretold, updated
from mixpose.trajectories.track import (
    MotionModel,
    SmoothedTrack,
    Track,
    begun,
    noise_of,
    smooth_track,
    white_parts,
)


@dataclass(frozen=True)
class SmoothingRules:
    """What a smoother goes by."""

    frames: int = constant(
        300, "poses that tell how a body moves, from the whole recording: intensity to 10 %"
    )
    block: int = constant(100, "of them that follow each other: the first few tell rates")
    fewest: int = constant(8, "poses that tell a motion; of fewer none is smoothed")
    surely: float = constant(
        10.83, "twice the log likelihood, χ² of 99.9 %, by which a covariance is not all white"
    )
    off: float = constant(
        0.2, "logarithm of that share, at least: where it is 1 sudden motion puts it at 0.9 to 1.05"
    )
    shares: tuple[float, float] = constant(
        (-2.0, 2.0), "of that logarithm, among which is the right one: 4 deviations of `believed`"
    )
    tail: float = constant(
        3.0,
        "degrees of freedom of the noise of motion: at corners of a path squared errors are 1.0 "
        "times what covariances say, 4 times with one intensity throughout; with 1 it believes "
        "that a hand which rests is as still as it looks, and errs by up to 1.7 times",
    )
    passes: int = constant(60, "at most, over which sudden motion is told from steady; 40 do")
    ahead: float = constant(
        1.5, "times each of these changes, which are all one way: two thirds of the passes"
    )
    settled: float = constant(0.1, "change of the logarithm of a scale in the last of these")
    foreign: float = constant(
        1e-9, "chance of a pose as far off those around it: it is taken for a wrong one"
    )
    believed: float = constant(
        0.5, "logarithm of the factor by which covariances are off: 0.6 to 1.6 times, as a rule"
    )
    wrong: float = constant(1e-3, "of poses that are ok are wrong: confidence is 0.999")
    reach: float = constant(3.0, "times the usual step, where a wrong pose is found")
    restarts: float = constant(20.0, "intervals without a pose, after which a track begins anew")
    paths: int = constant(16, "choices among hypotheses that are followed side by side")
    none: float = constant(
        22.5, "χ² of 6 at 99.9 %: a hypothesis farther off the track is none of the body"
    )
    sure: float = constant(0.999, "probability of a hypothesis from which its frame is ok")


def fitted_model(
    track: Track, longest: float, rules: SmoothingRules, motion: str | None = None
) -> MotionModel | None:
    """The model of which a track is likeliest, among all `ORDERS` where no motion is asked for.

    Times without a pose are left out. What a body did between poses that are more than `longest`
    apart tells nothing. None where all parts between such gaps are too short.
    """
    blocks = _blocks(track, longest, rules)
    if not blocks:
        return None
    x, best = np.zeros(3), (-np.inf, 0, np.zeros(3))
    for name, order in ORDERS.items():
        x[2] = 0.0
        for width, points, along in _COARSE:
            x, log_likelihood = _along(blocks, order, x, width, points, along, rules)
        if name == motion or (motion is None and log_likelihood > best[0]):
            best = (log_likelihood, order, x)
        elif motion is None:
            break
        if name == motion:
            break
        # a derivative more takes e³ times less noise, about, in units of the poses'
        x = x - 3.0
    likely, order, shared = best
    if not np.isfinite(likely):
        raise OverflowError("no motion has a likelihood")
    for width, points in _FINE:
        shared, _ = _along(blocks, order, shared, width, points, (*_SHARE, *_EACH), rules)
    intensities = _intensities(track, order, shared[None, :2])[0]
    model = MotionModel(order, intensities, float(np.exp(shared[2])))
    return replace(model, white=_white(blocks, model, rules))


def _white(blocks: Sequence[Track], model: MotionModel, rules: SmoothingRules) -> float:
    """The white share of covariances of which poses are likeliest; 1 unless surely not."""
    most = max(rules.block // len(blocks), rules.fewest)
    blocks = [one.part(slice(most)) for one in blocks]
    logs = [np.zeros((len(one) - 1, 2)) for one in blocks]

    def unlikely(x: float) -> float:
        total = 0.5 * (x / rules.believed) ** 2
        for k, one in enumerate(blocks):
            at = replace(model, white=float(np.exp(x)))
            # steady motion would take the jumps of a body that rests in between for noise
            _, each, logs[k] = smooth_with_sudden_motion(one, at, rules, logs[k])
            total -= float(each.sum())
        return total

    best = minimize_scalar(
        unlikely, bounds=rules.shares, method="bounded", options={"xatol": rules.off / 2}
    )
    # noise settles from share to share, so that what was tried first looks worse than it is
    is_sure = abs(best.x) > rules.off and 2 * (unlikely(0.0) - best.fun) > rules.surely
    return float(np.exp(best.x)) if is_sure else 1.0


def smooth_with_sudden_motion(
    track: Track, model: MotionModel, rules: SmoothingRules, logs: Floats | None = None
) -> tuple[SmoothedTrack, Floats, Floats]:
    """Smooth a track with as much noise between each two times as there was.

    And the logarithm (N,) of how likely each pose is, by those before and the noise up to it, and
    those of λ (N - 1, 2), which begin at `logs`, or at 0.

    Noise of each passage has an inverse gamma variance, so that all in all it has the t
    distribution.  d log p / d log λ = (bᵀQb − tr NQ) / 2 + ν (μ/λ − 1) / 2 = 0 gives the fixed
    point λ = (λ bᵀQb + ν μ) / (tr NQ + ν).  μ is what is usual, 1 where all of the motion is; the
    model was fitted to sudden motion as well.  d log p / d log μ = 0 where the mean of μ/λ is 1.
    """
    logs = np.zeros((len(track) - 1, 2)) if logs is None else logs
    for _ in range(rules.passes):
        change = _fixed_point(track, model, logs, rules) - logs
        logs = logs + rules.ahead * change
        if np.abs(change).max(initial=0.0) < rules.settled:
            break
    result = smooth_track(track, model, np.exp(logs))
    share = _usual(logs) / np.exp(logs)
    prior = 0.5 * rules.tail * (np.log(share) - share).sum(axis=1)
    return result, result.logs + np.append(0.0, prior), logs


def _fixed_point(track: Track, model: MotionModel, logs: Floats, rules: SmoothingRules) -> Floats:
    """The next logarithms of λ (N - 1, 2)."""
    scales = np.exp(logs)
    passages = smooth_track(track, model, scales).passages
    squared = np.stack([each.squared for each in passages])
    degrees = np.stack([each.degrees for each in passages])
    energy = scales * squared + rules.tail * _usual(logs)
    return np.asarray(np.log(energy / (np.maximum(degrees, 0.0) + rules.tail)))


def _usual(logs: Floats) -> Floats:
    """Factors μ (2,) that are usual."""
    return np.asarray(1 / np.exp(-logs).mean(axis=0))


def _blocks(track: Track, longest: float, rules: SmoothingRules) -> list[Track]:
    """Parts of a track, evenly over it and without a long gap, that tell how the body moves."""
    parts = _without_gaps(track.part(track.measured), longest, rules)
    places = np.concatenate([np.zeros(0, int), *parts])
    track = track.part(track.measured).part(places)
    if len(track) <= rules.frames:
        chosen = [track] if parts else []
    else:
        count = rules.frames // rules.block
        starts = np.linspace(0, len(track) - rules.block, count).astype(int)
        chosen = [track.part(slice(k, k + rules.block)) for k in starts.tolist()]
    return [one.part(own) for one in chosen for own in _without_gaps(one, longest, rules)]


def _without_gaps(track: Track, longest: float, rules: SmoothingRules) -> list[Indices]:
    """Places in a track between its long gaps, where they are enough to tell a motion."""
    cuts = np.flatnonzero(np.diff(track.times) > longest) + 1
    parts = np.split(np.arange(len(track)), cuts)
    return [part for part in parts if len(part) >= rules.fewest]


def _intensities(track: Track, order: int, x: Floats) -> Floats:
    """Intensities (G, 2) of their logarithms (G, 2) in units of variances of poses."""
    variances = np.median(np.diagonal(track.covariances, axis1=1, axis2=2), axis=0)
    own = [variances[k : k + 3][track.free[k : k + 3]] for k in (0, 3)]
    kinds = np.array([each.mean() if len(each) else 1.0 for each in own])
    return np.asarray(kinds / track.interval ** (2 * order - 1) * np.exp(x))


# what is searched along, one after the other: logarithms of intensities, and of the share
_BOTH, _EACH, _SHARE = ((0, 1),), ((0,), (1,)), ((2,),)
# half-widths of a search in logarithms, and points in it; both kinds of motion at first, as with
# one of them far off all poses look wrong
_COARSE = (
    (10.0, 9, _BOTH),
    (5.0, 5, _EACH),
    (2.0, 5, _EACH),
    (2.0, 9, _SHARE),
    (0.8, 5, (*_EACH, *_SHARE)),
)
_FINE = ((0.5, 5), (0.15, 3))


def _along(
    blocks: list[Track],
    order: int,
    x: Floats,
    width: float,
    points: int,
    along: tuple[tuple[int, ...], ...],
    rules: SmoothingRules,
) -> tuple[Floats, float]:
    """The likeliest of points along each direction in turn."""
    best = -np.inf
    for directions in along:
        tried = np.repeat(x[None], points, axis=0)
        tried[:, directions] += np.linspace(-width, width, points)[:, None]
        logs = sum(_log_likelihoods(block, order, tried, rules) for block in blocks)
        logs = logs - 0.5 * (tried[:, 2] / rules.believed) ** 2
        k = int(np.argmax(logs))
        x, best = tried[k], float(np.asarray(logs)[k])
    return x, best


def _log_likelihoods(track: Track, order: int, x: Floats, rules: SmoothingRules) -> Floats:
    """(G,), of poses of a track after the first few, which tell the rates of all orders."""
    own = white_parts(track, np.exp(x[:, 2]))
    noise = noise_of(track, _intensities(track, order, x[:, :2]))
    logs_wrong = logs_of_wrong(track, own, rules)
    states = begun(track, order, own[0])
    steps = np.diff(track.times).tolist()
    total, was_wrong = np.zeros(len(x)), np.zeros(len(x), bool)
    for k, elapsed in enumerate(steps, 1):
        ahead, _ = foretold(states, elapsed, noise)
        states, _, log = updated(ahead, track.poses[k], own[k])
        if k < max(ORDERS.values()):
            continue
        # two that follow each other are no accident: the body went another way
        may_be_wrong = ~was_wrong
        was_wrong = may_be_wrong & (log < logs_wrong[k])
        if was_wrong.any():
            states = states.mixed(ahead, was_wrong)
        total += np.where(may_be_wrong, np.logaddexp(log, logs_wrong[k]), log)
    return np.asarray(total)


def logs_of_wrong(track: Track, own: Floats, rules: SmoothingRules) -> Floats:
    """Log-likelihoods (N, G), without −3 log 2π, of wrong poses, by `white_parts` (N, G, 6, 6)."""
    anywhere = np.diagonal(own, axis1=2, axis2=3) + (rules.reach * track.moved) ** 2
    return np.asarray(np.log(rules.wrong) - 0.5 * np.log(anywhere).sum(axis=2))
