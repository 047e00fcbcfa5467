"""Sensors that see a moving body at moments of their own: late, or row after row.

A pose and a velocity are the maximum of one likelihood, sought in turns: a Gauss-Newton step of
both gives the velocity, with which the objective is climbed again.  A feature that is seen t
seconds after the common time moves by J δ + t J δv when the pose changes by δ and the velocity v
by δv.  A sensor that is later than it says by τ has offsets J v τ more.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from mixpose.fit import Fit
from mixpose.judgement import ScoredPose, inverses, nearest_alike
from mixpose.matching import ErrorRules, Matches, associate, errors_seen, welsch
from mixpose.objective import View
from mixpose.records import Floats, Indices, Mask
from mixpose.rigid import perturb
from mixpose.sensors import Motion, moments
from mixpose.tracking.frame import Frame
from mixpose.tracking.motion import Expected
from mixpose.tracking.track import DelayEvidence

LINEAR = 0.1  # of σ_ε: where a better velocity moves features by less, steps do, without a climb
SETTLED = 2e-3  # of σ_ε: where it moves them by less, they stay where they are
LEAST_VARIANCE = 1e-6  # in σ_ε²: residuals below are rounding
SOME_FRAMES = 3  # of so many, one is asked for delays that nobody told: it takes time


class Offsets(NamedTuple):
    """Met features of all sensors, in σ_ε and as rows for least squares."""

    rows: Floats  # (K, 6), J, each weighted by the root of how far its feature is met
    late: Floats  # (K,), seconds after the common time at which it is seen
    offsets: Floats  # (K,), observed minus predicted
    sensor: Indices  # (K,)
    unsure: tuple[tuple[int, float], ...]  # sensors with estimated delays, standard deviations

    def by_delay(self, velocity: Floats, sensors: Sequence[int]) -> Floats:
        """How the features of some sensors would move with their delays, (K, q) per second."""
        own = self.sensor[:, None] == np.array(sensors, int)
        return np.where(own, (self.rows @ velocity)[:, None], 0.0)

    def least_squares(
        self, velocity: Floats, expected: Expected, free: Mask, variance: float
    ) -> tuple[Floats, Floats, Floats]:
        """All unknowns by a Gauss-Newton step, their covariance, and offsets (K,) that are left.

        The unknowns are the pose, the velocity, the estimated delays, and of each delay the way of
        the body in it at a velocity other than this.
        """
        rows, fast = self.rows[:, free], expected.deviation[free]
        count, late = len(fast), np.array([deviation for _, deviation in self.unsure])
        sensors = [k for k, _ in self.unsure]
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
        covariance = inverses(design.T @ design / variance + prior.T @ prior)
        x = covariance @ (design.T @ self.offsets / variance + prior.T @ known)
        return x, covariance, self.offsets - design @ x


def gauss_newton(J: Floats, offsets: Floats, free: Mask) -> Floats:
    """Step (6,) of the pose that leaves the least squares of offsets (K,), for J (K, 6)."""
    step = np.zeros(6)
    step[free] = np.linalg.lstsq(J[:, free], offsets, rcond=None)[0]
    return step


def fit_in_motion(
    frame: Frame, T_start: Floats, climb: Callable[[Frame, Floats, float], Fit]
) -> Fit:
    """Climb to the most likely pose and velocity near a start.

    `climb` takes a frame as of the common time, a pose (4, 4), and how far features may be off, in
    σ_ε, to the best pose near it.
    """
    motion = frame.expected(T_start, is_there=False).at(T_start)
    T, expected, moved, rules = T_start, frame.expected(T_start), np.inf, frame.rules.judgement
    errors = rules.noise.errors
    for _ in range(6):
        seen = frame.in_motion(motion)
        if moved > LINEAR:
            at, views = seen.finest.projection.project(T[None]), (frame.still or frame).views
            J, there = at.J[:, 0] / np.array(seen.sigmas)[:, None, None, None], at.seen[:, 0]
            late = _seconds(views, at.y[:, 0], there)
            fit = climb(seen, T, _unsure_by(J, late, there, views, expected))
            T = nearest_alike(fit.T_world_object, frame.body, frame.T_reference)
        expected = frame.expected(T)
        matches = associate(seen.finest, T, rules.association, errors.narrowest)
        met = offsets_of(seen, matches, expected)
        change = _change(met, motion.velocity, expected, frame.free, errors)
        way = met.late * (met.rows @ change)
        T = np.asarray(perturb(T, gauss_newton(met.rows, met.offsets - way, frame.free)))
        motion = Motion(T, motion.velocity + change, expected.acceleration)
        moved = float(np.abs(way).max(initial=0.0))
        if moved < SETTLED:
            break
    return replace(fit, T_world_object=T, motion=motion)


def with_motion_unknown(judged: ScoredPose, frame: Frame, motion: Motion) -> ScoredPose:
    """A judged pose, as sure as its velocity lets it be."""
    free, expected = frame.free, frame.expected(judged.T_world_object)
    met, inner = offsets_of(frame, judged.used, expected), np.ix_(free, free)
    count = int(free.sum())
    rows, covariance = met.rows[:, free], judged.covariance.copy()
    alone = rows.T @ rows
    # the variance by which the covariance goes
    scale = float(np.trace(alone @ covariance[inner])) / max(count, 1)
    if not np.isfinite(scale) or scale <= 0:
        return judged
    _, together, _ = met.least_squares(motion.velocity, expected, free, scale)
    extra = together[:count, :count] - scale * inverses(alone)
    values, vectors = np.linalg.eigh((extra + extra.T) / 2)
    covariance[inner] += (vectors * np.maximum(values, 0.0)) @ vectors.T
    return replace(judged, covariance=covariance)


def offsets_of(frame: Frame, matches: Matches, expected: Expected | None = None) -> Offsets:
    """How far off features are met, as they pull, and when they were seen.

    What is farther off than noise and an expected velocity let it be counts for little.
    """
    names = [view.name for view in frame.views]
    chosen = [names.index(name) for name in matches.names]
    views, blurs = [(frame.still or frame).views[k] for k in chosen], np.ones(len(chosen))
    seen = matches.weights > 0
    late = _seconds(views, matches.places, seen)
    if expected is not None:
        errors, known = frame.rules.judgement.noise.errors, frame.noise[:, chosen]
        _, _, noise, _ = errors_seen(matches, int(frame.free.sum()), known, errors)
        # a pose that was climbed to at another velocity is off by as much in all sensors
        unsure = _unsure_by(matches.J, late, seen, views, expected)
        blurs = np.minimum(np.hypot(noise, errors.blur * unsure), 1.0)
    pull = np.sqrt(matches.shares * welsch(matches.squared, blurs))
    kept = seen[..., None] & (np.arange(2) < matches.dimensions[:, None, None])
    numbers = np.arange(len(views))[:, None, None]
    return Offsets(
        rows=(matches.J * pull[..., None, None])[kept],
        late=np.broadcast_to(late[..., None], kept.shape)[kept],
        offsets=(matches.offsets * pull[..., None])[kept],
        sensor=np.broadcast_to(numbers, kept.shape)[kept],
        unsure=tuple((k, view.unsure) for k, view in enumerate(views) if view.unsure is not None),
    )


def _seconds(views: Sequence[View], y: Floats, seen: Mask) -> Floats:
    """Seconds (L, n) after the common time at which features at places (L, n, 2) are seen."""
    each = zip(views, y, strict=True)
    late = [moments(view.sensor, own, view.delay, view.readout) for view, own in each]
    return np.where(seen, late, 0.0)


def _unsure_by(
    J: Floats, late: Floats, seen: Mask, views: Sequence[View], expected: Expected
) -> float:
    """How far features may be off by velocity and delay, in σ_ε; J (L, n, 2, 6) in σ_ε."""
    delays = np.array([view.unsure or 0.0 for view in views])[:, None, None]
    speed = np.hypot(expected.velocity, expected.deviation)
    ways = np.hypot(late[..., None] * expected.deviation, delays * speed)
    squares = ((J * ways[:, :, None]) ** 2).sum(axis=(2, 3))
    return float(np.sqrt(squares.max(initial=0.0, where=seen)))


def _change(
    met: Offsets, velocity: Floats, expected: Expected, free: Mask, errors: ErrorRules
) -> Floats:
    """Change (6,) of the velocity by one Gauss-Newton step of it and the pose."""
    variance, count, change = errors.typical**2, int(free.sum()), np.zeros(6)
    for _ in range(2):  # the second time with the variance that the first leaves
        x, _, rest = met.least_squares(velocity, expected, free, variance)
        total = errors.typical_degrees * errors.typical**2 + float(rest @ rest)
        degrees = errors.typical_degrees + max(len(rest) - count, 0)
        variance = max(total / degrees, LEAST_VARIANCE)
    change[free] = x[count : 2 * count]
    return change


def delays_after(frame: Frame, best: ScoredPose) -> DelayEvidence:
    """What is known of delays after a frame with a best pose."""
    before, used = frame.track.delays, best.used
    is_asked = frame.frame % SOME_FRAMES == 0 or frame.is_timed
    if len(used.names) < 2 or not frame.track.seconds_until(frame.time_s) or not is_asked:
        return before
    expected = frame.expected(best.T_world_object)
    own = {name: k for k, name in enumerate(used.names)}
    views = [view for view in frame.views if view.name in own]
    told = [view.name for view in views if view.unsure is None]
    reference = before.reference or (told[0] if told else "")
    if not expected.gain.any() or reference not in own:
        return before
    names = (*before.names, *(n for n in own if n != reference and n not in before.names))
    met = offsets_of(frame, used)
    late = met.by_delay(expected.velocity, [own.get(name, -1) for name in names])
    rest = float(met.offsets @ met.offsets) / max(len(met.offsets) - 6, 1)
    variance = max(rest, LEAST_VARIANCE)
    # what a pose and an unknown change of the velocity explain as well says nothing of delays
    shifts = met.rows * met.late[:, None] * expected.deviation / np.sqrt(variance)
    other = np.block([[met.rows, shifts], [np.zeros((6, 6)), np.eye(6)]])
    other /= np.maximum(np.linalg.norm(other, axis=0), np.finfo(float).tiny)
    columns = np.pad(late, ((0, 6), (0, 0)))
    columns -= other @ np.linalg.lstsq(other, columns, rcond=1e-9)[0]
    information = columns.T @ columns / variance
    estimated = {view.name: view.estimated for view in views}
    vector = columns[: len(late)].T @ met.offsets / variance
    vector += information @ np.array([estimated.get(name, 0.0) for name in names])
    n = len(before.names)
    information[:n, :n] += before.information
    vector[:n] += before.vector
    return DelayEvidence(reference, names, information, vector)
