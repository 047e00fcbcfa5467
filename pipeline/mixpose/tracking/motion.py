"""How a body moves: how far from frame to frame, and how fast at a moment."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import NamedTuple, TypeAlias

import numpy as np

from mixpose.body import Body
from mixpose.constants import constant
from mixpose.records import Floats, replace
from mixpose.rigid import cross
from mixpose.sensors import Motion

Scale: TypeAlias = tuple[float, float]  # radii of the body, and degrees


@dataclass(frozen=True)
class MotionRules:
    """What is assumed about motion before it is observed."""

    coasting: int = constant(5, "frames without a pose for which a velocity is believed")
    steady: Scale = constant(
        (0.03, 1.0), "least uncertainty of a prediction: hand-held bodies change speed by as much"
    )
    unsteady: float = constant(5.0, "times `steady`, where no velocity is known yet")
    known_from: float = constant(
        3.0, "degrees of freedom of a prediction's error: one change of motion, in three directions"
    )
    widening: float = constant(1.5, "of the uncertainty, per frame without a pose")
    widest: float = constant(4.0, "largest widening, plus a tenth of it per missed frame")
    unknown: Scale = constant(
        (1.0, 30.0),
        "from one frame to the next, before any motion was seen (ranges); of a body about where it "
        "was beside another one, which counts as `known_from` frames",
    )
    guess_weight: float = constant(0.2, "of the guess before any displacement, in displacements")
    recall: float = constant(0.95, "per frame, of earlier displacements: 20 frames count")
    other_kind: float = constant(
        0.25, "least share of squared displacements by turns in those by shifts, and the reverse"
    )
    persistence: float = constant(
        1.5, "of the mean square: steps that follow each other are alike, so that errors add up"
    )
    surprise: float = constant(0.02, "chance per frame that the body is somewhere else")
    hidden: float = constant(0.05, "chance per frame that a body in view is not found in the next")
    beside: float = constant(
        0.5, "weight of the prediction by another body for a lost one: a wrong one costs half"
    )
    start: Scale = constant((0.1, 5.0), "uncertainty of a [start] that states none: 6° at the rim")
    fastest: Scale = constant(
        (5.0, 180.0), "per second, where no velocity is known: half a metre for a hand's, its wave"
    )
    quickest: float = constant(
        5.0, "per second: ratio of each derivative to the one before it, hands at 0.8 Hz"
    )
    sudden: tuple[float, float, int] = constant(
        (-2.0, 9.0, 9),
        "powers of ten of the change of jerk, squared radii or radians per s⁷, from the steadiest "
        "filter to the most sudden (3 Hz and a radius wide), and how many there are",
    )
    memory: float = constant(0.9, "per frame, of how well filters predicted: 10 frames count")
    lost: float = constant(50.0, "squared deviations from the prediction: filters restart")
    longest_s: float = constant(0.5, "without a pose, after which nothing is predicted")

    def surprise_after(self, misses: int) -> float:
        """Return the chance that the body is somewhere else after so many frames without it."""
        return min(self.surprise * (1 + misses), 1.0)


def per_kind(radius: float, scale: Scale) -> Floats:
    """Return lengths, in radii of a body, and angles, alike in all directions of a kind (6,)."""
    return np.array([scale[0] * radius] * 3 + [math.radians(scale[1])] * 3)


@dataclass(frozen=True)
class RandomWalk:
    """How far the body moves from frame to frame, learnt from uncertain poses."""

    rates: Floats  # (6,), sum of squared displacements over the time that they took
    count: float  # of displacements; fades
    rules: MotionRules

    @classmethod
    def unknown(cls, body: Body, elapsed: float, rules: MotionRules) -> RandomWalk:
        """Return a guess that is wide enough for most motions."""
        squares = rules.guess_weight * per_kind(body.radius, rules.unknown) ** 2
        return cls(squares / max(elapsed, 1e-9), rules.guess_weight, rules)

    def joined(self, moved: Floats, radius: float, elapsed: float) -> RandomWalk:
        """Return the walk after a displacement (6,); a body that only shifted may also turn."""
        lever = np.repeat([1.0, radius], 3)
        squares = ((moved * lever) ** 2).reshape(2, 3)
        # of lengths and of angles, the mean of those that are not zero
        means = squares.sum(axis=1) / np.maximum(np.count_nonzero(squares, axis=1), 1)
        shares, other = np.repeat(means, 3), np.repeat(means[::-1], 3)
        rate = np.maximum(shares, self.rules.other_kind * other) / lever**2 / elapsed
        return replace(
            self,
            rates=self.rules.recall * self.rates + rate,
            count=self.rules.recall * self.count + 1,
        )

    def variance(self, elapsed: float) -> Floats:
        """Return the variance (6,) of the displacement in a time."""
        return np.asarray(self.rules.persistence * self.rates / self.count * elapsed)


class Distances(NamedTuple):
    """Statistics of the distances (n, n) between identical bodies and of their changes."""

    last: Floats  # NaN if never seen together
    squares: Floats  # sums of squared changes per frame; fade
    numbers: Floats  # number of changes; fades
    missed: Floats  # frames since the last

    @classmethod
    def unknown(cls, bodies: int, radius: float, rules: MotionRules) -> Distances:
        """Return a guess: changes are about as large as a body of that radius."""
        guess = (rules.unknown[0] * radius) ** 2
        start = np.array([np.nan, rules.guess_weight * guess, rules.guess_weight, 0.0])
        return cls(*np.broadcast_to(start[:, None, None], (4, bodies, bodies)))

    def after(self, places: Floats, rules: MotionRules) -> Distances:
        """Return the statistics after one more frame with places (n, 3), NaN where not seen."""
        now = np.linalg.norm(places[:, None] - places, axis=2)
        is_seen, changes = np.isfinite(now), (now - self.last) / (1 + self.missed)
        is_change = np.isfinite(changes)
        squares = rules.recall * self.squares + np.nan_to_num(changes) ** 2
        return Distances(
            np.where(is_seen, now, self.last),
            np.where(is_change, squares, self.squares),
            np.where(is_change, rules.recall * self.numbers + 1, self.numbers),
            np.where(is_seen, 0.0, self.missed + 1),
        )


class ExpectedVelocity(NamedTuple):
    """The velocity expected at a pose; six numbers each."""

    velocity: Floats  # twist per second
    gain: Floats  # per second, change with the pose; 0 where none was seen before
    deviation: Floats  # standard deviation
    acceleration: Floats  # twist per second²
    unsteady: Floats  # standard deviation of the acceleration

    def at(self, T_world_object: Floats) -> Motion:
        """Return the motion of a body at that pose."""
        return Motion(T_world_object, self.velocity, self.acceleration)


@lru_cache(maxsize=64)
def at_rest(body: Body, rules: MotionRules) -> ExpectedVelocity:
    """Return the velocity where only its largest size is known; not to be written to."""
    fastest, none = per_kind(body.radius, rules.fastest), np.zeros(6)
    fastest.flags.writeable = none.flags.writeable = False
    return ExpectedVelocity(none, none, fastest, none, rules.quickest * fastest)


@dataclass(frozen=True, eq=False)
class MotionFilter:
    """The motion of a body, relative to its last pose, by a bank of Kalman filters.

    Each coordinate of the pose has three derivatives, of which the last takes a random walk.
    Filters from very steady to very sudden motion run side by side, weighted by their predictions.
    """

    means: Floats  # (F, 6, 4), place, velocity, acceleration and jerk by F filters
    covariances: Floats  # (F, 6, 4, 4)
    log_likelihoods: Floats  # (F, 2), of lengths and of angles
    radius: float  # of the body
    rules: MotionRules

    @classmethod
    def begun(cls, deviation: Floats, radius: float, rules: MotionRules) -> MotionFilter:
        """Return the filters after one pose with standard deviations (6,)."""
        count, fastest = rules.sudden[2], per_kind(radius, rules.fastest)
        spread = np.stack([deviation, *(fastest * rules.quickest**k for k in range(3))], axis=1)
        covariances = np.broadcast_to(spread[:, :, None] ** 2 * np.eye(4), (count, 6, 4, 4))
        return cls(np.zeros((count, 6, 4)), covariances, np.zeros((count, 2)), radius, rules)

    def expected(self, moved: Floats | None, elapsed: float) -> ExpectedVelocity:
        """Return the velocity after some seconds and a twist (6,); None: the predicted twist."""
        means, covariances = self._predicted(elapsed)
        innovation = 0.0 if moved is None else (moved - means[..., 0])[..., None]
        gains = covariances[..., 1:3, 0] / covariances[..., :1, 0]
        rates = means[..., 1:3] + gains * innovation
        variances = covariances[..., [1, 2], [1, 2]] - gains * covariances[..., 1:3, 0]
        weights = self._weights[..., None]
        mean = (weights * rates).sum(axis=0)
        variances = (weights * (np.maximum(variances, 0.0) + (rates - mean) ** 2)).sum(axis=0)
        moved = (self._weights * means[..., 0]).sum(axis=0) if moved is None else moved
        mean[3:] += cross(moved[3:, None], mean[3:]) / 2
        gain = (weights * gains).sum(axis=0)[:, 0]
        deviation, unsteady = np.sqrt(variances).T
        return ExpectedVelocity(mean[:, 0], gain, deviation, mean[:, 1], unsteady)

    @cached_property
    def _weights(self) -> Floats:
        """Return the weight of each filter (F, 6); a few frames do not show which one is right."""
        weights = np.exp(self.log_likelihoods)
        return np.asarray((weights / weights.sum(axis=0)).repeat(3, axis=1))

    def ahead(self, elapsed: float) -> tuple[Floats, Floats]:
        """Return the twist (6,) to the predicted pose in some seconds, and the added variance."""
        (means, covariances), weights = self._predicted(elapsed), self._weights
        twists = means[..., 0] - self.means[..., 0]
        twist = (weights * twists).sum(axis=0)
        grown = covariances[..., 0, 0] - self.covariances[..., 0, 0] + (twists - twist) ** 2
        return twist, np.maximum((weights * grown).sum(axis=0), 0.0)

    def followed(self, moved: Floats, deviation: Floats, elapsed: float) -> MotionFilter:
        """Return the filters after a twist (6,) to a pose with standard deviations (6,)."""
        means, covariances = self._predicted(elapsed)
        innovation = moved - means[:, :, 0]
        variance = covariances[:, :, 0, 0] + deviation**2
        off = innovation**2 / variance
        if off.min(axis=0).max() > self.rules.lost:
            return MotionFilter.begun(deviation, self.radius, self.rules)
        gains = covariances[..., 0] / variance[..., None]
        means = means + gains * innovation[..., None]
        covariances = covariances - gains[..., None] * covariances[..., None, 0, :]
        means[..., 0] -= moved
        # derivatives of the turn itself, not of its logarithm
        turning = means[:, 3:, 1:].swapaxes(0, 1)
        turning += cross(moved[3:, None, None], turning) / 2
        # held directions do not tell filters apart
        logs_now = np.where(deviation > 0, -0.5 * (np.log(variance) + off), 0.0)
        logs = self.rules.memory * self.log_likelihoods + logs_now.reshape(-1, 2, 3).sum(axis=2)
        return MotionFilter(means, covariances, logs - logs.max(axis=0), self.radius, self.rules)

    @lru_cache(maxsize=16)  # noqa: B019, few filters are alive
    def _predicted(self, elapsed: float) -> tuple[Floats, Floats]:
        """Return means and covariances of all filters some seconds later."""
        i, j = np.indices((4, 4))
        factorial, power, order = np.array([1.0, 1.0, 2.0, 6.0]), np.maximum(j - i, 0), 7 - i - j
        F = np.where(j >= i, elapsed**power / factorial[power], 0.0)
        # white noise in the derivative of the jerk
        Q = elapsed**order / (order * factorial[3 - i] * factorial[3 - j])
        units = np.repeat([self.radius**2, 1.0], 3)
        noise = (
            10 ** np.linspace(*self.rules.sudden)[:, None, None, None] * units[:, None, None] * Q
        )
        return self.means @ F.T, F @ self.covariances @ F.T + noise
