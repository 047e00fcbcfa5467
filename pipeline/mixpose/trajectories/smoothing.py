"""Poses of a body, each with what all frames say: fixed-interval smoothing.

What is assumed of the covariances of a file: errors of different frames are independent, as far as
the poses scatter about a smooth path as they say.  Where they scatter surely less, the share that
is not seen is taken for an error that lasts, of a calibration or a marker, which no smoothing makes
smaller: it stays in the covariance as it was.  Where they scatter more, covariances are enlarged.
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
from mixpose.trajectories.choices import Alternatives, Choice, choices, unfolded
from mixpose.trajectories.intensity import (
    SmoothingRules,
    fitted_model,
    logs_of_wrong,
    smooth_with_sudden_motion,
)

_ROUNDED_S = 1e-6  # of differences of times, which are since 1970 at worst
_ROUNDS = 3  # rounds in which poses are left out: one wrong pose may hide another


@dataclass(frozen=True)
class SmoothedBody:
    """The poses of a body, smoothed."""

    estimates: tuple[Estimate, ...]  # of each line and each frame that was filled, by number
    model: tracks.MotionModel | None  # None where there were too few poses
    smoothed: int  # poses
    filled: int  # frames in which no pose was
    decided: int  # ambiguous frames that are ok now
    refused: tuple[int, ...]  # frames whose poses were ok and lie far off those around them
    timed: bool  # whether the model goes by seconds; else by numbers of frames


@dataclass(frozen=True)
class _Segment:
    """Lines without a long gap, those that are filled in being None, and their times."""

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

    Poses that look the same by the body's symmetries (n, 4, 4) are one. Gaps of at most `fill_s`
    seconds from pose to pose are filled. `motion` says what takes white noise, of
    `mixpose.trajectories.motion.ORDERS`; else the likeliest. Raises RecordingError if a frame
    stands twice, a pose has no covariance, or gaps are to be filled and there are no times.
    """
    ordered = sorted(lines, key=lambda line: line.frame)
    times = _times(ordered)
    if fill_s and times is None:
        raise RecordingError(
            "--fill: found poses without times, or whose times do not ascend; allowed: poses of a "
            "recording with times: add fps or times to the sensors of its session"
        )
    at = np.array([line.frame for line in ordered], float) if times is None else times
    ordered = unfolded(ordered, symmetries)
    posed = [k for k, line in enumerate(ordered) if line.T_world_object is not None]
    tracks.require_covariances([ordered[k] for k in posed])
    sure = [k for k in posed if ordered[k].status == "ok"]
    told = sure if len(sure) >= rules.fewest else posed
    if len(told) < rules.fewest:
        return SmoothedBody(tuple(ordered), None, 0, 0, 0, (), times is not None)
    longest = rules.restarts * float(np.median(np.diff(at[posed])))
    with _possible(lines[0].label) as found:
        model = fitted_model(_track([ordered[k] for k in told], at[told]), longest, rules, motion)
        for segment in _segments(ordered, at, posed, max(longest, fill_s), fill_s):
            if model is not None:
                found.update(_smoothed(segment, model, rules))
    met = [ordered[k] for k in posed if ordered[k].frame in found]
    changed = [line for line in met if found[line.frame].status != line.status]
    refused = tuple(line.frame for line in changed if line.status == "ok")
    done = {line.frame: line for line in ordered} | found
    return SmoothedBody(
        estimates=tuple(done[frame] for frame in sorted(done)),
        model=model,
        smoothed=len(met),
        filled=len(found) - len(met),
        decided=len(changed) - len(refused),
        refused=refused,
        timed=times is not None,
    )


@contextmanager
def _possible(label: str) -> Iterator[dict[int, Estimate]]:
    """Estimates by frame, to be worked out within; a RecordingError if numbers do not allow it."""
    found: dict[int, Estimate] = {}
    try:
        with np.errstate(all="ignore"):
            yield found
        is_possible = all(
            np.isfinite(values).all()
            for one in found.values()
            for values in (one.T_world_object, one.covariance)
            if values is not None
        )
    except (np.linalg.LinAlgError, OverflowError, ZeroDivisionError):
        is_possible = False
    if not is_possible:
        raise RecordingError(
            f"poses of {label!r} cannot be smoothed: covariances or times are too large or too "
            "small beside each other; allowed: poses as mixpose run writes them"
        )


def _times(lines: Sequence[PoseLine]) -> Floats | None:
    """Of all lines; None where one has none, or they do not ascend."""
    tracks.require_frames_once(lines)
    found = [line.time_s for line in lines if line.time_s is not None]
    times = np.array(found, dtype=np.float64)
    return times if len(found) == len(lines) and (np.diff(times) > 0).all() else None


