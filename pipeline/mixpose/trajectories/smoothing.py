"""Smooth the poses of a body, each by all frames: fixed-interval smoothing.

Errors of different frames are taken for independent if poses scatter about a smooth path as much as
their covariances say.  If they surely scatter less, the share that does not show is taken for an
error that persists, of a calibration or a marker: smoothing cannot reduce it, and it stays in the
covariance.  If they scatter more, covariances are enlarged.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from scipy.special import chdtri

from mixpose import rigid
from mixpose.errors import RecordingError
from mixpose.poses.poseline import PoseLine
from mixpose.records import Estimate, Floats, Hypothesis
from mixpose.trajectories import track as tracks
from mixpose.trajectories.choices import Alternatives, Choice, choices, unwrapped
from mixpose.trajectories.intensity import (
    SmoothingRules,
    fitted_model,
    outlier_logs,
    smooth_with_sudden_motion,
)

_ROUNDED_S = 1e-6  # rounding of differences of times, which may be since 1970
_ROUNDS = 3  # rounds that leave out poses: a wrong pose may hide another


@dataclass(frozen=True)
class SmoothedBody:
    """Smoothed poses of a body."""

    estimates: tuple[Estimate, ...]  # of all lines and filled frames, by frame
    model: tracks.MotionModel | None  # None if there were too few poses
    smoothed: int  # number of poses
    filled: int  # number of frames that had no pose
    decided: int  # number of ambiguous frames that are ok now
    refused: tuple[int, ...]  # frames whose poses were ok, but lie far off their neighbours
    timed: bool  # whether times of the model are seconds; else numbers of frames


@dataclass(frozen=True)
class _Segment:
    """Lines without a long gap, None for frames to be filled, and their track."""

    lines: tuple[PoseLine | None, ...]
    frames: tuple[int, ...]
    track: tracks.Track


def smooth_body(
    lines: Sequence[PoseLine],
    symmetries: Floats | None = None,
    *,
    fill_s: float = 0.0,
    motion: str | None = None,
    rules: SmoothingRules = SmoothingRules(),
) -> SmoothedBody:
    """Smooth the poses of one body, a line per frame.

    Poses that look the same by the body's symmetries (n, 4, 4) are exchangeable. Gaps of at most
    `fill_s` seconds from pose to pose are filled. `motion` is a key of `motion.ORDERS`; else the
    likeliest is taken. Raises RecordingError if a frame stands twice, a pose has no covariance, or
    gaps are to be filled and there are no times.
    """
    ordered = sorted(lines, key=lambda line: line.frame)
    times = _times(ordered)
    if fill_s and times is None:
        raise RecordingError(
            "--fill: found poses without times, or whose times do not ascend; allowed: poses of a "
            "recording with times: add fps or times to the sensors of its session"
        )
    t = np.array([line.frame for line in ordered], float) if times is None else times
    ordered = unwrapped(ordered, symmetries)
    posed = [k for k, line in enumerate(ordered) if line.T_world_object is not None]
    tracks.require_covariances([ordered[k] for k in posed])
    sure = [k for k in posed if ordered[k].status == "ok"]
    used = sure if len(sure) >= rules.fewest else posed
    if len(used) < rules.fewest:
        return SmoothedBody(tuple(ordered), None, 0, 0, 0, (), times is not None)
    longest = rules.restarts * float(np.median(np.diff(t[posed])))
    with _checked_numbers(lines[0].label) as smoothed:
        model = fitted_model(_track([ordered[k] for k in used], t[used]), longest, rules, motion)
        for segment in _segments(ordered, t, posed, max(longest, fill_s), fill_s):
            if model is not None:
                smoothed.update(_smoothed(segment, model, rules))
    replaced = [ordered[k] for k in posed if ordered[k].frame in smoothed]
    changed = [line for line in replaced if smoothed[line.frame].status != line.status]
    refused = tuple(line.frame for line in changed if line.status == "ok")
    results = {line.frame: line for line in ordered} | smoothed
    return SmoothedBody(
        estimates=tuple(results[frame] for frame in sorted(results)),
        model=model,
        smoothed=len(replaced),
        filled=len(smoothed) - len(replaced),
        decided=len(changed) - len(refused),
        refused=refused,
        timed=times is not None,
    )


@contextmanager
def _checked_numbers(label: str) -> Iterator[dict[int, Estimate]]:
    """Collect estimates by frame within; raise RecordingError if numbers are out of range."""
    estimates: dict[int, Estimate] = {}
    try:
        with np.errstate(all="ignore"):
            yield estimates
        are_finite = all(
            np.isfinite(values).all()
            for estimate in estimates.values()
            for values in (estimate.T_world_object, estimate.covariance)
            if values is not None
        )
    except (np.linalg.LinAlgError, OverflowError, ZeroDivisionError):
        are_finite = False
    if not are_finite:
        raise RecordingError(
            f"poses of {label!r} cannot be smoothed: covariances or times are too large or too "
            "small beside each other; allowed: poses as mixpose run writes them"
        )


def _times(lines: Sequence[PoseLine]) -> Floats | None:
    """Return the times of all lines; None if any is missing, or they do not ascend."""
    tracks.require_frames_once(lines)
    seconds = [line.time_s for line in lines if line.time_s is not None]
    times = np.array(seconds, dtype=np.float64)
    return times if len(seconds) == len(lines) and (np.diff(times) > 0).all() else None


def _track(lines: Sequence[PoseLine], times: Floats) -> tracks.Track:
    poses = np.stack([line.T_world_object for line in lines if line.T_world_object is not None])
    covariances = np.stack([line.covariance for line in lines if line.covariance is not None])
    return tracks.track_of(times, poses, covariances, np.ones(len(lines), bool))


def _segments(
    lines: Sequence[PoseLine], times: Floats, posed: Sequence[int], longest: float, fill_s: float
) -> list[_Segment]:
    """Cut lines with poses at long gaps, and add the frames to be filled in between."""
    step = int(np.median(np.diff([lines[k].frame for k in posed])))
    cuts = np.flatnonzero(np.diff(times[posed]) > longest + _ROUNDED_S) + 1
    segments = []
    for part in np.split(np.array(posed), cuts):
        # line, or None of a filled frame; the line before; frame and time
        rows: list[tuple[PoseLine | None, PoseLine, int, float]] = []
        for last, k in pairwise([0, *part.tolist()]):  # the first has no line before it
            line = lines[k]
            if rows and times[k] - times[last] <= fill_s + _ROUNDED_S:
                gap, first = lines[last : k + 1], lines[last].frame
                between = _between(first, line.frame, step, [other.frame for other in gap[1:-1]])
                # frame numbers may be too large for integers of NumPy
                since = np.array([other.frame - first for other in gap], dtype=np.float64)
                moments = np.interp([n - first for n in between], since, times[last : k + 1])
                rows += [(None, lines[last], n, t) for n, t in zip(between, moments.tolist())]
            rows.append((line, line, line.frame, float(times[k])))
        segment_lines, posed_lines, frames, seconds = zip(*rows, strict=True)
        measured = np.array([other is not None for other in segment_lines])
        track = replace(_track(posed_lines, np.array(seconds)), measured=measured)
        segments.append(_Segment(segment_lines, frames, track))
    return segments


def _between(before: int, after: int, step: int, lost: Sequence[int]) -> list[int]:
    """Return frames between two: those without a pose, and others evenly at the usual step."""
    span = after - before
    count = max(round(span / max(step, 1)) - 1, 0)
    even = [before + span * k // (count + 1) for k in range(1, count + 1)]
    return sorted([*lost, *(n for n in even if all(2 * abs(n - other) >= step for other in lost))])


def _smoothed(
    segment: _Segment, model: tracks.MotionModel, rules: SmoothingRules
) -> dict[int, Estimate]:
    """Return the smoothed estimates of a segment by frame."""
    chosen = _chosen(segment, model, rules)
    poses = segment.track.poses.copy()
    measured = segment.track.measured.copy()
    for k, decision in chosen.items():
        measured[k] = decision.pose is not None
        if decision.pose is not None:
            poses[k] = decision.pose
    track = replace(segment.track, poses=poses, measured=measured)
    with_pose = np.flatnonzero(measured)
    if len(with_pose) < 2:
        return {}
    first, last = int(with_pose[0]), int(with_pose[-1]) + 1
    lines, frames = segment.lines[first:last], segment.frames[first:last]
    track, result = _without_outliers(track.part(slice(first, last)), model, rules)
    persistent = max(0.0, 1.0 - model.white) * tracks.without_held(track.covariances, track.free)
    estimates = {}
    for k, (line, frame) in enumerate(zip(lines, frames, strict=True)):
        T, covariance = result.poses[k], result.covariances[k] + persistent[k]
        choice = chosen.get(first + k)
        if line is None:
            estimates[frame] = _filled(frame, float(track.times[k]), lines, T, covariance)
        elif choice is None or choice.pose is not None:
            is_inlier = bool(track.measured[k])
            estimates[frame] = _estimate(line, T, covariance, choice, is_inlier, rules)
    return estimates


def _alternatives(line: PoseLine) -> Alternatives:
    """Return the poses that a frame may show: its hypotheses if it is ambiguous."""
    T = line.T_world_object
    assert T is not None
    if line.status == "ok" or not line.hypotheses:
        return Alternatives(T[None], np.ones(1), may_be_none=line.status != "ok")
    weights = np.array([max(rival.weight, 1e-6) for rival in line.hypotheses])
    poses = np.stack([rival.T_world_object for rival in line.hypotheses])
    return Alternatives(poses, weights / max(weights.sum(), 1.0), may_be_none=True)


def _chosen(
    segment: _Segment, model: tracks.MotionModel, rules: SmoothingRules
) -> dict[int, Choice]:
    """Choose among the alternatives of the ambiguous frames of a segment, by index."""
    lines = [(k, line) for k, line in enumerate(segment.lines) if line is not None]
    if all(line.status == "ok" for _, line in lines):
        return {}
    track = segment.track.part(segment.track.measured)
    decisions = choices(track, [_alternatives(line) for _, line in lines], model, rules)
    both = zip(lines, decisions, strict=True)
    return {k: choice for (k, line), choice in both if line.status != "ok"}


def _without_outliers(
    track: tracks.Track, model: tracks.MotionModel, rules: SmoothingRules
) -> tuple[tracks.Track, tracks.SmoothedTrack]:
    """Return a track without poses that contradict their neighbours, and the smoothed track."""
    if _misfits(track, tracks.smooth_track(track, model), model, -1)[0] > _limit(track, rules):
        # test the first pose as the last of the reversed track, which then also predicts it
        reversed_track = replace(track.part(slice(None, None, -1)), times=-track.times[::-1])
        kept, reversed_result = _without_outliers_after_first(reversed_track, model, rules)
        if not kept.measured[-1]:
            # the next pose begins a track; filled frames before it are predicted, too
            first = 1 + int(track.measured[1:].argmax())
            remaining = track.part(slice(first, None))
            kept, later = _without_outliers_after_first(remaining, model, rules)
            before = slice(None, -first - 1, -1)
            poses = np.concatenate([reversed_result.poses[before], later.poses])
            covariances = np.concatenate([reversed_result.covariances[before], later.covariances])
            measured = np.append(np.zeros(first, bool), kept.measured)
            result = replace(later, poses=poses, covariances=covariances)
            return replace(track, measured=measured), result
    return _without_outliers_after_first(track, model, rules)


def _limit(track: tracks.Track, rules: SmoothingRules) -> float:
    """Return the squared deviation from all other poses beyond which a pose may be wrong."""
    return float(chdtri(int(track.free.sum()), rules.foreign))


def _without_outliers_after_first(
    track: tracks.Track, model: tracks.MotionModel, rules: SmoothingRules
) -> tuple[tracks.Track, tracks.SmoothedTrack]:
    """Return the same as `_without_outliers`, given that the first pose is right."""
    limit = _limit(track, rules)
    if_wrong = outlier_logs(track, tracks.white_parts(track, np.array([model.white])), rules)[:, 0]
    result, logs, _ = smooth_with_sudden_motion(track, model, rules)
    for _ in range(_ROUNDS):
        # with steady motion, corners of the path look like outliers, too
        misfits = _misfits(track, tracks.smooth_track(track, model), model, -1)
        padded = np.pad(misfits, 1)  # outliers pull their neighbours off: only local maxima count
        bad = (misfits > limit) & (misfits >= padded[:-2]) & (misfits >= padded[2:])
        bad[0] = False
        if not bad.any():
            break
        # but at a corner the other poses show the sudden motion as well
        trial, trial_logs, _ = smooth_with_sudden_motion(tracks.without(track, bad), model, rules)
        outliers = np.flatnonzero(bad)
        starts = np.append(0, (outliers[1:] + outliers[:-1] + 1) // 2)  # of their nearest poses
        are_likelier = np.add.reduceat(trial_logs - logs, starts) + if_wrong[outliers] > 0
        bad[outliers] = are_likelier & (_misfits(track, trial, model, 1)[outliers] > limit)
        if not bad.any():
            break
        track = tracks.without(track, bad)
        result, logs, _ = smooth_with_sudden_motion(track, model, rules)
    return track, result


def _misfits(
    track: tracks.Track, result: tracks.SmoothedTrack, model: tracks.MotionModel, sign: int
) -> Floats:
    """Return rᵀ(R ± P)⁻¹r (N,) of poses from smoothed ones; `sign` is -1 if these used them."""
    free = np.flatnonzero(track.free)
    inner = np.ix_(np.arange(len(track)), free, free)
    twists = rigid.twist_between(result.poses, track.poses).reshape(-1, 6)[:, free]
    variances = (model.white * track.covariances + sign * result.covariances)[inner]
    scale = np.sqrt(np.diagonal(track.covariances[inner], axis1=1, axis2=2))
    variances = variances / scale[:, :, None] / scale[:, None]
    values, vectors = np.linalg.eigh(variances)
    along = np.einsum("kij,ki->kj", vectors, twists / scale)
    # a direction known by the pose itself alone has no deviation
    is_known = values > 1e-6 * model.white
    squared = np.where(is_known, along**2 / np.where(is_known, values, 1.0), 0.0).sum(axis=1)
    return np.where(track.measured, squared, 0.0)


def _estimate(
    line: PoseLine,
    T: Floats,
    covariance: Floats,
    choice: Choice | None,
    is_inlier: bool,
    rules: SmoothingRules,
) -> Estimate:
    """Return the estimate of a line at its smoothed pose."""
    smoothed = replace(line, T_world_object=T, covariance=covariance)
    if choice is None:
        if is_inlier:
            return smoothed
        assert line.T_world_object is not None
        rivals = (Hypothesis(T, 0.5), Hypothesis(line.T_world_object, 0.5))
        return replace(smoothed, status="ambiguous", confidence=0.0, hypotheses=rivals)
    if not line.hypotheses or not is_inlier:
        return smoothed
    probabilities, first_weight = choice.probabilities, line.hypotheses[0].weight
    # a track decides between poses and clutter, but not whether the session is wrong
    if line.doubt and line.confidence is not None:
        probabilities = probabilities * min(line.confidence / max(first_weight, 1e-6), 1.0)
    weight = float(probabilities[choice.index])
    if weight >= rules.sure:
        return replace(smoothed, status="ok", confidence=weight, hypotheses=())
    order = np.argsort(-probabilities, kind="stable").tolist()
    order.remove(choice.index)
    others = [
        Hypothesis(line.hypotheses[k].T_world_object, float(probabilities[k]))
        for k in order
        if probabilities[k] > 0
    ]
    return replace(smoothed, confidence=weight, hypotheses=(Hypothesis(T, weight), *others))


def _filled(
    frame: int, time_s: float, lines: Sequence[PoseLine | None], T: Floats, covariance: Floats
) -> Estimate:
    """Return the estimate of a frame in which nothing was measured."""
    like = next(line for line in lines if line is not None)
    return Estimate(
        frame=frame,
        time_s=time_s,
        object=like.object,
        status="ambiguous",
        T_world_object=T,
        covariance=covariance,
        score=0.0,
        sensors={},
        instance=like.instance,
        tip_object=like.tip_object,
        filled=True,
    )
