"""The velocity of a body, from the poses of the frames before.

Each of the six coordinates of the pose is followed with its first three derivatives, of which the
last takes a random walk (a Kalman filter).  How fast that is says how steady the motion is: filters
from very steady to very sudden ones run side by side, and the one is believed that foretold the
last poses best.  The filter says of the frame's velocity how it depends on the frame's pose, and
nothing of the pose itself: that is estimated from its frame.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from mixpose.constants import constant
from mixpose.rigid import Floats
from mixpose.sensors import Motion

_ORDER = 4  # place, velocity, acceleration, jerk
_FACTORIAL = np.array([1.0, 1.0, 2.0, 6.0])
_KINDS = np.repeat([0, 1], 3)  # coordinates are lengths or angles


@dataclass(frozen=True)
class CourseRules:
    """What is believed of a velocity before the frame is seen."""

    fastest: float = constant(
        5.0, "radii of the body per second, where no velocity is known: half a metre for a hand's"
    )
    fastest_deg: float = constant(180.0, "the same, of its turns: a hand's wave")
    quickest: float = constant(
        5.0, "per second: by which derivatives are larger from one to the next, hands at 0.8 Hz"
    )
    steadiest: float = constant(
        -2.0, "power of ten of the least change of jerk, squared radii or radians per s⁷"
    )
    most_sudden: float = constant(9.0, "the same of the largest: 3 Hz and a radius wide")
    filters: int = constant(9, "from the steadiest to the most sudden motion")
    memory: float = constant(0.9, "per frame, of how well each foretold the poses: 10 count")
    lost: float = constant(
        50.0, "squared deviations of a pose from what was foretold: it begins anew"
    )
    longest_s: float = constant(0.5, "without a pose, after which nothing is foretold")


class Expected(NamedTuple):
    """A velocity that is expected of a pose.

    Attributes
    ----------
    velocity : (6,) float64
        Twist per second.
    gain : (6,) float64
        By how much more per second for a pose farther on; zero where no pose was seen before.
    deviation : (6,) float64
        Standard deviations.
    acceleration : (6,) float64
        Per second more.
    """

    velocity: Floats
    gain: Floats
    deviation: Floats
    acceleration: Floats

    def at(self, T_world_object: Floats) -> Motion:
        """How a body moves at that pose."""
        return Motion(T_world_object, self.velocity, self.acceleration)


def unknown(radius: float, rules: CourseRules) -> Expected:
    """What is expected where nothing was seen before: rest, give or take what hands can do."""
    turn = np.radians(rules.fastest_deg)
    deviation = np.repeat([rules.fastest * radius, turn], 3)
    return Expected(np.zeros(6), np.zeros(6), deviation, np.zeros(6))


@dataclass(frozen=True)
class Course:
    """How fast a body goes at its last pose, to which states are relative, and how sure that is.

    Attributes
    ----------
    means : (F, 6, 4) float64
        Place, velocity, acceleration and jerk by F filters.
    covariances : (F, 6, 4, 4) float64
    log_likelihoods : (F, 2) float64
        Of lengths and of angles.
    scale : float
        The body's radius.
    """

    means: Floats
    covariances: Floats
    log_likelihoods: Floats
    scale: float

    @classmethod
    def begun(cls, deviation: Floats, radius: float, rules: CourseRules) -> Course:
        """A course of one pose with standard deviations (6,)."""
        count = rules.filters
        fastest = unknown(radius, rules).deviation
        spread = np.stack([deviation, *(fastest * rules.quickest**k for k in range(_ORDER - 1))], 1)
        covariances = np.broadcast_to(spread[:, :, None] ** 2 * np.eye(_ORDER), (count, 6, 4, 4))
        return cls(np.zeros((count, 6, 4)), covariances, np.zeros((count, 2)), radius)

    def expected(self, moved: Floats | None, elapsed: float, rules: CourseRules) -> Expected:
        """The velocity some seconds and a twist (6,) after the last pose; None: that foretold."""
        means, covariances = self._foretold(elapsed, rules)
        each = (self.log_likelihoods.argmax(axis=0)[_KINDS], np.arange(6))
        mean, covariance = means[each], covariances[each]
        moved = mean[:, 0] if moved is None else moved
        gains = covariance[:, 1:3, 0] / covariance[:, :1, 0]
        rates = mean[:, 1:3] + gains * (moved - mean[:, 0])[:, None]
        variance = covariance[:, 1, 1] - gains[:, 0] * covariance[:, 1, 0]
        rates[3:] += np.cross(moved[3:], rates[3:], axisb=0, axisc=0) / 2
        deviation = np.sqrt(np.maximum(variance, 0.0))
        return Expected(rates[:, 0], gains[:, 0], deviation, rates[:, 1])

    def followed(
        self, moved: Floats, deviation: Floats, elapsed: float, rules: CourseRules
    ) -> Course:
        """The course after one more pose, a twist (6,) on, with standard deviations (6,)."""
        means, covariances = self._foretold(elapsed, rules)
        rest = moved - means[:, :, 0]
        variance = covariances[:, :, 0, 0] + deviation**2
        off = rest**2 / variance
        if off.min(axis=0).max() > rules.lost:
            return Course.begun(deviation, self.scale, rules)
        gains = covariances[..., 0] / variance[..., None]
        means = means + gains * rest[..., None]
        covariances = covariances - gains[..., None] * covariances[..., None, 0, :]
        means[..., 0] -= moved
        # derivatives by the turn itself, not by its logarithm
        means[:, 3:, 1:] += np.cross(moved[3:], means[:, 3:, 1:], axisb=1, axisc=1) / 2
        seen = -0.5 * (np.log(variance) + off)
        logs = rules.memory * self.log_likelihoods + seen.reshape(-1, 2, 3).sum(axis=2)
        return Course(means, covariances, logs - logs.max(axis=0), self.scale)

    def _foretold(self, elapsed: float, rules: CourseRules) -> tuple[Floats, Floats]:
        """Means and covariances of all filters some seconds later."""
        n, t = _ORDER - 1, elapsed
        i, j = np.indices((_ORDER, _ORDER))
        on = np.maximum(j - i, 0)
        F = np.where(j >= i, t**on / _FACTORIAL[on], 0.0)
        # of white noise in the derivative of the jerk
        ahead = 2 * n + 1 - i - j
        Q = t**ahead / (ahead * _FACTORIAL[n - i] * _FACTORIAL[n - j])
        powers = 10 ** np.linspace(rules.steadiest, rules.most_sudden, rules.filters)
        units = np.where(_KINDS == 0, self.scale**2, 1.0)
        noise = powers[:, None, None, None] * units[:, None, None] * Q
        return self.means @ F.T, F @ self.covariances @ F.T + noise