def _track(lines: Sequence[PoseLine], times: Floats) -> tracks.Track:
    poses = np.stack([line.T_world_object for line in lines if line.T_world_object is not None])
    covariances = np.stack([line.covariance for line in lines if line.covariance is not None])
    return tracks.track_of(times, poses, covariances, np.ones(len(lines), bool))


def _segments(
    lines: Sequence[PoseLine], times: Floats, posed: Sequence[int], longest: float, fill_s: float
) -> list[_Segment]:
    """Lines with poses, cut at the longest gaps, with the frames between that are to be filled."""
    step = int(np.median(np.diff([lines[k].frame for k in posed])))
    cuts = np.flatnonzero(np.diff(times[posed]) > longest + _ROUNDED_S) + 1
    segments = []
    for part in np.split(np.array(posed), cuts):
        # line, or none where one is filled in; the last line that is there; frame and time
        rows: list[tuple[PoseLine | None, PoseLine, int, float]] = []
        for last, k in pairwise([0, *part.tolist()]):  # the first has none before it
            line = lines[k]
            if rows and times[k] - times[last] <= fill_s + _ROUNDED_S:
                told, first = lines[last : k + 1], lines[last].frame
                between = _between(first, line.frame, step, [each.frame for each in told[1:-1]])
                # frame numbers may be beyond what numbers of NumPy hold
                since = np.array([each.frame - first for each in told], dtype=np.float64)
                moments = np.interp([n - first for n in between], since, times[last : k + 1])
                rows += [(None, lines[last], n, t) for n, t in zip(between, moments.tolist())]
            rows.append((line, line, line.frame, float(times[k])))
        own, known, frames, at = zip(*rows, strict=True)
        measured = np.array([each is not None for each in own])
        track = replace(_track(known, np.array(at)), measured=measured)
        segments.append(_Segment(own, frames, track))
    return segments


