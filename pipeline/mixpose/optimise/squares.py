"""Least squares as terms: minus half the squares of residuals, which one step minimises."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mixpose.optimise.ascent import Ascent, NewtonOptions, Quadratic, Sum, ascend
from mixpose.records import Floats, Mask


def squares_of(residuals: Floats, J: Floats) -> Quadratic:
    """Second-order models of minus half the squares of residuals (H, K), J (H, K, q) off a step."""
    columns = J.swapaxes(1, 2)
    gradient = (columns @ residuals[..., None])[..., 0]
    return Quadratic(-0.5 * (residuals**2).sum(axis=1), gradient, columns @ J)


@dataclass(frozen=True, eq=False)
class LinearResiduals:
    """Minus half the squares of what steps (H, q) leave of residuals."""

    J: Floats  # (K, q)
    residuals: Floats  # (K,)

    def linearise(self, steps: Floats) -> Quadratic:
        """Second-order models at steps (H, q), which are exact."""
        J = np.broadcast_to(self.J, (len(steps), *self.J.shape))
        return squares_of(self.residuals - steps @ self.J.T, J)


def least_squares(*terms: LinearResiduals, free: Mask | None = None) -> Ascent:
    """The step (1, q), in free directions or all, that leaves the least squares of all terms."""
    step, options = np.zeros((1, terms[0].J.shape[1])), NewtonOptions(1, 0.0, 0.0, unchecked=True)
    every = np.ones(step.shape[1], dtype=np.bool_)
    return ascend(Sum(terms), step, np.add, every if free is None else free, options)
