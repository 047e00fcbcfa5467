"""Sensors that see a moving body at their own moments: late, or row after row.

A pose and a velocity maximise one likelihood, found in turns: a Gauss-Newton step of both gives the
velocity, with which the objective is climbed again.  A feature that is seen t seconds after the
common time moves by J δ + t J δv when the pose changes by δ and the velocity v by δv.  A sensor
that is τ later than configured has additional offsets J v τ.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from scipy.linalg import block_diag

from mixpose.fit import Fit
from mixpose.judgement import ScoredPose, inverted
from mixpose.matching import LEAST_VARIANCE, Matches, associate, errors_seen, welsch
from mixpose.objective import View
from mixpose.optimise import LinearResiduals, least_squares
from mixpose.records import Floats, Indices, Mask, replace
from mixpose.rigid import perturb
from mixpose.sensors import Motion, read_times
from mixpose.tracking.frame import Frame
from mixpose.tracking.motion import ExpectedVelocity
from mixpose.tracking.track import DelayEvidence


class Offsets(NamedTuple):
    """Met features of all sensors, in σ_ε and as rows for least squares."""

    rows: Floats  # (K, 6), J, weighted by the root of the share that is met
    late: Floats  # (K,), moment of each row in seconds after the common time
    offsets: Floats  # (K,), observed minus predicted
    sensor: Indices  # (K,)
    unsure: tuple[tuple[int, float], ...]  # sensors with estimated delays; standard deviations

    def by_delay(self, velocity: Floats, sensors: Sequence[int] | Floats) -> Floats:
        """Return how features of sensors move with their delays, (K, q) per second."""
        return np.where(
            self.sensor[:, None] == np.array(sensors, int), (self.rows @ velocity)[:, None], 0.0
        )

    def unknowns(
        self, velocity: Floats, expected: ExpectedVelocity, free: Mask
    ) -> tuple[Floats, LinearResiduals]:
        """Return the design (K, q) of offsets by all unknowns, and the prior of these.

        Unknown are pose, velocity, delays, and the motion during each delay at another velocity.
        """
        rows, sigmas = self.rows[:, free], expected.deviation[free]
        count, (sensors, delays) = len(sigmas), np.reshape(self.unsure, (-1, 2)).T
        delay_motions = [rows * (self.sensor == k)[:, None] for k in sensors]
        by_delay = self.by_delay(velocity, sensors)
        design = np.hstack([rows, rows * self.late[:, None], by_delay, *delay_motions])
        # in deviations: the velocity minus that expected at the pose after its step, and delays
        prior = np.eye(design.shape[1])[count:]
        prior[:count, :count] = -np.diag(expected.gain[free])
        prior /= np.concatenate([sigmas, delays, np.outer(delays, sigmas).ravel()])[:, None]
        known = np.zeros(len(prior))
        known[:count] = (expected.velocity - velocity)[free] / sigmas
        return design, LinearResiduals(prior, known)


def fit_in_motion(
    frame: Frame, T_start: Floats, climb: Callable[[Frame, Floats, float, float], Fit]
) -> Fit:
    """Climb to the most likely pose and velocity near a start (4, 4).

    `climb` takes a frame at the common time, a start, and in σ_ε how far off features may be and
    the last blur: with an unknown velocity, narrower blurs would let one sensor decide.
    """
    motion = frame.expected_velocity(T_start, seen=False).at(T_start)
    T, moved, count, timing = T_start, np.inf, int(frame.free.sum()), frame.rules.timing
    errors = frame.rules.judgement.noise.errors
    for _ in range(6):
        seen = frame.in_motion(motion)
        expected, matches, wide = frame.expected_velocity(T), None, 1.0
        if moved > timing.linear:
            feature_sigma, by_velocity = _feature_sigmas(seen, T, expected)
            if moved == np.inf:  # after the first climb the velocity is known
                wide = max(by_velocity, 1.0)
            fit = climb(seen, T, feature_sigma, wide)
            T = frame.oriented(fit.T_world_object)
            matches = fit.matches if T is fit.T_world_object else None
            expected = frame.expected_velocity(T)
        met = offsets_of(seen, matches or matches_at(seen, T), expected, wide)
        design, known = met.unknowns(motion.velocity, expected, frame.free)
        variance = errors.typical**2
        for _ in range(2):  # the second time with the residual variance of the first
            x, _ = least_squares(known, _weighed(design, met.offsets, variance))
            residuals = met.offsets - design @ x
            total = errors.typical_degrees * errors.typical**2 + float(residuals @ residuals)
            degrees = errors.typical_degrees + max(len(residuals) - count, 0)
            variance = max(total / degrees, LEAST_VARIANCE)
        change = np.zeros(6)
        change[frame.free] = x[count : 2 * count]
        motions = met.late * (met.rows @ change)
        static = LinearResiduals(met.rows, met.offsets - motions)
        T = perturb(T, least_squares(static, free=frame.free)[0])
        motion = Motion(T, motion.velocity + change, expected.acceleration)
        moved = float(np.abs(motions).max(initial=0.0))
        if moved < timing.settled:
            break
    return replace(fit, T_world_object=T, motion=motion)


def with_motion_unknown(judged: ScoredPose, frame: Frame, motion: Motion) -> ScoredPose:
    """Widen the covariance of a judged pose for its unknown velocity and acceleration."""
    free, expected = frame.free, frame.expected_velocity(judged.T_world_object)
    met, inner = offsets_of(frame, judged.used, expected), np.ix_(free, free)
    covariance, alone = judged.covariance.copy(), (met.rows.T @ met.rows)[inner]
    # the variance that the covariance is based on
    scale = float(np.trace(alone @ covariance[inner])) / max(len(alone), 1)
    if not np.isfinite(scale) or scale <= 0:
        return judged
    design, known = met.unknowns(motion.velocity, expected, free)
    by_acceleration = met.rows[:, free] * (met.late**2 / 2)[:, None]
    design = np.hstack([design, by_acceleration])
    prior = block_diag(known.J, np.diag(1 / expected.unsteady[free]))
    known = LinearResiduals(prior, np.concatenate([known.residuals, np.zeros(len(alone))]))
    information = least_squares(known, _weighed(design, met.offsets, scale))[1]
    joint = inverted(information)[: len(alone), : len(alone)]
    extra = joint - scale * inverted(alone)
    values, vectors = np.linalg.eigh((extra + extra.T) / 2)
    covariance[inner] += (vectors * np.maximum(values, 0.0)) @ vectors.T
    return replace(judged, covariance=covariance)


def _weighed(design: Floats, offsets: Floats, variance: float) -> LinearResiduals:
    """Return offsets (K,) with a design (K, q), in units of their standard deviation."""
    scale = 1 / math.sqrt(variance)
    return LinearResiduals(scale * design, scale * offsets)


def matches_at(frame: Frame, T_world_object: Floats) -> Matches:
    """Return the matches at a pose."""
    rules, narrowest = frame.rules.judgement, frame.rules.judgement.noise.errors.narrowest
    return associate(frame.finest, T_world_object, rules.association, narrowest)


def offsets_of(
    frame: Frame, matches: Matches, expected: ExpectedVelocity | None = None, wide: float = 1.0
) -> Offsets:
    """Return met features, with low weights beyond what noise and velocity explain.

    The weights are those of a blur of at most `wide`, in σ_ε.
    """
    views = [view for view in frame.static_views or frame.views if view.name in matches.names]
    met = matches.shares > 0
    late, blurs = _seconds(views, matches.places, met), np.ones(len(views))
    if expected is not None:
        model = frame.rules.judgement.noise
        feature_sigma = _largest_motion(views, late, matches.J, met, expected)
        known = model.memory * frame.track.residuals.of(matches.names)
        _, _, noise, _ = errors_seen(matches, int(frame.free.sum()), known, model.errors)
        # a pose found at another velocity is off by as much in all sensors
        blurs = np.minimum(np.hypot(noise, model.errors.blur * feature_sigma), wide)
    pull = np.sqrt(matches.shares * welsch(matches.squared, blurs))
    kept = (met[..., None] & (np.arange(2) < matches.dimensions[:, None, None])).nonzero()
    pull = pull[kept[:2]]
    return Offsets(
        rows=matches.J[kept] * pull[:, None],
        late=late[kept[:2]],
        offsets=matches.offsets[kept] * pull,
        sensor=kept[0],
        unsure=tuple((k, view.unsure) for k, view in enumerate(views) if view.unsure is not None),
    )


def _feature_sigmas(
    frame: Frame, T_world_object: Floats, expected: ExpectedVelocity
) -> tuple[float, float]:
    """Return how far features may be off in σ_ε by velocity and delays, and by velocity alone."""
    images = frame.finest.projection.project(T_world_object[None])
    views = frame.static_views or frame.views
    seen = images.weights[:, 0] > 0
    J = images.J[:, 0] / np.array(frame.sigmas)[:, None, None, None]
    late = _seconds(views, images.y[:, 0], seen)
    both = _largest_motion(views, late, J, seen, expected)
    if all(view.unsure is None for view in views):
        return both, both
    certain = [replace(view, unsure=None) for view in views]
    return both, _largest_motion(certain, late, J, seen, expected)


def _seconds(views: Sequence[View], places: Floats, seen: Mask) -> Floats:
    """Return when features at places (L, N, 2) are seen (L, N), after the common time."""
    pairs = zip(views, places, strict=True)
    seconds = [read_times(view.sensor, y, view.delay, view.readout) for view, y in pairs]
    return np.where(seen, seconds, 0.0)


def _largest_motion(
    views: Sequence[View], late: Floats, J: Floats, seen: Mask, expected: ExpectedVelocity
) -> float:
    """Return how far features (L, N) seen at moments `late` may be off, in σ_ε."""
    delays = np.array([view.unsure or 0.0 for view in views])[:, None, None]
    speed = np.hypot(expected.velocity, expected.deviation)
    motions = np.hypot(late[..., None] * expected.deviation, delays * speed)
    squares = ((J * motions[:, :, None]) ** 2).sum(axis=(2, 3))
    return float(np.sqrt(squares.max(initial=0.0, where=seen)))


def delays_after(frame: Frame, best: ScoredPose) -> DelayEvidence:
    """Return the evidence about delays after a frame with a best pose."""
    before, used = frame.track.delays, best.used
    is_asked = frame.frame % frame.rules.timing.asked == 0 or frame.is_timed
    if len(used.names) < 2 or not frame.track.seconds_until(frame.time_s) or not is_asked:
        return before
    expected = frame.expected_velocity(best.T_world_object)
    certain = [view.name for view in frame.views if view.unsure is None]
    reference = before.reference or next(filter(used.names.__contains__, certain), "")
    if not expected.gain.any() or reference not in used.names:
        return before
    names = (*before.names, *(n for n in used.names if n != reference and n not in before.names))
    met = offsets_of(frame, used)
    numbers = [used.names.index(n) if n in used.names else -1 for n in names]
    by_delay = met.by_delay(expected.velocity, numbers)
    degrees = max(len(met.offsets) - 6, 1)
    variance = max(float(met.offsets @ met.offsets) / degrees, LEAST_VARIANCE)
    # offsets that a pose and an unknown change of velocity explain too are no evidence of delays
    shifts = met.rows * met.late[:, None] * expected.deviation / np.sqrt(variance)
    count = len(by_delay)
    other, columns = np.zeros((count + 6, 12)), np.zeros((count + 6, by_delay.shape[1]))
    other[:count, :6], other[:count, 6:], other[count:, 6:] = met.rows, shifts, np.eye(6)
    other /= np.maximum(np.sqrt(np.vecdot(other.T, other.T)), np.finfo(float).tiny)
    columns[:count] = by_delay
    columns -= other @ np.linalg.lstsq(other, columns, rcond=1e-9)[0]
    information = columns.T @ columns / variance
    estimated = {view.name: view.estimated for view in frame.views}
    vector = columns[:count].T @ met.offsets / variance
    vector += information @ np.array([estimated.get(name, 0.0) for name in names])
    n = len(before.names)
    information[:n, :n] += before.information
    vector[:n] += before.vector
    return DelayEvidence(reference, names, information, vector)