def _between(before: int, after: int, step: int, lost: Sequence[int]) -> list[int]:
    """Frames between two, evenly at about the usual step; those without a pose are some of them."""
    span = after - before
    count = max(round(span / max(step, 1)) - 1, 0)
    even = [before + span * k // (count + 1) for k in range(1, count + 1)]
    return sorted([*lost, *(n for n in even if all(2 * abs(n - one) >= step for one in lost))])


def _smoothed(
    segment: _Segment, model: tracks.MotionModel, rules: SmoothingRules
) -> dict[int, Estimate]:
    """Estimates by frame."""
    chosen = _chosen(segment, model, rules)
    poses = segment.track.poses.copy()
    measured = segment.track.measured.copy()
    for k, made in chosen.items():
        measured[k] = made.pose is not None
        if made.pose is not None:
            poses[k] = made.pose
    track = replace(segment.track, poses=poses, measured=measured)
    inside = np.flatnonzero(measured)
    if len(inside) < 2:
        return {}
    first, last = int(inside[0]), int(inside[-1]) + 1
    lines, frames = segment.lines[first:last], segment.frames[first:last]
    track, result = _without_foreign(track.part(slice(first, last)), model, rules)
    spare = max(0.0, 1.0 - model.white) * tracks.of_free(track.covariances, track.free)
    found = {}
    for k, (line, frame) in enumerate(zip(lines, frames, strict=True)):
        T, covariance = result.poses[k], result.covariances[k] + spare[k]
        choice = chosen.get(first + k)
        if line is None:
            found[frame] = _filled(frame, float(track.times[k]), lines, T, covariance)
        elif choice is None or choice.pose is not None:
            is_met = bool(track.measured[k])
            found[frame] = _estimate(line, T, covariance, choice, is_met, rules)
    return found


def _alternatives(line: PoseLine) -> Alternatives:
    """What a frame may show: of an ambiguous one its hypotheses."""
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
    """What each ambiguous frame of a segment shows, by its place."""
    lines = [(k, line) for k, line in enumerate(segment.lines) if line is not None]
    if all(line.status == "ok" for _, line in lines):
        return {}
    track = segment.track.part(segment.track.measured)
    found = choices(track, [_alternatives(line) for _, line in lines], model, rules)
    both = zip(lines, found, strict=True)
    return {k: choice for (k, line), choice in both if line.status != "ok"}


def _without_foreign(
    track: tracks.Track, model: tracks.MotionModel, rules: SmoothingRules
) -> tuple[tracks.Track, tracks.SmoothedTrack]:
    """A track without poses that lie where those around them forbid, and that smoothed."""
    if _off(track, tracks.smooth_track(track, model), model, -1)[0] > _limit(track, rules):
        # is the first wrong? as the last of the way back it is told where it should be
        reversed_track = replace(track.part(slice(None, None, -1)), times=-track.times[::-1])
        left, back = _without_foreign_after_first(reversed_track, model, rules)
        if not left.measured[-1]:
            left, rest = _without_foreign_after_first(track.part(slice(1, None)), model, rules)
            poses = np.concatenate([back.poses[-1:], rest.poses])
            covariances = np.concatenate([back.covariances[-1:], rest.covariances])
            measured = np.append(False, left.measured)
            result = replace(rest, poses=poses, covariances=covariances)
            return replace(track, measured=measured), result
    return _without_foreign_after_first(track, model, rules)


def _limit(track: tracks.Track, rules: SmoothingRules) -> float:
    """Squared distance of a pose from what all others say, beyond which it may be a wrong one."""
    return float(chdtri(int(track.free.sum()), rules.foreign))


def _without_foreign_after_first(
    track: tracks.Track, model: tracks.MotionModel, rules: SmoothingRules
) -> tuple[tracks.Track, tracks.SmoothedTrack]:
    """The same, where the first pose is right."""
    limit = _limit(track, rules)
    wrong = logs_of_wrong(track, tracks.white_parts(track, np.array([model.white])), rules)[:, 0]
    result, logs, _ = smooth_with_sudden_motion(track, model, rules)
    for _ in range(_ROUNDS):
        # among motion that is steady a corner of the path looks foreign, too
        off = _off(track, tracks.smooth_track(track, model), model, -1)
        padded = np.pad(off, 1)  # the farthest of neighbours pulls the others off
        bad = (off > limit) & (off >= padded[:-2]) & (off >= padded[2:])
        bad[0] = False
        if not bad.any():
            break
        # but at a corner the others tell of sudden motion as well
        among, others, _ = smooth_with_sudden_motion(tracks.without(track, bad), model, rules)
        places = np.flatnonzero(bad)
        parts = np.append(0, (places[1:] + places[:-1] + 1) // 2)  # what is next to each of them
        likelier = np.add.reduceat(others - logs, parts) + wrong[places] > 0
        bad[places] = likelier & (_off(track, among, model, 1)[places] > limit)
        if not bad.any():
            break
        track = tracks.without(track, bad)
        result, logs, _ = smooth_with_sudden_motion(track, model, rules)
    return track, result


def _off(
    track: tracks.Track, result: tracks.SmoothedTrack, model: tracks.MotionModel, sign: int
) -> Floats:
    """rᵀ(R ± P)⁻¹r (N,), of poses and what others say; the sign is -1 where they took part in P."""
    free = np.flatnonzero(track.free)
    inner = np.ix_(np.arange(len(track)), free, free)
    rest = rigid.twist_between(result.poses, track.poses).reshape(-1, 6)[:, free]
    own = (model.white * track.covariances + sign * result.covariances)[inner]
    scale = np.sqrt(np.diagonal(track.covariances[inner], axis1=1, axis2=2))
    own = own / scale[:, :, None] / scale[:, None]
    values, vectors = np.linalg.eigh(own)
    along = np.einsum("kij,ki->kj", vectors, rest / scale)
    # where nothing but the pose itself tells of it, it is off by nothing
    told = values > 1e-6 * model.white
    squared = np.where(told, along**2 / np.where(told, values, 1.0), 0.0).sum(axis=1)
    return np.where(track.measured, squared, 0.0)


def _estimate(
    line: PoseLine,
    T: Floats,
    covariance: Floats,
    choice: Choice | None,
    is_met: bool,
    rules: SmoothingRules,
) -> Estimate:
    """The estimate of a line at its smoothed pose."""
    one = replace(line, T_world_object=T, covariance=covariance)
    if choice is None:
        if is_met:
            return one
        assert line.T_world_object is not None
        rivals = (Hypothesis(T, 0.5), Hypothesis(line.T_world_object, 0.5))
        return replace(one, status="ambiguous", confidence=0.0, hypotheses=rivals)
    if not line.hypotheses or not is_met:
        return one
    shares, first = choice.probabilities, line.hypotheses[0].weight
    # a track tells a pose from its rivals, and from clutter, and nothing of a wrong session
    if line.doubt and line.confidence is not None:
        shares = shares * min(line.confidence / max(first, 1e-6), 1.0)
    sure = float(shares[choice.which])
    if sure >= rules.sure:
        return replace(one, status="ok", confidence=sure, hypotheses=())
    order = np.argsort(-shares, kind="stable").tolist()
    order.remove(choice.which)
    others = [
        Hypothesis(line.hypotheses[k].T_world_object, float(shares[k]))
        for k in order
        if shares[k] > 0
    ]
    return replace(one, confidence=sure, hypotheses=(Hypothesis(T, sure), *others))


def _filled(
    frame: int, time_s: float, lines: Sequence[PoseLine | None], T: Floats, covariance: Floats
) -> Estimate:
    """A frame in which nothing was measured."""
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
