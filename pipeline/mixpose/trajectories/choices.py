"""Choose the pose of each frame, among its hypotheses and among poses that look the same.

Each sequence of choices is a path that a Kalman filter follows; only the likeliest few paths are
kept, so that later frames decide a choice as well as earlier ones (multiple hypothesis tracking,
D. B. Reid, 1979).  Of the poses of a symmetric body that look the same, the one nearest to the pose
before is taken.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from mixpose import rigid
from mixpose.poses.poseline import PoseLine
from mixpose.records import Floats
from mixpose.trajectories.intensity import SmoothingRules
from mixpose.trajectories.motion import States, predicted, updated
from mixpose.trajectories.track import MotionModel, Track, initial_states, noise_of, white_parts

_NONE = -1  # the choice that a frame shows something else


@dataclass(frozen=True)
class Alternatives:
    """Poses that a frame may show."""

    poses: Floats  # (n, 4, 4)
    weights: Floats  # (n,), with a sum of at most 1
    may_be_none: bool  # whether the frame may show none of them


@dataclass(frozen=True)
class Choice:
    """The likeliest alternative of a frame."""

    index: int  # of the alternative, or -1: something else
    pose: Floats | None  # (4, 4), of the alternative
    probabilities: Floats  # (n,), of all alternatives


def choices(
    track: Track, alternatives: Sequence[Alternatives], model: MotionModel, rules: SmoothingRules
) -> list[Choice]:
    """Choose among the alternatives at each of the N times of a track.

    The poses of the track are ignored; its covariances are those of all alternatives.
    """
    paths, log_likelihoods = _likely_paths(track, alternatives, model, rules)
    path_weights = np.exp(log_likelihoods - log_likelihoods.max())
    path_weights /= path_weights.sum()
    results = []
    for k, alternative in enumerate(alternatives):
        probabilities = np.zeros(len(alternative.weights))
        for path, weight in zip(paths, path_weights.tolist(), strict=True):
            if path[k] != _NONE:
                probabilities[path[k]] += weight
        index = paths[int(np.argmax(log_likelihoods))][k]
        pose = None if index == _NONE else alternative.poses[index]
        # rounding may take a sum of weights above 1, which readers of the file refuse
        results.append(Choice(index, pose, np.minimum(probabilities, 1.0)))
    return results


def _likely_paths(
    track: Track, alternatives: Sequence[Alternatives], model: MotionModel, rules: SmoothingRules
) -> tuple[list[tuple[int, ...]], Floats]:
    """Return the likeliest paths, choices with `_NONE` before the first, and log likelihoods."""
    white = white_parts(track, np.array([model.white]))
    noise = noise_of(track, model.intensities[None])

    def states_at(k: int) -> States:
        rivals = alternatives[k]
        states = initial_states(track, model.order, white[k].repeat(len(rivals.poses), axis=0))
        return states._replace(poses=rivals.poses)

    def predict(states: States, k: int) -> tuple[States, Floats]:
        """Return the states predicted for time k, and log likelihoods that it shows none."""
        elapsed, count = float(track.times[k] - track.times[k - 1]), len(states.poses)
        ahead, _ = predicted(states, elapsed, np.repeat(noise, count, axis=0))
        S = ahead.covariances[:, :6, :6] + white[k]
        return ahead, -0.5 * (rules.none + np.linalg.slogdet(S)[1])

    states, log_unstarted = states_at(0), 0.0 if alternatives[0].may_be_none else -np.inf
    paths: list[tuple[int, ...]] = [(k,) for k in range(len(states.poses))]
    logs: Floats = np.log(alternatives[0].weights)
    for k in range(1, len(alternatives)):
        ahead, log_none = predict(states, k)
        rivals, new_states = alternatives[k], list[States]()
        new_paths: list[tuple[int, ...]] = []
        new_logs: list[float] = []
        for j, (pose, weight) in enumerate(zip(rivals.poses, rivals.weights.tolist(), strict=True)):
            state, _, log_update = updated(ahead, pose, white[k])
            new_states.append(state)
            new_paths += [(*path, j) for path in paths]
            new_logs += (logs + log_update + np.log(weight)).tolist()
        if rivals.may_be_none:
            new_states.append(ahead)
            new_paths += [(*path, _NONE) for path in paths]
            new_logs += (logs + log_none).tolist()
        if log_unstarted > -np.inf:  # frames before a track count as off a track begun there
            log_unstarted += float(predict(states_at(k - 1), k)[1].max())
            new_states.append(states_at(k))
            new_paths += [(*[_NONE] * k, j) for j in range(len(rivals.poses))]
            new_logs += (log_unstarted + np.log(rivals.weights)).tolist()
            log_unstarted = log_unstarted if rivals.may_be_none else -np.inf
        logs = np.array(new_logs)
        kept = np.argsort(-logs, kind="stable")[: rules.paths]
        kept = kept[logs[kept] > logs.max() - 2 * rules.none]
        joined = States(*(np.concatenate(parts) for parts in zip(*new_states, strict=True)))
        states, paths, logs = joined.of(kept), [new_paths[i] for i in kept], logs[kept]
    return paths, logs


def unwrapped(lines: Sequence[PoseLine], symmetries: Floats | None) -> list[PoseLine]:
    """Replace poses by those, equal up to symmetries (n, 4, 4), that turn least from the last."""
    if symmetries is None or len(symmetries) < 2:
        return list(lines)
    previous: Floats | None = None
    results = []
    for line in lines:
        if line.T_world_object is None:
            results.append(line)
            continue
        previous = line.T_world_object if previous is None else previous
        results.append(_least_turned(line, line.T_world_object, previous, symmetries))
        if line.status == "ok":
            previous = results[-1].T_world_object
    return results


def _least_turned(line: PoseLine, T: Floats, reference: Floats, symmetries: Floats) -> PoseLine:
    """Return a line at T with its poses replaced by those turned least from a reference."""
    S, C, tip = _nearest_symmetry(T, reference, symmetries), line.covariance, line.tip_object
    rivals = []
    for hypothesis in line.hypotheses:
        rival = hypothesis.T_world_object
        turned = rival @ _nearest_symmetry(rival, reference, symmetries)
        rivals.append(replace(hypothesis, T_world_object=turned))
    return replace(
        line,
        T_world_object=T @ S,
        covariance=None if C is None else rigid.covariance_at(C, T[:3, :3] @ S[:3, 3]),
        tip_object=None if tip is None else S[:3, :3].T @ (tip - S[:3, 3]),
        hypotheses=tuple(rivals),
    )


def _nearest_symmetry(T: Floats, reference: Floats, symmetries: Floats) -> Floats:
    angles = rigid.rotation_angle_deg(np.broadcast_to(reference, symmetries.shape), T @ symmetries)
    return np.asarray(symmetries[int(np.argmin(angles))])
