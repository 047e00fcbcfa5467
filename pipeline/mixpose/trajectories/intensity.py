"""Fit the motion model of a body to a recording of its poses, by maximum likelihood.

The likelihood of a model is that of the innovations of a Kalman filter (F. Schweppe, 1965); models
that are compared are filtered at once.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import minimize_scalar

from mixpose.constants import constant
from mixpose.records import Floats, Indices
from mixpose.trajectories.motion import ORDERS, predicted, updated
from mixpose.trajectories.track import (
    MotionModel,
    SmoothedTrack,
    Track,
    initial_states,
    noise_of,
    smooth_track,
    white_parts,
)


@dataclass(frozen=True)
class SmoothingRules:
    """Rules of a smoother."""

    frames: int = constant(
        300, "poses to which the motion is fitted, from the whole recording: intensity to 10 %"
    )
    block: int = constant(100, "successive poses among these: the first few fix the rates")
    fewest: int = constant(8, "poses to fit a motion; with fewer none is smoothed")
    surely: float = constant(
        10.83, "twice the gain in log likelihood, χ² of 99.9 %, by which errors are not all white"
    )
    off: float = constant(
        0.2, "least size of the log of the white share: sudden motion alone makes it 0.9 to 1.05"
    )
    shares: tuple[float, float] = constant(
        (-2.0, 2.0), "range of that logarithm: 4 deviations of `believed`"
    )
    tail: float = constant(
        3.0,
        "degrees of freedom of the noise of motion: at corners of a path squared errors are 1.0 "
        "times those of the covariances, 4 times with a constant intensity; with 1 degree a "
        "hand at rest counts as still as it looks, with errors of up to 1.7 times",
    )
    passes: int = constant(60, "most passes to fit the noise of each step; 40 suffice")
    ahead: float = constant(
        1.5, "factor on these changes, which all have one sign: it saves a third of the passes"
    )
    settled: float = constant(0.1, "change of the logarithm of a scale that ends the passes")
    foreign: float = constant(
        1e-9, "chance of a pose as far off its neighbours that is then taken for wrong"
    )
    believed: float = constant(
        0.5, "deviation of the log of the factor by which covariances are off: 0.6 to 1.6 times"
    )
    wrong: float = constant(1e-3, "share of ok poses that are wrong: confidence is 0.999")
    reach: float = constant(3.0, "distance of a wrong pose, in usual steps")
    restarts: float = constant(20.0, "intervals without a pose after which a track begins anew")
    paths: int = constant(16, "sequences of choices among hypotheses that are kept")
    none: float = constant(
        22.5, "χ² of 6 at 99.9 %: a hypothesis farther off the track is not the body"
    )
    sure: float = constant(0.999, "probability of a hypothesis from which its frame is ok")


def fitted_model(
    track: Track, longest: float, rules: SmoothingRules, motion: str | None = None
) -> MotionModel | None:
    """Fit the likeliest model to a track, of the order of `motion`, or else of any of `ORDERS`.

    Times without a pose are left out, and steps between poses that are more than `longest` apart.
    Returns None if all parts between such gaps are too short.
    """
    blocks = _blocks(track, longest, rules)
    if not blocks:
        return None
    x, best = np.zeros(3), (-np.inf, 0, np.zeros(3))
    for name, order in ORDERS.items():
        x[2] = 0.0
        for width, points, along in _COARSE:
            x, log_likelihood = _searched_along(blocks, order, x, width, points, along, rules)
        if name == motion or (motion is None and log_likelihood > best[0]):
            best = (log_likelihood, order, x)
        elif motion is None:
            break
        if name == motion:
            break
        # with a derivative more the intensity is about e³ times less, in units of the poses
        x = x - 3.0
    likely, order, x_best = best
    if not np.isfinite(likely):
        raise OverflowError("no motion has a likelihood")
    for width, points in _FINE:
        x_best, _ = _searched_along(blocks, order, x_best, width, points, (*_SHARE, *_EACH), rules)
    intensities = _intensities(track, order, x_best[None, :2])[0]
    model = MotionModel(order, intensities, float(np.exp(x_best[2])))
    return replace(model, white=_white(blocks, model, rules))


def _white(blocks: Sequence[Track], model: MotionModel, rules: SmoothingRules) -> float:
    """Return the likeliest white share of covariances; 1 unless another is surely likelier."""
    count = max(rules.block // len(blocks), rules.fewest)
    blocks = [block.part(slice(count)) for block in blocks]
    logs = [np.zeros((len(block) - 1, 2)) for block in blocks]

    def unlikely(x: float) -> float:
        total = 0.5 * (x / rules.believed) ** 2
        for k, block in enumerate(blocks):
            candidate = replace(model, white=float(np.exp(x)))
            # with steady motion, jumps of a body that rests in between would count as noise
            _, block_logs, logs[k] = smooth_with_sudden_motion(block, candidate, rules, logs[k])
            total -= float(block_logs.sum())
        return total

    exactly = {"xatol": rules.off / 2}
    best = minimize_scalar(unlikely, bounds=rules.shares, method="bounded", options=exactly)
    # the noise of steps converges from share to share: compare with a share of 1 at the end only
    is_sure = abs(best.x) > rules.off and 2 * (unlikely(0.0) - best.fun) > rules.surely
    return float(np.exp(best.x)) if is_sure else 1.0


def smooth_with_sudden_motion(
    track: Track, model: MotionModel, rules: SmoothingRules, logs: Floats | None = None
) -> tuple[SmoothedTrack, Floats, Floats]:
    """Smooth a track, and fit the noise of each step: motion may be sudden.

    Also returns log likelihoods (N,) of poses by those before and the noise up to them, and the
    logarithms of the scales λ (N - 1, 2) of noise, which start at `logs`, or at 0.

    The variance of the noise of a step is inverse gamma, so that the noise has a t
    distribution.  d log p / d log λ = (bᵀQb − tr NQ) / 2 + ν (μ/λ − 1) / 2 = 0 gives the fixed
    point λ = (λ bᵀQb + ν μ) / (tr NQ + ν).  μ is the usual λ, 1 if all motion is usual; the
    model was fitted to sudden motion as well.  d log p / d log μ = 0 where the mean of μ/λ is 1.
    """
    logs = np.zeros((len(track) - 1, 2)) if logs is None else logs
    for _ in range(rules.passes):
        scales = np.exp(logs)
        step_noises = smooth_track(track, model, scales).step_noises
        squared = np.stack([step.squared for step in step_noises])
        degrees = np.stack([step.degrees for step in step_noises])
        energy = scales * squared + rules.tail * _usual_scales(logs)
        change = np.log(energy / (np.maximum(degrees, 0.0) + rules.tail)) - logs
        logs = logs + rules.ahead * change
        if np.abs(change).max(initial=0.0) < rules.settled:
            break
    result = smooth_track(track, model, np.exp(logs))
    share = _usual_scales(logs) / np.exp(logs)
    prior = 0.5 * rules.tail * (np.log(share) - share).sum(axis=1)
    return result, result.logs + np.append(0.0, prior), logs


def _usual_scales(logs: Floats) -> Floats:
    """Return the usual factors μ (2,)."""
    return np.asarray(1 / np.exp(-logs).mean(axis=0))


def _blocks(track: Track, longest: float, rules: SmoothingRules) -> list[Track]:
    """Return parts of a track without long gaps, evenly over it, to fit the motion to."""
    parts = _without_gaps(track.part(track.measured), longest, rules)
    kept = np.concatenate([np.zeros(0, int), *parts])
    track = track.part(track.measured).part(kept)
    if len(track) <= rules.frames:
        blocks = [track] if parts else []
    else:
        count = rules.frames // rules.block
        starts = np.linspace(0, len(track) - rules.block, count).astype(int)
        blocks = [track.part(slice(k, k + rules.block)) for k in starts.tolist()]
    return [block.part(part) for block in blocks for part in _without_gaps(block, longest, rules)]


def _without_gaps(track: Track, longest: float, rules: SmoothingRules) -> list[Indices]:
    """Return indices of the parts between long gaps that are long enough to fit a motion."""
    cuts = np.flatnonzero(np.diff(track.times) > longest) + 1
    parts = np.split(np.arange(len(track)), cuts)
    return [part for part in parts if len(part) >= rules.fewest]


def _intensities(track: Track, order: int, x: Floats) -> Floats:
    """Return intensities (G, 2) from their logarithms (G, 2) in units of variances of poses."""
    variances = np.median(np.diagonal(track.covariances, axis1=1, axis2=2), axis=0)
    free_variances = [variances[k : k + 3][track.free[k : k + 3]] for k in (0, 3)]
    kinds = np.array([of_kind.mean() if len(of_kind) else 1.0 for of_kind in free_variances])
    return np.asarray(kinds / track.interval ** (2 * order - 1) * np.exp(x))


# directions of a search, in turn: logarithms of both intensities, of each, and of the white share
_BOTH, _EACH, _SHARE = ((0, 1),), ((0,), (1,)), ((2,),)
# half-widths in logarithms, points and directions of searches; both intensities together at first,
# as with a single one far off all poses look like outliers
_COARSE = (
    (10.0, 9, _BOTH),
    (5.0, 5, _EACH),
    (2.0, 5, _EACH),
    (2.0, 9, _SHARE),
    (0.8, 5, (*_EACH, *_SHARE)),
)
_FINE = ((0.5, 5), (0.15, 3))


def _searched_along(
    blocks: list[Track],
    order: int,
    x: Floats,
    width: float,
    points: int,
    along: tuple[tuple[int, ...], ...],
    rules: SmoothingRules,
) -> tuple[Floats, float]:
    """Return the likeliest of points along each direction in turn, and its log likelihood."""
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
    """Return log likelihoods (G,) of poses after the first few, which fix rates of all orders."""
    white = white_parts(track, np.exp(x[:, 2]))
    noise = noise_of(track, _intensities(track, order, x[:, :2]))
    if_outlier = outlier_logs(track, white, rules)
    states = initial_states(track, order, white[0])
    steps = np.diff(track.times).tolist()
    total, was_outlier = np.zeros(len(x)), np.zeros(len(x), bool)
    for k, elapsed in enumerate(steps, 1):
        ahead, _ = predicted(states, elapsed, noise)
        states, _, log = updated(ahead, track.poses[k], white[k])
        if k < max(ORDERS.values()):
            continue
        # two successive outliers are no accident: the body went another way
        may_be_outlier = ~was_outlier
        was_outlier = may_be_outlier & (log < if_outlier[k])
        if was_outlier.any():
            states = states.mixed(ahead, was_outlier)
        total += np.where(may_be_outlier, np.logaddexp(log, if_outlier[k]), log)
    return np.asarray(total)


def outlier_logs(track: Track, white: Floats, rules: SmoothingRules) -> Floats:
    """Return log-likelihoods (N, G) of wrong poses, without −3 log 2π, by `white_parts`."""
    anywhere = np.diagonal(white, axis1=2, axis2=3) + (rules.reach * track.rms_motion) ** 2
    return np.asarray(np.log(rules.wrong) - 0.5 * np.log(anywhere).sum(axis=2))
