"""Where a body was beside another one, in frames that were sure of both.

Limbs of a person, a tool and its tray stay near each other.  Where the one is sure and the other
was lost, or moved as nobody expected, the poses that it had beside the first tell where it may be.
How often they part company nobody knows: what the body's own track expects counts as much.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mixpose.body import Body
from mixpose.judgement import Prior, nearest_alike
from mixpose.rigid import Floats, inverse, perturb, twist_between
from mixpose.tracking.motion import MotionRules


@dataclass(frozen=True)
class Companion:
    """The poses of a body seen from another one.

    Attributes
    ----------
    T_other_object : (4, 4) float64
        Their mean.
    squares : (6,) float64
        Mean squared twists from it, in the axes of the other body.
    count : int
        Of frames.
    """

    T_other_object: Floats
    squares: Floats
    count: int

    @classmethod
    def joined(
        cls, before: Companion | None, T_world_object: Floats, T_world_other: Floats, body: Body
    ) -> Companion:
        """What was known, and one more frame that is sure of both."""
        T = inverse(T_world_other) @ T_world_object
        if before is None:
            return cls(T, np.zeros(6), 1)
        away = twist_between(before.T_other_object, nearest_alike(T, body, before.T_other_object))
        n = before.count + 1
        squares = before.squares + (away**2 * (1 - 1 / n) - before.squares) / n
        return cls(perturb(before.T_other_object, away / n), squares, n)

    def expected(
        self, T_world_other: Floats, body: Body, rules: MotionRules
    ) -> tuple[Floats, Floats]:
        """Where the body is expected beside the other one, and standard deviations (6,) of that.

        What is guessed before anything is known counts as some frames.
        """
        n, few, guess = self.count, rules.known_from, rules.guess(body) ** 2
        spread = (n * self.squares + few * guess) / (n + few) * (1 + 1 / n)
        variances = np.maximum(spread, rules.steady(body) ** 2)
        wide = variances.reshape(2, 3) @ T_world_other[:3, :3].T ** 2
        return T_world_other @ self.T_other_object, np.sqrt(wide.ravel())


def either(own: Prior, beside: Prior, misses: int, rules: MotionRules) -> Prior:
    """What the body's own track lets expect, or another body, of a pose.

    Either may hold, the other body the less the longer this one was away.  As both are densities
    of poses, no more of the poses made by chance are believed than without the other body.
    """
    share = rules.beside * (1 - rules.surprise) ** misses
    mine, theirs = own.log_density + np.log(1 - share), beside.log_density + np.log(share)
    spread = own.spread if mine > theirs else beside.spread
    return Prior(float(np.logaddexp(mine, theirs)), spread)
