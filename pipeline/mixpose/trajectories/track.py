"""Poses of one body over time, filtered forwards and smoothed backwards."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from mixpose import rigid
from mixpose.errors import RecordingError
from mixpose.poses.poseline import PoseLine
from mixpose.records import Floats, Indices, Mask
from mixpose.trajectories.motion import Passage, States, foretold, smoothed, updated

_DIFFUSE = 10.0  # times the motion from frame to frame: nothing is known of rates at first
_FLOOR = 1e-9  # of a pose's largest variance: what float64 can tell apart


@dataclass(frozen=True)
class Track:
    """Poses of one body at ascending times."""

    times: Floats  # (N,): s, or numbers of frames
    poses: Floats  # (N, 4, 4)
    covariances: Floats  # (N, 6, 6): as `mixpose.rigid` has them; of directions that are held, any
    measured: Mask  # (N,): whether there is a pose; what stands in `poses` counts there only
    free: Mask  # (6,): directions of the world in which the body is estimated

    def __len__(self) -> int:
        return len(self.times)

    def part(self, some: slice | Mask | Indices) -> Track:
        """A part of the track."""
        poses, covariances = self.poses[some], self.covariances[some]
        return Track(self.times[some], poses, covariances, self.measured[some], self.free)

    @property
    def interval(self) -> float:
        """Median time from one pose to the next."""
        steps = np.diff(self.times[self.measured])
        return float(np.median(steps)) if len(steps) else 1.0

    @property
    def moved(self) -> Floats:
        """Root mean square motion (6,) from pose to pose, one number for lengths, one for turns."""
        poses = self.poses[self.measured]
        twists = rigid.twist_between(poses[:-1], poses[1:]).reshape(-1, 2, 3)
        return np.asarray(np.sqrt((twists**2).mean(axis=(0, 2))).repeat(3))


def of_free(covariances: Floats, free: Mask) -> Floats:
    """Covariances (N, 6, 6) with zero for directions that are held."""
    return np.where(free[:, None] & free, covariances, 0.0)


def track_of(times: Floats, poses: Floats, covariances: Floats, measured: Mask) -> Track:
    """A track whose covariances can be inverted; directions without variance are held.

    Such a one gets the median variance of the others of its kind: its poses agree, so that any will
    do.
    """
    seen = covariances[measured]
    variances = np.median(np.diagonal(seen, axis1=1, axis2=2), axis=0)
    kinds = variances.reshape(2, 3).max(axis=1).repeat(3)
    free = variances > 1e-12 * np.where(kinds > 0, kinds, np.inf)
    covariances = of_free(covariances, free)
    own = np.diagonal(covariances, axis1=1, axis2=2)
    for kind in (slice(0, 3), slice(3, 6)):
        each, some = own[:, kind].max(axis=1), free[kind]
        # where poses say hardly anything theirs are larger than all others by any factor
        typical = float(np.median(own[measured][:, kind][:, some])) if some.any() else 1.0
        floor = np.where(some, _FLOOR * each[:, None], typical)
        covariances[:, range(kind.start, kind.stop), range(kind.start, kind.stop)] += floor
    return Track(times, poses, covariances, measured, free)


@dataclass(frozen=True)
class MotionModel:
    """How a body moves, and how far its poses are off."""

    order: int  # p, of the derivative that takes white noise
    intensities: Floats  # (2,): q, of lengths and of turns
    white: float = 1.0  # share of covariances that is independent from frame to frame


def noise_of(track: Track, intensities: Floats) -> Floats:
    """Intensities (G, 6) of each coordinate, from those (G, 2) of lengths and turns."""
    held = np.diagonal(track.covariances[0]) / max(track.interval, 1e-9) ** 3
    return np.where(track.free, intensities.repeat(3, axis=1), held)


def white_parts(track: Track, white: Floats) -> Floats:
    """Covariances (N, G, 6, 6) of poses without what they have in common with others."""
    scale = np.where(track.free, np.sqrt(white)[:, None], 1.0)
    return np.asarray(track.covariances[:, None] * (scale[:, :, None] * scale[:, None]))


def begun(track: Track, order: int, covariances: Floats) -> States:
    """G states at the first pose, of these covariances (G, 6, 6); of rates nothing is known."""
    deviation = np.sqrt(np.diagonal(covariances, axis1=1, axis2=2))
    widths = _DIFFUSE * (track.moved + deviation)
    rates = [widths / track.interval**j for j in range(1, order)]
    G = len(covariances)
    P = np.zeros((G, 6 * order, 6 * order))
    P[:, range(6 * order), range(6 * order)] = np.concatenate([deviation, *rates], axis=1) ** 2
    P[:, :6, :6] = covariances
    poses = np.broadcast_to(track.poses[0], (G, 4, 4))
    return States(poses, np.zeros((G, order - 1, 6)), P)


@dataclass(frozen=True)
class SmoothedTrack:
    """A track with all that all its poses say."""

    poses: Floats  # (N, 4, 4)
    covariances: Floats  # (N, 6, 6)
    passages: tuple[Passage, ...]  # what happened between each two times
    logs: Floats  # (N,): log-likelihoods by those before; 0 where nothing is measured, or before


def smooth_track(track: Track, model: MotionModel, scales: Floats | None = None) -> SmoothedTrack:
    """Smooth a track whose first time has a pose.

    `scales` (N - 1, 2) is how much more noise there is between each two times than the model says.
    """
    own = white_parts(track, np.array([model.white]))
    scales = np.ones((len(track) - 1, 2)) if scales is None else scales
    steps = np.diff(track.times)
    noises = noise_of(track, model.intensities * scales)[:, None]
    states = [begun(track, model.order, own[0])]
    ahead: list[tuple[States, Floats]] = []
    logs = np.zeros(len(track))
    for k, (elapsed, noise) in enumerate(zip(steps.tolist(), noises, strict=True), 1):
        ahead.append(foretold(states[-1], elapsed, noise))
        state = ahead[-1][0]
        if track.measured[k]:
            state, _, logs[k : k + 1] = updated(state, track.poses[k], own[k])
        states.append(state)
    passages: list[Passage] = []
    for k in range(len(steps) - 1, -1, -1):
        foreseen, F = ahead[k]
        states[k], passage = smoothed(states[k], foreseen, states[k + 1], F, steps[k], noises[k])
        passages.append(passage)
    covariances = np.stack([one.covariances[0][:6, :6] for one in states])
    return SmoothedTrack(
        np.concatenate([one.poses for one in states]),
        of_free(covariances, track.free),
        tuple(reversed(passages)),
        logs,
    )


def without(track: Track, bad: Mask) -> Track:
    """A track in which some poses (N,) do not count."""
    return replace(track, measured=track.measured & ~bad)


def require_frames_once(lines: Sequence[PoseLine]) -> None:
    """Raise a RecordingError if a frame stands twice among lines in the order of frames."""
    for before, line in pairwise(lines):
        if before.frame == line.frame:
            raise RecordingError(
                f"frame {line.frame} of {line.label!r} stands twice; allowed: a line per frame"
            )


def require_covariances(lines: Sequence[PoseLine]) -> None:
    """Raise a RecordingError if a pose has no covariance."""
    for line in lines:
        if line.covariance is None or not line.covariance.any():
            raise RecordingError(
                f"line {line.line}: the pose of {line.label!r} in frame {line.frame} has no "
                "covariance; allowed: poses as mixpose run writes them"
            )
