"""Least squares as terms: minus half the sum of squares of residuals, minimised by one step."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mixpose.optimise.ascent import Quadratic, solved
from mixpose.records import Floats, Mask


def squares_of(residuals: Floats, J: Floats) -> Quadratic:
    """Return models of minus half the squares of residuals (H, K), of Jacobians J (H, K, q)."""
    columns = J.swapaxes(1, 2)
    gradient = (columns @ residuals[..., None])[..., 0]
    return Quadratic(-0.5 * (residuals**2).sum(axis=1), gradient, columns @ J)


class LinearResiduals(NamedTuple):
    """Residuals that a step (q,) lowers by J times the step."""

    J: Floats  # (K, q)
    residuals: Floats  # (K,)


def least_squares(*terms: LinearResiduals, free: Mask | None = None) -> tuple[Floats, Floats]:
    """Return the step (q,) with the least squares of all terms, and its information (q, q).

    Only `free` directions move, or all; those without information do not.
    """
    first, *rest = terms
    information, gradient = first.J.T @ first.J, first.J.T @ first.residuals
    for term in rest:
        information = information + term.J.T @ term.J
        gradient = gradient + term.J.T @ term.residuals
    if free is None:
        return solved(information, gradient, 0.0), information
    known = free.astype(np.float64)
    step = solved(information * (known * known[:, None]), gradient * known, 0.0)
    return step, information
