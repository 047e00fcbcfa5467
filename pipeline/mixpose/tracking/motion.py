"""How far a body moves from frame to frame."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from mixpose.body import Body
from mixpose.constants import constant

Floats: TypeAlias = NDArray[np.float64]


@dataclass(frozen=True)
class MotionRules:
    """What is believed of motion before it is seen."""

    coasting: int = constant(5, "frames for which a velocity is believed without a pose")
    steady_rotation_deg: float = constant(
        1.0, "least uncertainty of a prediction: hand-held bodies change their speed by as much"
    )
    steady_distance: float = constant(0.03, "the same, of the body's radius: 1.7° at the rim")
    unsteady: float = constant(5.0, "times as wide where no velocity is known yet")
    known_from: float = constant(
        3.0,
        "degrees of freedom of a prediction's error: its size is that of one change of motion, in "
        "three directions",
    )
    widening: float = constant(1.5, "of the uncertainty, per frame without a pose")
    widest: float = constant(4.0, "the most it widens by, but for a tenth per further frame")
    unknown_rotation_deg: float = constant(
        30.0,
        "from one frame to the next, before any motion was seen (ranges); of a body about where it "
        "was beside another one, which counts as `known_from` frames",
    )
    unknown_distance: float = constant(1.0, "the same, of the body's radius")
    guess_weight: float = constant(
        0.2, "of a displacement that was seen: what the guess before it counts"
    )
    recall: float = constant(0.95, "per frame, of displacements before: 20 frames count")
    other_kind: float = constant(
        0.25, "least share of squared displacements by turns in those by shifts, and the reverse"
    )
    persistence: float = constant(
        1.5, "of the mean square: steps that follow each other are alike (radio ranges)"
    )
    surprise: float = constant(
        0.02, "chance per frame that the body is somewhere else than predicted"
    )
    beside: float = constant(
        0.5,
        "weight of where another body lets a lost one be expected, against its own track: nobody "
        "knows how often they part; a wrong one costs half of the odds",
    )
    start_rotation_deg: float = constant(5.0, "uncertainty of a [start] that states none")
    start_distance: float = constant(0.1, "the same, of the body's radius: 6° at the rim")

    def steady(self, body: Body) -> Floats:
        """Least standard deviations (6,) of a prediction."""
        turn = np.radians(self.steady_rotation_deg)
        return np.repeat([self.steady_distance * body.radius, turn], 3)

    def start(self, body: Body) -> Floats:
        """Standard deviations (6,) of a start that states none."""
        turn = np.radians(self.start_rotation_deg)
        return np.repeat([self.start_distance * body.radius, turn], 3)


@dataclass(frozen=True)
class RandomWalk:
    """How far the body moves from frame to frame, learnt from uncertain poses.

    Attributes
    ----------
    rates : (6,) float64
        Sum of squared displacements over the time that they took.
    count : float
        Of displacements; fades.
    rules : MotionRules
    """

    rates: Floats
    count: float
    rules: MotionRules

    @classmethod
    def unknown(cls, body: Body, elapsed: float, rules: MotionRules) -> RandomWalk:
        """A guess that is wide enough for most."""
        turn = np.radians(rules.unknown_rotation_deg)
        step = np.repeat([rules.unknown_distance * body.radius, turn], 3)
        return cls(rules.guess_weight * step**2 / max(elapsed, 1e-9), rules.guess_weight, rules)

    def joined(self, moved: Floats, radius: float, elapsed: float) -> RandomWalk:
        """Add a displacement (6,) of a body of some radius to what is remembered.

        A body whose features shift by some length may also turn them by half of it, and
        the other way round: a turn is not unlikely for not having been seen so far.
        """
        lever = np.repeat([1.0, radius], 3)
        shares = _per_kind_mean((moved * lever) ** 2)
        other = np.roll(shares, 3)
        rate = np.maximum(shares, self.rules.other_kind * other) / lever**2 / elapsed
        recall = self.rules.recall
        return RandomWalk(recall * self.rates + rate, recall * self.count + 1, self.rules)

    def variance(self, elapsed: float) -> Floats:
        """Variance (6,) of the displacement in a time.

        Steps that follow each other are alike, so that errors of prediction add up: it is wider
        than the mean square.
        """
        return np.asarray(self.rules.persistence * self.rates / self.count * elapsed)


def _per_kind_mean(squares: Floats) -> Floats:
    """The mean of the lengths and of the angles that are not zero, for all directions alike."""
    parts = [part.sum() / max(np.count_nonzero(part), 1) for part in (squares[:3], squares[3:])]
    return np.repeat(parts, 3)
