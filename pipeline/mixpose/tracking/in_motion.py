"""Sensors that see a moving body at moments of their own: late, or row after row.

A pose and a velocity are the maximum of one likelihood, sought in turns: a Gauss-Newton step of
both gives the velocity, with which the objective is climbed again.  A feature that is seen t
seconds after the common time moves by J δ + t J δv when the pose changes by δ and the velocity v
by δv.  A sensor that is later than it says by τ has offsets J v τ more.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.linalg import block_diag

from mixpose.fit import Fit
from mixpose.judgement import ScoredPose, inverted
from mixpose.matching import LEAST_VARIANCE, Matches, associate, errors_seen, welsch
from mixpose.objective import View
from mixpose.optimise import LinearResiduals, least_squares
from mixpose.records import Floats, Indices, Mask
from mixpose.rigid import perturb
from mixpose.sensors import Motion, read_times
from mixpose.tracking.frame import Frame
from mixpose.tracking.motion import Expected
from mixpose.tracking.track import DelayEvidence


class Offsets(NamedTuple):
    """Met features of all sensors, in σ_ε and as rows for least squares."""

    rows: Floats  # (K, 6), J, each weighted by the root of how far its feature is met
    late: Floats  # (K,), seconds after the common time at which it is seen
    offsets: Floats  # (K,), observed minus predicted
    sensor: Indices  # (K,)
    unsure: tuple[tuple[int, float], ...]  # sensors with estimated delays, standard deviations

    def by_delay(self, velocity: Floats, sensors: Sequence[int] | Floats) -> Floats:
        """How the features of some sensors would move with their delays, (K, q) per second."""
        return np.where(
            self.sensor[:, None] == np.array(sensors, int), (self.rows @ velocity)[:, None], 0.0
        )

    def unknowns(
        self, velocity: Floats, expected: Expected, free: Mask
    ) -> tuple[Floats, LinearResiduals]:
        """How offsets change with all unknowns (K, q), and what is known of these before.

        Unknown are pose, velocity, delays, and in each delay the body's way at another velocity.
        """
        rows, fast = self.rows[:, free], expected.deviation[free]
        count, (sensors, late) = len(fast), np.reshape(self.unsure, (-1, 2)).T
        ways = [rows * (self.sensor == k)[:, None] for k in sensors]
        by_delay = self.by_delay(velocity, sensors)
        design = np.hstack([rows, rows * self.late[:, None], by_delay, *ways])
        # what is known, with standard deviation one: the velocity less what is expected of the pose
        # after its step, and the delays
        prior = np.eye(design.shape[1])[count:]
        prior[:count, :count] = -np.diag(expected.gain[free])
        prior /= np.concatenate([fast, late, np.outer(late, fast).ravel()])[:, None]
        known = np.zeros(len(prior))
        known[:count] = (expected.velocity - velocity)[free] / fast
        return design, LinearResiduals(prior, known)


def fit_in_motion(
    frame: Frame, T_start: Floats, climb: Callable[[Frame, Floats, float, float], Fit]
) -> Fit:
    """Climb to the most likely pose and velocity near a start (4, 4).

    `climb` takes a frame as of the common time, a start, how far off features may be, and at which
    blur it ends, in σ_ε: narrower ones choose a sensor where the velocity is not known.
    """
    motion = frame.expected(T_start, is_there=False).at(T_start)
    T, moved, count, timing = T_start, np.inf, int(frame.free.sum()), frame.rules.timing
    errors = frame.rules.judgement.noise.errors
    for _ in range(6):
        seen = frame.in_motion(motion)
        expected, matches, wide = frame.expected(T), None, 1.0
        if moved > timing.linear:
            beside, by_velocity = _beside(seen, T, expected)
            if moved == np.inf:  # after the first climb the velocity is known
                wide = max(by_velocity, 1.0)
            fit = climb(seen, T, beside, wide)
            T = frame.oriented(fit.T_world_object)
            matches = fit.matches if T is fit.T_world_object else None
            expected = frame.expected(T)
        met = offsets_of(seen, matches or matches_at(seen, T), expected, wide)
        design, known = met.unknowns(motion.velocity, expected, frame.free)
        variance = errors.typical**2
        for _ in range(2):  # the second time with the variance that the first leaves
            x, _ = least_squares(known, _weighed(design, met.offsets, variance))
            rest = met.offsets - design @ x
            total = errors.typical_degrees * errors.typical**2 + float(rest @ rest)
            degrees = errors.typical_degrees + max(len(rest) - count, 0)
            variance = max(total / degrees, LEAST_VARIANCE)
        change = np.zeros(6)
        change[frame.free] = x[count : 2 * count]
        way = met.late * (met.rows @ change)
        left = LinearResiduals(met.rows, met.offsets - way)
        T = perturb(T, least_squares(left, free=frame.free)[0])
        motion = Motion(T, motion.velocity + change, expected.acceleration)
        moved = float(np.abs(way).max(initial=0.0))
        if moved < timing.settled:
            break
    return replace(fit, T_world_object=T, motion=motion)


def with_motion_unknown(judged: ScoredPose, frame: Frame, motion: Motion) -> ScoredPose:
    """A judged pose, as sure as its velocity and acceleration let it be."""
    free, expected = frame.free, frame.expected(judged.T_world_object)
    met, inner = offsets_of(frame, judged.used, expected), np.ix_(free, free)
    covariance, alone = judged.covariance.copy(), (met.rows.T @ met.rows)[inner]
    # the variance by which the covariance goes
    scale = float(np.trace(alone @ covariance[inner])) / max(len(alone), 1)
    if not np.isfinite(scale) or scale <= 0:
        return judged
    design, known = met.unknowns(motion.velocity, expected, free)
    by_acceleration = met.rows[:, free] * (met.late**2 / 2)[:, None]
    design = np.hstack([design, by_acceleration])
    prior = block_diag(known.J, np.diag(1 / expected.unsteady[free]))
    known = LinearResiduals(prior, np.concatenate([known.residuals, np.zeros(len(alone))]))
    information = least_squares(known, _weighed(design, met.offsets, scale))[1]
    together = inverted(information)[: len(alone), : len(alone)]
    extra = together - scale * inverted(alone)
    values, vectors = np.linalg.eigh((extra + extra.T) / 2)
    covariance[inner] += (vectors * np.maximum(values, 0.0)) @ vectors.T
    return replace(judged, covariance=covariance)


def _weighed(design: Floats, offsets: Floats, variance: float) -> LinearResiduals:
    """Offsets (K,) that change by a design (K, q), in units of their deviation."""
    scale = 1 / math.sqrt(variance)
    return LinearResiduals(scale * design, scale * offsets)


def matches_at(frame: Frame, T_world_object: Floats) -> Matches:
    """What is met at a pose."""
    rules, narrowest = frame.rules.judgement, frame.rules.judgement.noise.errors.narrowest
    return associate(frame.finest, T_world_object, rules.association, narrowest)


def offsets_of(
    frame: Frame, matches: Matches, expected: Expected | None = None, wide: float = 1.0
) -> Offsets:
    """Met features, as they pull: little, where farther off than noise and velocity explain.

    Nor do they pull more than at a blur as `wide`, in σ_ε.
    """
    views = [view for view in frame.still or frame.views if view.name in matches.names]
    met = matches.shares > 0
    late, blurs = _seconds(views, matches.places, met), np.ones(len(views))
    if expected is not None:
        beside, model = _off(views, late, matches.J, met, expected), frame.rules.judgement.noise
        known = model.memory * frame.track.residuals.of(matches.names)
        _, _, noise, _ = errors_seen(matches, int(frame.free.sum()), known, model.errors)
        # a pose that was climbed to at another velocity is off by as much in all sensors
        blurs = np.minimum(np.hypot(noise, model.errors.blur * beside), wide)
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


def _beside(frame: Frame, T_world_object: Floats, expected: Expected) -> tuple[float, float]:
    """How far features may be off at a pose in σ_ε, whatever meets them.

    By velocity and delays, and by velocity alone.
    """
    at, views = frame.finest.projection.project(T_world_object[None]), frame.still or frame.views
    seen, J = at.weights[:, 0] > 0, at.J[:, 0] / np.array(frame.sigmas)[:, None, None, None]
    late = _seconds(views, at.y[:, 0], seen)
    both = _off(views, late, J, seen, expected)
    if all(view.unsure is None for view in views):
        return both, both
    told = [replace(view, unsure=None) for view in views]
    return both, _off(told, late, J, seen, expected)


def _seconds(views: Sequence[View], places: Floats, seen: Mask) -> Floats:
    """When features at places (L, N, 2) are seen (L, N), after the common time."""
    each = zip(views, places, strict=True)
    seconds = [read_times(view.sensor, y, view.delay, view.readout) for view, y in each]
    return np.where(seen, seconds, 0.0)


def _off(views: Sequence[View], late: Floats, J: Floats, seen: Mask, expected: Expected) -> float:
    """How far features (L, N) that are seen `late` may be off by velocity and delays, in σ_ε."""
    delays = np.array([view.unsure or 0.0 for view in views])[:, None, None]
    speed = np.hypot(expected.velocity, expected.deviation)
    ways = np.hypot(late[..., None] * expected.deviation, delays * speed)
    squares = ((J * ways[:, :, None]) ** 2).sum(axis=(2, 3))
    return float(np.sqrt(squares.max(initial=0.0, where=seen)))


def delays_after(frame: Frame, best: ScoredPose) -> DelayEvidence:
    """What is known of delays after a frame with a best pose."""
    before, used = frame.track.delays, best.used
    is_asked = frame.frame % frame.rules.timing.asked == 0 or frame.is_timed
    if len(used.names) < 2 or not frame.track.seconds_until(frame.time_s) or not is_asked:
        return before
    expected, own = frame.expected(best.T_world_object), used.names
    told = (view.name for view in frame.views if view.name in own and view.unsure is None)
    reference = before.reference or next(told, "")
    if not expected.gain.any() or reference not in own:
        return before
    names = (*before.names, *(n for n in own if n != reference and n not in before.names))
    met = offsets_of(frame, used)
    late = met.by_delay(expected.velocity, [own.index(n) if n in own else -1 for n in names])
    degrees = max(len(met.offsets) - 6, 1)
    variance = max(float(met.offsets @ met.offsets) / degrees, LEAST_VARIANCE)
    # what a pose and an unknown change of the velocity explain as well says nothing of delays
    shifts = met.rows * met.late[:, None] * expected.deviation / np.sqrt(variance)
    count = len(late)
    other, columns = np.zeros((count + 6, 12)), np.zeros((count + 6, late.shape[1]))
    other[:count, :6], other[:count, 6:], other[count:, 6:] = met.rows, shifts, np.eye(6)
    other /= np.maximum(np.sqrt(np.vecdot(other.T, other.T)), np.finfo(float).tiny)
    columns[:count] = late
    columns -= other @ np.linalg.lstsq(other, columns, rcond=1e-9)[0]
    information = columns.T @ columns / variance
    estimated = {view.name: view.estimated for view in frame.views}
    vector = columns[:count].T @ met.offsets / variance
    vector += information @ np.array([estimated.get(name, 0.0) for name in names])
    n = len(before.names)
    information[:n, :n] += before.information
    vector[:n] += before.vector
    return DelayEvidence(reference, names, information, vector)
