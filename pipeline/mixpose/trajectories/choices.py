"""Which of its poses a frame shows: of hypotheses, and of those that look the same.

Every choice of hypotheses is a path of its own, followed by a Kalman filter; the likeliest few are
followed side by side, so that a choice is made by what comes after it as well as by what was before
(multiple hypothesis tracking, D. B. Reid, 1979).  Of poses of a symmetric body one follows from the
one before.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from mixpose import rigid
from mixpose.poses.poseline import PoseLine
from mixpose.records import Floats
from mixpose.trajectories.intensity import SmoothingRules
from mixpose.trajectories.motion import States, foretold, updated
from mixpose.trajectories.track import MotionModel, Track, begun, noise_of, white_parts

_NONE = -1  # a choice: the frame shows something else


@dataclass(frozen=True)
class Alternatives:
    """What a frame may show."""

    poses: Floats  # (n, 4, 4)
    weights: Floats  # (n,): sum of at most 1
    may_be_none: bool  # whether it may be none of them


@dataclass(frozen=True)
class Choice:
    """What a frame shows, most likely."""

    which: int  # of its alternatives, or -1: something else
    pose: Floats | None  # (4, 4): that of the alternative
    probabilities: Floats  # (n,): of each of them


def choices(
    track: Track, alternatives: Sequence[Alternatives], model: MotionModel, rules: SmoothingRules
) -> list[Choice]:
    """Choose among the alternatives (N) of each time of a track.

    The track's poses count for nothing; its covariances are those of all alternatives.
    """
    paths, logs = _followed(track, alternatives, model, rules)
    shares = np.exp(logs - logs.max())
    shares /= shares.sum()
    found = []
    for k, one in enumerate(alternatives):
        probabilities = np.zeros(len(one.weights))
        for path, share in zip(paths, shares.tolist(), strict=True):
            if path[k] != _NONE:
                probabilities[path[k]] += share
        which = paths[int(np.argmax(logs))][k]
        pose = None if which == _NONE else one.poses[which]
        # shares that make 1 may be more by rounding, which no reader takes
        found.append(Choice(which, pose, np.minimum(probabilities, 1.0)))
    return found


def _followed(
    track: Track, alternatives: Sequence[Alternatives], model: MotionModel, rules: SmoothingRules
) -> tuple[list[tuple[int, ...]], Floats]:
    """The likeliest paths, each a choice per time, _NONE before it begins, and log likelihoods."""
    white = white_parts(track, np.array([model.white]))
    noise = noise_of(track, model.intensities[None])

    def first(k: int) -> States:
        one = alternatives[k]
        states = begun(track, model.order, white[k].repeat(len(one.poses), axis=0))
        return states._replace(poses=one.poses)

    def ahead_of(states: States, k: int) -> tuple[States, Floats]:
        """At the next time, and the log likelihood that this shows something else."""
        elapsed, count = float(track.times[k] - track.times[k - 1]), len(states.poses)
        ahead, _ = foretold(states, elapsed, np.repeat(noise, count, axis=0))
        S = ahead.covariances[:, :6, :6] + white[k]
        return ahead, -0.5 * (rules.none + np.linalg.slogdet(S)[1])

    states, before = first(0), 0.0 if alternatives[0].may_be_none else -np.inf
    paths: list[tuple[int, ...]] = [(k,) for k in range(len(states.poses))]
    logs: Floats = np.log(alternatives[0].weights)
    for k in range(1, len(alternatives)):
        ahead, off_track = ahead_of(states, k)
        one, found = alternatives[k], list[States]()
        all_paths: list[tuple[int, ...]] = []
        all_logs: list[float] = []
        for j, (pose, weight) in enumerate(zip(one.poses, one.weights.tolist(), strict=True)):
            state, _, own = updated(ahead, pose, white[k])
            found.append(state)
            all_paths += [(*path, j) for path in paths]
            all_logs += (logs + own + np.log(weight)).tolist()
        if one.may_be_none:
            found.append(ahead)
            all_paths += [(*path, _NONE) for path in paths]
            all_logs += (logs + off_track).tolist()
        if before > -np.inf:  # what was before is as far off as from what begins there
            before += float(ahead_of(first(k - 1), k)[1].max())
            found.append(first(k))
            all_paths += [(*[_NONE] * k, j) for j in range(len(one.poses))]
            all_logs += (before + np.log(one.weights)).tolist()
            before = before if one.may_be_none else -np.inf
        logs = np.array(all_logs)
        kept = np.argsort(-logs, kind="stable")[: rules.paths]
        kept = kept[logs[kept] > logs.max() - 2 * rules.none]
        joined = States(*(np.concatenate(parts) for parts in zip(*found, strict=True)))
        states, paths, logs = joined.of(kept), [all_paths[i] for i in kept], logs[kept]
    return paths, logs


def unfolded(lines: Sequence[PoseLine], symmetries: Floats | None) -> list[PoseLine]:
    """Of poses that look the same by motions (n, 4, 4) those turned least from the one before."""
    if symmetries is None or len(symmetries) < 2:
        return list(lines)
    before: Floats | None = None
    found = []
    for line in lines:
        if line.T_world_object is None:
            found.append(line)
            continue
        before = line.T_world_object if before is None else before
        found.append(_turned(line, line.T_world_object, before, symmetries))
        if line.status == "ok":
            before = found[-1].T_world_object
    return found


def _turned(line: PoseLine, T: Floats, before: Floats, symmetries: Floats) -> PoseLine:
    """A line at T whose poses are turned least against another pose."""
    S, C, tip = _nearest(T, before, symmetries), line.covariance, line.tip_object
    rivals = []
    for each in line.hypotheses:
        rival = each.T_world_object
        turned = rival @ _nearest(rival, before, symmetries)
        rivals.append(replace(each, T_world_object=turned))
    return replace(
        line,
        T_world_object=T @ S,
        covariance=None if C is None else rigid.covariance_at(C, T[:3, :3] @ S[:3, 3]),
        tip_object=None if tip is None else S[:3, :3].T @ (tip - S[:3, 3]),
        hypotheses=tuple(rivals),
    )


def _nearest(T: Floats, before: Floats, symmetries: Floats) -> Floats:
    angles = rigid.rotation_angle_deg(np.broadcast_to(before, symmetries.shape), T @ symmetries)
    return np.asarray(symmetries[int(np.argmin(angles))])
