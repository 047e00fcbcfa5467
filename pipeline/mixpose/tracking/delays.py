"""Sensors that see a moving body at moments of their own: late, or row after row.

A pose and a velocity are estimated together: the pose by the objective, in which every feature is
predicted where the body is when its row is read, and the velocity from what the frame's residuals
and the poses before say of it.  Both are the maximum of one likelihood, sought in turns: a
Gauss-Newton step of both gives the velocity, with which the objective is climbed again.

With velocity v, a feature that is seen t seconds after the common time moves by J δ + t J δv when
the pose changes by δ and the velocity by δv.  A sensor that is later than it says by τ has offsets
J v τ more.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from mixpose.judgement import Association
from mixpose.judgement.moments import inverses
from mixpose.objective import View
from mixpose.records import DelaySeen
from mixpose.sensors import Motion, in_motion, moments
from mixpose.tracking.course import Expected

Floats: TypeAlias = NDArray[np.float64]

LONGEST_S = 1.0  # a clock that differs by more is not the same

TYPICAL = 0.2  # residuals in σ_ε, as two features would say: what a frame alone is weighed by
_TYPICAL_DEGREES = 4.0
LEAST_VARIANCE = 1e-6  # in σ_ε²: residuals below are rounding
_ROUNDING = 1e-9

UNKNOWN_S = 0.1  # standard deviation of a delay of which nothing is known


class Offsets(NamedTuple):
    """Met features of all sensors, in σ_ε and as rows for least squares.

    Attributes
    ----------
    rows : (K, 6) float64
        J, each weighted by the root of how far its feature is met.
    late : (K,) float64
        Seconds after the common time at which it is seen.
    offsets : (K,) float64
        Observed minus predicted.
    sensor : (K,) int
    unsure : tuple of (int, float)
        Sensors whose delays are estimated, with the standard deviations.
    """

    rows: Floats
    late: Floats
    offsets: Floats
    sensor: NDArray[np.intp]
    unsure: tuple[tuple[int, float], ...] = ()

    def by_delay(self, velocity: Floats, sensors: Sequence[int]) -> Floats:
        """How the features of some sensors would move with their delays, (K, q) per second."""
        speeds = self.rows @ velocity
        return np.where(self.sensor[:, None] == np.array(sensors, int), speeds[:, None], 0.0)

    def followed(self, change: Floats, free: NDArray[np.bool_]) -> Floats:
        """How the pose (6,) follows a change of the velocity: a Gauss-Newton step."""
        rows, step = self.rows[:, free], np.zeros(6)
        left = self.offsets - self.late * (self.rows @ change)
        step[free] = _inverse(rows.T @ rows) @ (rows.T @ left)
        return step

    def design(self, velocity: Floats, free: NDArray[np.bool_]) -> Floats:
        """Derivatives by pose, velocity and estimated delays (K, 12 + 7 q).

        Of each delay that is estimated there is the delay itself, and the way of the body in it at
        a velocity other than this.
        """
        rows = np.where(free, self.rows, 0.0)
        by_delay = self.by_delay(velocity, [k for k, _ in self.unsure])
        ways = [np.where((self.sensor == k)[:, None], rows, 0.0) for k, _ in self.unsure]
        return np.hstack([rows, rows * self.late[:, None], by_delay, *ways])


class Together(NamedTuple):
    """A pose and a velocity at once, to first order.

    Attributes
    ----------
    step, change : (6,) float64
        Of pose and velocity.
    """

    step: Floats
    change: Floats


def is_timed(views: Sequence[View]) -> bool:
    """Whether any view is seen at another moment than the common time."""
    return any(view.delay or view.readout or view.unsure is not None for view in views)


def believed(views: Sequence[View], elapsed: float | None) -> list[View]:
    """Views without delays where clocks are not the same."""
    longest = LONGEST_S if elapsed is None else min(max(elapsed, 0.0), LONGEST_S)
    if all(abs(view.delay) <= longest for view in views):
        return list(views)
    return [replace(view, delay=0.0) for view in views]


def seen_in_motion(views: Sequence[View], motion: Motion) -> list[View]:
    """Views whose sensors see what moves, as of the common time."""
    return [
        replace(view, sensor=in_motion(view.sensor, motion, view.delay, view.readout))
        for view in views
    ]


def offsets_of(found: Sequence[Association], views: Sequence[View], blurs: Floats) -> Offsets:
    """Rows for least squares, in which features count as they pull.

    Parameters
    ----------
    found : sequence of Association
    views : sequence of View
        As they stand, in the same order.
    blurs : (L,) array
        In σ_ε, at which features pull: what is far off counts for nothing.
    """
    rows, late, offsets, sensor = [], [], [], []
    for k, (one, view, blur) in enumerate(zip(found, views, blurs.tolist(), strict=True)):
        m, y = one.J.shape[1], one.places
        pull = np.sqrt(one.shares * np.exp(-0.25 * one.squared / blur**2))
        root = np.repeat(pull / one.sigma, m)
        rows.append(one.J.reshape(-1, 6) * root[:, None])
        offsets.append(one.offsets.reshape(-1) * root)
        late.append(np.repeat(moments(view.sensor, y, view.delay, view.readout), m))
        sensor.append(np.full(len(root), k))
    unsure = tuple((k, v.unsure) for k, v in enumerate(views) if v.unsure is not None)
    return Offsets(
        np.concatenate(rows),
        np.concatenate(late),
        np.concatenate(offsets),
        np.concatenate(sensor),
        unsure,
    )


def unsure_by(J: Floats, y: Floats, view: View, velocity: Expected) -> float:
    """How far features at places (n, m) may be off by velocity and delay, in σ_ε; J (n, m, 6)."""
    late = moments(view.sensor, y, view.delay, view.readout)
    speed = np.hypot(velocity.velocity, velocity.deviation) * (view.unsure or 0.0)
    ways = np.hypot(late[:, None] * velocity.deviation, speed)
    squares = ((J * ways[:, None]) ** 2).sum(axis=(1, 2)).max(initial=0.0)
    return float(np.sqrt(squares)) / view.observation.sigma


def together(
    seen: Offsets, velocity: Floats, expected: Expected, free: NDArray[np.bool_]
) -> Together:
    """One Gauss-Newton step of pose and velocity.

    Parameters
    ----------
    seen : Offsets
        At a pose, with a velocity.
    velocity : (6,) array
    expected : Expected
        Velocity of that pose.
    free : (6,) bool
        Directions that are estimated; there is no motion along others.
    """
    design = seen.design(velocity, free)
    size = design.shape[1]
    prior, known = _known(seen, velocity, expected, free)
    inner = _inner(free, size, len(seen.unsure))
    variance, x = TYPICAL**2, np.zeros(size)
    for _ in range(2):  # the second time with the variance that the first leaves
        information = design.T @ design / variance + prior.T @ prior
        vector = design.T @ seen.offsets / variance + prior.T @ known
        x[inner] = _inverse(information[np.ix_(inner, inner)]) @ vector[inner]
        rest = seen.offsets - design @ x
        degrees = max(len(rest) - int(free.sum()), 0)
        total = _TYPICAL_DEGREES * TYPICAL**2 + float(rest @ rest)
        variance = max(total / (_TYPICAL_DEGREES + degrees), LEAST_VARIANCE)
    return Together(x[:6], x[6:12])


def widened(
    covariance: Floats, seen: Offsets, velocity: Floats, expected: Expected, free: NDArray[np.bool_]
) -> Floats:
    """Covariance (6, 6) of a pose whose velocity is not known either.

    Parameters
    ----------
    covariance : (6, 6) array
        As if the velocity were known.
    seen, velocity, expected, free
        As of `together`.
    """
    rows = seen.rows[:, free]
    alone = rows.T @ rows
    inner = covariance[np.ix_(free, free)]
    # the variance by which the covariance goes
    scale = float(np.trace(alone @ inner)) / max(int(free.sum()), 1)
    if not np.isfinite(scale) or scale <= 0:
        return covariance
    design = seen.design(velocity, free)
    prior, _ = _known(seen, velocity, expected, free)
    chosen = _inner(free, design.shape[1], len(seen.unsure))
    information = (design.T @ design / scale + prior.T @ prior)[np.ix_(chosen, chosen)]
    count = int(free.sum())
    extra = _inverse(information)[:count, :count] - scale * _inverse(alone)
    values, vectors = np.linalg.eigh((extra + extra.T) / 2)
    wider = covariance.copy()
    wider[np.ix_(free, free)] += (vectors * np.maximum(values, 0.0)) @ vectors.T
    return wider


def _inner(free: NDArray[np.bool_], size: int, delays: int) -> NDArray[np.intp]:
    """Which unknowns are estimated: of pose, velocity, delays, and the ways in these."""
    parts = [np.tile(free, 2), np.ones(delays, dtype=np.bool_), np.tile(free, delays)]
    return np.flatnonzero(np.concatenate(parts)[-size:])


def _known(
    seen: Offsets, velocity: Floats, expected: Expected, free: NDArray[np.bool_]
) -> tuple[Floats, Floats]:
    """What is known of the unknowns before a frame: rows and right sides, of deviation one."""
    size, count = 12 + 7 * len(seen.unsure), len(seen.unsure)
    # the velocity less what is expected of the pose after its step, and the delays
    prior = np.zeros((size - 6, size))
    prior[:, 6:] = np.eye(size - 6)
    prior[:6, :6] = -np.diag(expected.gain)
    late = np.array([deviation for _, deviation in seen.unsure])
    ways = (late[:, None] * expected.deviation).ravel()
    prior /= np.concatenate([expected.deviation, late, ways])[:, None]
    known = np.zeros(len(prior))
    known[:6] = (expected.velocity - velocity) / expected.deviation
    rows = _inner(free, size - 6, count)
    return prior[rows], known[rows]


def _inverse(information: Floats) -> Floats:
    """Inverse of one information matrix; large where it is open."""
    return np.asarray(inverses(information[None])[0])


@dataclass(frozen=True)
class DelayEvidence:
    """What the frames so far say of how late sensors are, beyond what was told of them.

    Attributes
    ----------
    reference : str
        The sensor against which delays are known; empty before the first frame.
    names : tuple of str
        The others.
    information : (n, n) float64
        Per squared second.
    vector : (n,) float64
        Per second.
    """

    reference: str = ""
    names: tuple[str, ...] = ()
    information: Floats = field(default_factory=lambda: np.zeros((0, 0)))
    vector: Floats = field(default_factory=lambda: np.zeros(0))

    def seconds(self) -> dict[str, DelaySeen]:
        """How late each sensor is, as far as it is known, and how surely."""
        if not self.names:
            return {}
        precise = self.information + np.eye(len(self.names)) / UNKNOWN_S**2
        inverse = np.linalg.inv(precise)
        late, deviation = inverse @ self.vector, np.sqrt(inverse.diagonal())
        pairs = zip(self.names, late.tolist(), deviation.tolist(), strict=True)
        return {name: DelaySeen(seconds, sigma) for name, seconds, sigma in pairs}

    def applied(self, views: Sequence[View]) -> list[View]:
        """Views with the delays that are to be estimated as they are known by now."""
        if all(view.unsure is None for view in views):
            return list(views)
        known = self.seconds()
        applied = []
        for view in views:
            if view.unsure is None:
                applied.append(view)
                continue
            late = known.get(view.name, DelaySeen(0.0, UNKNOWN_S))
            delay = view.delay + late.seconds
            applied.append(
                replace(view, delay=delay, unsure=late.deviation, estimated=late.seconds)
            )
        return applied

    def joined(
        self, seen: Offsets, views: Sequence[View], velocity: Expected, variance: float
    ) -> DelayEvidence:
        """With one more frame, of which the pose is known as well as its features say.

        Parameters
        ----------
        seen : Offsets
            At the pose.
        views : sequence of View
            With the delays that were estimated so far.
        velocity : Expected
        variance : float
            Of the offsets, in σ_ε².
        """
        told = [view.name for view in views if view.unsure is None]
        reference = self.reference or (told[0] if told else "")
        own = {view.name: k for k, view in enumerate(views)}
        if reference not in own or len(own) < 2:
            return self
        names = [*self.names, *(n for n in own if n != reference and n not in self.names)]
        columns = seen.by_delay(velocity.velocity, [own.get(name, -1) for name in names])
        # what a pose and an unknown change of the velocity explain as well says nothing of delays
        shifts = seen.rows * seen.late[:, None] * velocity.deviation / np.sqrt(variance)
        free = np.vstack([seen.rows, np.zeros((6, 6))])
        if seen.late.any():
            free = np.hstack([free, np.vstack([shifts, np.eye(6)])])
        else:
            free = free[: len(seen.rows)]
        more = len(free) - len(columns)
        columns = np.vstack([columns, np.zeros((more, len(names)))])
        offsets = np.concatenate([seen.offsets, np.zeros(more)])
        size = np.sqrt((free * free).sum(axis=0))
        Q, R = np.linalg.qr(free / np.where(size > 0, size, 1.0))
        Q = Q[:, np.abs(R.diagonal()) > _ROUNDING]
        columns -= Q @ (Q.T @ columns)
        frame = columns.T @ columns / variance
        taken = {view.name: view.estimated for view in views}
        used = np.array([taken.get(name, 0.0) for name in names])
        before, count = len(self.names), len(names)
        information, vector = np.zeros((count, count)), np.zeros(count)
        information[:before, :before], vector[:before] = self.information, self.vector
        vector += columns.T @ offsets / variance + frame @ used
        return DelayEvidence(reference, tuple(names), information + frame, vector)
