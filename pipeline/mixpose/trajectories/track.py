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
from mixpose.trajectories.motion import States, StepNoise, predicted, smoothed, updated

_DIFFUSE = 10.0  # times the motion from frame to frame: initial deviation of unknown rates
_FLOOR = 1e-9  # of a pose's largest variance: least variance that float64 resolves


@dataclass(frozen=True)
class Track:
    """Poses of one body at ascending times."""

    times: Floats  # (N,): s, or numbers of frames
    poses: Floats  # (N, 4, 4)
    covariances: Floats  # (N, 6, 6): as in `mixpose.rigid`; any values in held directions
    measured: Mask  # (N,): whether there is a pose; elsewhere `poses` is ignored
    free: Mask  # (6,): world directions that are estimated

    def __len__(self) -> int:
        return len(self.times)

    def part(self, selected: slice | Mask | Indices) -> Track:
        """Return a part of the track."""
        poses, covariances = self.poses[selected], self.covariances[selected]
        return Track(self.times[selected], poses, covariances, self.measured[selected], self.free)

    @property
    def interval(self) -> float:
        """Median time from one pose to the next."""
        steps = np.diff(self.times[self.measured])
        return float(np.median(steps)) if len(steps) else 1.0

    @property
    def rms_motion(self) -> Floats:
        """Root mean square motion (6,) from pose to pose: one value of lengths, one of turns."""
        poses = self.poses[self.measured]
        twists = rigid.twist_between(poses[:-1], poses[1:]).reshape(-1, 2, 3)
        return np.asarray(np.sqrt((twists**2).mean(axis=(0, 2))).repeat(3))


def without_held(covariances: Floats, free: Mask) -> Floats:
    """Return covariances (N, 6, 6) with zeros in held directions."""
    return np.where(free[:, None] & free, covariances, 0.0)


def track_of(times: Floats, poses: Floats, covariances: Floats, measured: Mask) -> Track:
    """Return a track with invertible covariances; directions without variance are held.

    A held direction gets the median variance of the free ones of its kind; any value does, as its
    poses agree.
    """
    known = covariances[measured]
    medians = np.median(np.diagonal(known, axis1=1, axis2=2), axis=0)
    kinds = medians.reshape(2, 3).max(axis=1).repeat(3)
    free = medians > 1e-12 * np.where(kinds > 0, kinds, np.inf)
    covariances = without_held(covariances, free)
    variances = np.diagonal(covariances, axis1=1, axis2=2)
    for kind in (slice(0, 3), slice(3, 6)):
        largest, is_free = variances[:, kind].max(axis=1), free[kind]
        # a median, as very uncertain poses may have variances larger by any factor
        usual = float(np.median(variances[measured][:, kind][:, is_free])) if is_free.any() else 1.0
        floor = np.where(is_free, _FLOOR * largest[:, None], usual)
        covariances[:, range(kind.start, kind.stop), range(kind.start, kind.stop)] += floor
    return Track(times, poses, covariances, measured, free)


@dataclass(frozen=True)
class MotionModel:
    """Motion of a body, and white share of the errors of its poses."""

    order: int  # p, of the derivative that has white noise
    intensities: Floats  # (2,): q, of lengths and of turns
    white: float = 1.0  # share of the covariances that is independent from frame to frame


def noise_of(track: Track, intensities: Floats) -> Floats:
    """Return intensities (G, 6) by coordinate, from those (G, 2) of lengths and turns."""
    held = np.diagonal(track.covariances[0]) / max(track.interval, 1e-9) ** 3
    return np.where(track.free, intensities.repeat(3, axis=1), held)


def white_parts(track: Track, white: Floats) -> Floats:
    """Return covariances (N, G, 6, 6) of the errors that are independent between frames."""
    scale = np.where(track.free, np.sqrt(white)[:, None], 1.0)
    return np.asarray(track.covariances[:, None] * (scale[:, :, None] * scale[:, None]))


def initial_states(track: Track, order: int, covariances: Floats) -> States:
    """Return G states at the first pose, with its covariances (G, 6, 6) and unknown rates."""
    deviation = np.sqrt(np.diagonal(covariances, axis1=1, axis2=2))
    widths = _DIFFUSE * (track.rms_motion + deviation)
    rates = [widths / track.interval**j for j in range(1, order)]
    G = len(covariances)
    P = np.zeros((G, 6 * order, 6 * order))
    P[:, range(6 * order), range(6 * order)] = np.concatenate([deviation, *rates], axis=1) ** 2
    P[:, :6, :6] = covariances
    poses = np.broadcast_to(track.poses[0], (G, 4, 4))
    return States(poses, np.zeros((G, order - 1, 6)), P)


@dataclass(frozen=True)
class SmoothedTrack:
    """A track smoothed by all its poses."""

    poses: Floats  # (N, 4, 4)
    covariances: Floats  # (N, 6, 6)
    step_noises: tuple[StepNoise, ...]  # N - 1, between successive times
    logs: Floats  # (N,): log-likelihoods by the poses before; 0 of the first and without a pose


def smooth_track(track: Track, model: MotionModel, scales: Floats | None = None) -> SmoothedTrack:
    """Smooth a track whose first time has a pose.

    `scales` (N - 1, 2) multiply the noise of the model between successive times.
    """
    white = white_parts(track, np.array([model.white]))
    scales = np.ones((len(track) - 1, 2)) if scales is None else scales
    steps = np.diff(track.times)
    noises = noise_of(track, model.intensities * scales)[:, None]
    states = [initial_states(track, model.order, white[0])]
    ahead: list[tuple[States, Floats]] = []
    logs = np.zeros(len(track))
    for k, (elapsed, noise) in enumerate(zip(steps.tolist(), noises, strict=True), 1):
        ahead.append(predicted(states[-1], elapsed, noise))
        state = ahead[-1][0]
        if track.measured[k]:
            state, _, logs[k : k + 1] = updated(state, track.poses[k], white[k])
        states.append(state)
    step_noises: list[StepNoise] = []
    for k in range(len(steps) - 1, -1, -1):
        prediction, F = ahead[k]
        states[k], step = smoothed(states[k], prediction, states[k + 1], F, steps[k], noises[k])
        step_noises.append(step)
    covariances = np.stack([state.covariances[0][:6, :6] for state in states])
    poses, noises_ahead = np.concatenate([s.poses for s in states]), tuple(reversed(step_noises))
    return SmoothedTrack(poses, without_held(covariances, track.free), noises_ahead, logs)


def without(track: Track, bad: Mask) -> Track:
    """Return a track that ignores the poses in a mask (N,)."""
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
