"""Sensors that see a moving body at moments of their own: late, or row after row.

A pose and a velocity are estimated together, by the objective and by what the frame's residuals and
the poses before say of it.  Both are the maximum of one likelihood, sought in turns: a Gauss-Newton
step of both gives the velocity, with which the objective is climbed again.

With velocity v, a feature that is seen t seconds after the common time moves by J δ + t J δv when
the pose changes by δ and the velocity by δv.  A sensor that is later than it says by τ has offsets
J v τ more.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mixpose.fit import Fit
from mixpose.judgement import ScoredPose, inverses, nearest_alike
from mixpose.matching import ErrorRules, Matches, associate, errors_seen
from mixpose.objective import View
from mixpose.records import DelaySeen, Floats, Mask
from mixpose.rigid import perturb
from mixpose.sensors import Motion, moments
from mixpose.tracking.motion import Expected

if TYPE_CHECKING:
    from mixpose.tracking.likelihood import FrameData

ROUNDS = 6
LINEAR = 0.1  # of σ_ε: where a better velocity moves features by less, steps do, without a climb
SETTLED = 2e-3  # of σ_ε: where it moves them by less, they stay where they are

LEAST_VARIANCE = 1e-6  # in σ_ε²: residuals below are rounding

LONGEST_S = 1.0  # a clock that differs by more is not the same
UNKNOWN_S = 0.1  # standard deviation of a delay of which nothing is known
SOME_FRAMES = 3  # of so many, one is asked for delays that nobody told: it takes time
_ROUNDING = 1e-9


def is_timed(views: Sequence[View]) -> bool:
    """Whether any view is seen at another moment than the common time."""
    return any(view.delay or view.readout or view.unsure is not None for view in views)


class Offsets(NamedTuple):
    """Met features of all sensors, in σ_ε and as rows for least squares."""

    rows: Floats  # (K, 6), J, each weighted by the root of how far its feature is met
    late: Floats  # (K,), seconds after the common time at which it is seen
    offsets: Floats  # (K,), observed minus predicted
    sensor: NDArray[np.intp]  # (K,)
    unsure: tuple[tuple[int, float], ...]  # sensors with estimated delays, standard deviations

    def of(self, sensors: Sequence[int]) -> NDArray[np.bool_]:
        """Which rows are of each of some sensors (K, q)."""
        return np.asarray(self.sensor[:, None] == np.array(sensors, int))

    def by_delay(self, velocity: Floats, sensors: Sequence[int]) -> Floats:
        """How the features of some sensors would move with their delays, (K, q) per second."""
        return np.where(self.of(sensors), (self.rows @ velocity)[:, None], 0.0)

    def followed(self, change: Floats, free: NDArray[np.bool_]) -> Floats:
        """How the pose (6,) follows a change of the velocity: a Gauss-Newton step."""
        rows, step = self.rows[:, free], np.zeros(6)
        left = self.offsets - self.late * (self.rows @ change)
        step[free] = _inverse(rows.T @ rows) @ (rows.T @ left)
        return step

    def system(
        self, velocity: Floats, expected: Expected, free: NDArray[np.bool_]
    ) -> tuple[Floats, Floats, Floats]:
        """Derivatives by all unknowns, and what is known of these: rows and right sides.

        The unknowns are the pose, the velocity, the estimated delays, and of each delay the way of
        the body in it at a velocity other than this.  What is known has standard deviation one.
        """
        rows, fast = self.rows[:, free], expected.deviation[free]
        count, late = len(fast), np.array([deviation for _, deviation in self.unsure])
        own = self.of([k for k, _ in self.unsure])
        ways = (own[:, :, None] * rows[:, None]).reshape(len(rows), -1)
        by_delay = self.by_delay(velocity, [k for k, _ in self.unsure])
        design = np.hstack([rows, rows * self.late[:, None], by_delay, ways])
        # the velocity less what is expected of the pose after its step, and the delays
        prior = np.eye(design.shape[1])[count:]
        prior[:count, :count] = -np.diag(expected.gain[free])
        prior /= np.concatenate([fast, late, np.outer(late, fast).ravel()])[:, None]
        known = np.zeros(len(prior))
        known[:count] = (expected.velocity - velocity)[free] / fast
        return design, prior, known


def fit_in_motion(
    data: FrameData, T_start: Floats, climb: Callable[[FrameData, Floats, float], Fit]
) -> Fit:
    """Climb to the most likely pose and velocity near a start.

    The pose is climbed to as if the velocity were known, then steps of both are taken in turns.
    `climb` takes a frame as of the common time, a pose (4, 4), and how far features may be off, in
    σ_ε, to the best pose near it.
    """
    motion = data.expected(T_start, is_there=False).at(T_start)
    T, expected, moved = T_start, data.expected(T_start), np.inf
    for _ in range(ROUNDS):
        seen = data.in_motion(motion)
        if moved > LINEAR:
            fit = climb(seen, T, _in_view(seen, T, expected))
            T = nearest_alike(fit.T_world_object, data.body, data.T_reference)
        expected = data.expected(T)
        rules = data.rules.judgement
        narrowest = rules.noise.errors.narrowest
        matches = associate(seen.finest, T, rules.association, narrowest)
        offsets = offsets_of(seen, matches, expected)
        change = _change(offsets, motion.velocity, expected, data.free, rules.noise.errors)
        moved = float(np.abs(offsets.rows @ change * offsets.late).max(initial=0.0))
        T = np.asarray(perturb(T, offsets.followed(change, data.free)))
        motion = Motion(T, motion.velocity + change, expected.acceleration)
        if moved < SETTLED:
            break
    return replace(fit, T_world_object=T, motion=motion)


def with_motion_unknown(judged: ScoredPose, data: FrameData, motion: Motion) -> ScoredPose:
    """A judged pose, as sure as its velocity lets it be."""
    free, expected = data.free, data.expected(judged.T_world_object)
    offsets, inner = offsets_of(data, judged.used, expected), np.ix_(free, free)
    count = int(free.sum())
    rows, covariance = offsets.rows[:, free], judged.covariance.copy()
    alone = rows.T @ rows
    # the variance by which the covariance goes
    scale = float(np.trace(alone @ covariance[inner])) / max(count, 1)
    if not np.isfinite(scale) or scale <= 0:
        return judged
    design, prior, _ = offsets.system(motion.velocity, expected, free)
    together = _inverse(design.T @ design / scale + prior.T @ prior)[:count, :count]
    extra = together - scale * _inverse(alone)
    values, vectors = np.linalg.eigh((extra + extra.T) / 2)
    covariance[inner] += (vectors * np.maximum(values, 0.0)) @ vectors.T
    return replace(judged, covariance=covariance)


def offsets_of(data: FrameData, matches: Matches, expected: Expected | None = None) -> Offsets:
    """How far off features are met, as they pull, and when they were seen.

    What is farther off than noise and an expected velocity let it be counts for little.
    """
    names = [view.name for view in data.views]
    chosen = [names.index(name) for name in matches.names]
    views, blurs = [(data.still or data).views[k] for k in chosen], np.ones(len(chosen))
    if expected is not None:
        errors, known = data.rules.judgement.noise.errors, data.noise[:, chosen]
        noise = errors_seen(matches, int(data.free.sum()), known, errors).blurs
        unsure = []
        for k, view in enumerate(views):
            seen, m = matches.weights[k] > 0, int(matches.dimensions[k])
            J = matches.sigmas[k] * matches.J[k, seen, :m]
            unsure.append(_unsure_by(J, matches.places[k, seen, :m], view, expected))
        # a pose that was climbed to at another velocity is off by as much in all sensors
        blurs = np.minimum(np.hypot(noise, errors.blur * max(unsure, default=0.0)), 1.0)
    parts = []
    for k, (view, blur) in enumerate(zip(views, blurs.tolist(), strict=True)):
        seen, m = matches.weights[k] > 0, int(matches.dimensions[k])
        seconds = moments(view.sensor, matches.places[k, seen, :m], view.delay, view.readout)
        pull = np.sqrt(matches.shares[k] * np.exp(-0.25 * matches.squared[k] / blur**2))
        root = np.repeat(pull[seen], m)
        rows = matches.J[k, seen, :m].reshape(-1, 6) * root[:, None]
        offsets = matches.offsets[k, seen, :m].reshape(-1) * root
        parts.append((rows, np.repeat(seconds, m), offsets, np.full(len(root), k)))
    rows, late, offsets, sensor = (np.concatenate(part) for part in zip(*parts, strict=True))
    delays = [(k, view.unsure) for k, view in enumerate(views) if view.unsure is not None]
    return Offsets(rows, late, offsets, sensor, tuple(delays))


def _in_view(data: FrameData, T_world_object: Floats, expected: Expected) -> float:
    """How far features in view may be off by velocity and delay, in σ_ε of their sensor."""
    projection, views = data.finest.projection, (data.still or data).views
    at = projection.project(T_world_object[None])
    each = zip(at.J, at.y, at.seen, projection.dimensions.tolist(), views, strict=True)
    return max(
        _unsure_by(J[0, seen[0], :m], y[0, seen[0], :m], view, expected)
        for J, y, seen, m, view in each
    )


def _unsure_by(J: Floats, y: Floats, view: View, expected: Expected) -> float:
    """How far features at places (n, m) may be off by velocity and delay, in σ_ε; J (n, m, 6)."""
    late = moments(view.sensor, y, view.delay, view.readout)
    speed = np.hypot(expected.velocity, expected.deviation) * (view.unsure or 0.0)
    ways = np.hypot(late[:, None] * expected.deviation, speed)
    squares = ((J * ways[:, None]) ** 2).sum(axis=(1, 2)).max(initial=0.0)
    return float(np.sqrt(squares)) / view.observation.sigma


def _change(
    seen: Offsets, velocity: Floats, expected: Expected, free: Mask, errors: ErrorRules
) -> Floats:
    """Change (6,) of the velocity by one Gauss-Newton step of it and the pose."""
    typical, typical_degrees = errors.typical**2, errors.typical_degrees
    design, prior, known = seen.system(velocity, expected, free)
    count, change, variance = int(free.sum()), np.zeros(6), typical
    for _ in range(2):  # the second time with the variance that the first leaves
        information = design.T @ design / variance + prior.T @ prior
        x = _inverse(information) @ (design.T @ seen.offsets / variance + prior.T @ known)
        rest = seen.offsets - design @ x
        degrees = typical_degrees + max(len(rest) - count, 0)
        total = typical_degrees * typical + float(rest @ rest)
        variance = max(total / degrees, LEAST_VARIANCE)
    change[free] = x[count : 2 * count]
    return change


def _inverse(information: Floats) -> Floats:
    """Inverse of one information matrix; large where it is open."""
    return inverses(information)


@dataclass(frozen=True)
class DelayEvidence:
    """What the frames so far say of how late sensors are, beyond what was told of them."""

    reference: str = ""  # the sensor against which delays are known; empty before the first frame
    names: tuple[str, ...] = ()  # the others
    information: Floats = field(default_factory=lambda: np.zeros((0, 0)))  # (n, n), s⁻²
    vector: Floats = field(default_factory=lambda: np.zeros(0))  # (n,), s⁻¹

    def seconds(self) -> dict[str, DelaySeen]:
        """How late each sensor is, as far as it is known, and how surely."""
        if not self.names:
            return {}
        inverse = np.linalg.inv(self.information + np.eye(len(self.names)) / UNKNOWN_S**2)
        late, deviation = inverse @ self.vector, np.sqrt(inverse.diagonal())
        pairs = zip(self.names, late.tolist(), deviation.tolist(), strict=True)
        return {name: DelaySeen(seconds, sigma) for name, seconds, sigma in pairs}

    def applied(
        self, views: Sequence[View], time_s: float | None, elapsed: float | None
    ) -> list[View]:
        """Views as late as they are known to be by now, at a time and so long after the last pose.

        Without times none is late; where clocks are not the same, none is by what was told.
        """
        if time_s is None:
            return [replace(view, delay=0.0, readout=0.0, unsure=None) for view in views]
        known = self.seconds() if any(view.unsure is not None for view in views) else {}
        applied = list(views)
        for k, view in enumerate(views):
            if view.unsure is not None:
                late = known.get(view.name, DelaySeen(0.0, UNKNOWN_S))
                delay = view.delay + late.seconds
                applied[k] = replace(
                    view, delay=delay, unsure=late.deviation, estimated=late.seconds
                )
        longest = LONGEST_S if elapsed is None else min(max(elapsed, 0.0), LONGEST_S)
        if all(abs(view.delay) <= longest for view in applied):
            return applied
        return [replace(view, delay=0.0) for view in applied]

    def joined(self, data: FrameData, best: ScoredPose) -> DelayEvidence:
        """With one more frame, whose best pose is known as well as its features say."""
        used = best.used
        is_asked = data.frame % SOME_FRAMES == 0 or is_timed(data.views)
        if len(used.names) < 2 or not data.elapsed or not is_asked:
            return self
        expected = data.expected(best.T_world_object)
        own = {name: k for k, name in enumerate(used.names)}
        views = [view for view in data.views if view.name in own]
        told = [view.name for view in views if view.unsure is None]
        reference = self.reference or (told[0] if told else "")
        if not expected.gain.any() or reference not in own:
            return self
        names = (*self.names, *(n for n in own if n != reference and n not in self.names))
        seen = offsets_of(data, used)
        late = seen.by_delay(expected.velocity, [own.get(name, -1) for name in names])
        rest = float(seen.offsets @ seen.offsets) / max(len(seen.offsets) - 6, 1)
        variance = max(rest, LEAST_VARIANCE)
        # what a pose and an unknown change of the velocity explain as well says nothing of delays
        shifts = seen.rows * seen.late[:, None] * expected.deviation / np.sqrt(variance)
        free = np.block([[seen.rows, shifts], [np.zeros((6, 6)), np.eye(6)]])
        free /= np.maximum(np.linalg.norm(free, axis=0), np.finfo(float).tiny)
        columns = np.pad(late, ((0, 6), (0, 0)))
        columns -= free @ np.linalg.lstsq(free, columns, rcond=_ROUNDING)[0]
        information = columns.T @ columns / variance
        estimated = {view.name: view.estimated for view in views}
        vector = columns[: len(late)].T @ seen.offsets / variance
        vector += information @ np.array([estimated.get(name, 0.0) for name in names])
        n = len(self.names)
        information[:n, :n] += self.information
        vector[:n] += self.vector
        return DelayEvidence(reference, names, information, vector)
