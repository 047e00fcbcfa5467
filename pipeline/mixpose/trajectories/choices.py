"""Which hypothesis of an ambiguous frame the track supports.

Every choice of hypotheses is a path of its own, followed by a Kalman filter; the likeliest few are
followed side by side, so that a choice is made by what comes after it as well as by what was before
(multiple hypothesis tracking, D. B. Reid, 1979).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mixpose.records import Floats
from mixpose.trajectories.intensity import SmoothingRules
from mixpose.trajectories.motion import States, foretold, updated
from mixpose.trajectories.track import MotionModel, Track, begun, noise_of, white_part

NONE = -1
"""A choice: the frame shows something else."""


@dataclass(frozen=True)
class Alternatives:
    """What a frame may show."""

    poses: Floats  # (n, 4, 4)
    weights: Floats  # (n,): sum of at most 1
    may_be_none: bool  # whether it may be none of them


@dataclass(frozen=True)
class Choice:
    """What a frame shows, most likely."""

    which: int  # of its alternatives, or `NONE`
    probabilities: Floats  # (n,): of each of them


def choices(
    track: Track, alternatives: Sequence[Alternatives], model: MotionModel, rules: SmoothingRules
) -> list[Choice]:
    """Choose among the alternatives (N) of each time of a track.

    The poses of the track itself count for nothing; its covariances are those of all alternatives.
    """
    paths, logs = _followed(track, alternatives, model, rules)
    shares = np.exp(logs - logs.max())
    shares /= shares.sum()
    found = []
    for k, one in enumerate(alternatives):
        probabilities = np.zeros(len(one.weights))
        for path, share in zip(paths, shares.tolist(), strict=True):
            if path[k] != NONE:
                probabilities[path[k]] += share
        found.append(Choice(paths[int(np.argmax(logs))][k], probabilities))
    return found


def _followed(
    track: Track, alternatives: Sequence[Alternatives], model: MotionModel, rules: SmoothingRules
) -> tuple[list[tuple[int, ...]], Floats]:
    """The likeliest paths, each a choice per time, and their log likelihoods."""
    first, white = alternatives[0], np.array([model.white])
    noise = noise_of(track, model.intensities[None])
    at_first = [
        begun(_with_pose(track, pose), 0, model.order, white, track.moved) for pose in first.poses
    ]
    states = _joined(at_first)
    paths: list[tuple[int, ...]] = [(k,) for k in range(len(first.poses))]
    logs: Floats = np.log(first.weights)
    for k, elapsed in enumerate(np.diff(track.times).tolist(), 1):
        ahead, _ = foretold(states, elapsed, np.repeat(noise, len(logs), axis=0))
        S = ahead.covariances[:, :6, :6] + white_part(track, k, white)
        off_track = -0.5 * (rules.none + np.linalg.slogdet(S)[1])
        one = alternatives[k]
        found: list[States] = []
        all_paths: list[tuple[int, ...]] = []
        all_logs: list[float] = []
        for j, (pose, weight) in enumerate(zip(one.poses, one.weights.tolist(), strict=True)):
            state, _, own = updated(ahead, pose, white_part(track, k, white))
            found.append(state)
            all_paths += [(*path, j) for path in paths]
            all_logs += (logs + own + np.log(weight)).tolist()
        if one.may_be_none:
            found.append(ahead)
            all_paths += [(*path, NONE) for path in paths]
            all_logs += (logs + off_track).tolist()
        logs = np.array(all_logs)
        kept = np.argsort(-logs, kind="stable")[: rules.paths]
        kept = kept[logs[kept] > logs.max() - 2 * rules.none]
        states, paths, logs = _joined(found).of(kept), [all_paths[i] for i in kept], logs[kept]
    return paths, logs


def _with_pose(track: Track, pose: Floats) -> Track:
    """The first time of a track, with another pose."""
    one = track.part(slice(0, None))
    poses = one.poses.copy()
    poses[0] = pose
    return Track(one.times, poses, one.covariances, one.measured, one.free)


def _joined(states: Sequence[States]) -> States:
    return States(
        np.concatenate([one.poses for one in states]),
        np.concatenate([one.rates for one in states]),
        np.concatenate([one.covariances for one in states]),
    )
